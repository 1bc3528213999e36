"""Recordings fed back: straight into a monitor, or onto the network."""
