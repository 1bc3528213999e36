"""A sliding window of samples reduced to moments of its hops, and the statistics made of them."""
