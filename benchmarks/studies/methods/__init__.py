"""References for the diagnosticians: bounds, the paper's own networks, and other methods."""
