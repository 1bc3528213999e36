"""What a sliding window of samples is reduced to: moments of its hops, and the statistics that are made of them."""
