"""What diagnosticians are held against: bounds, the paper's own networks, and other methods."""
