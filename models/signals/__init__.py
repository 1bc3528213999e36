"""Sample blocks, channels, key names, wire format and recordings."""
