"""Sliding correlations, the equation table and its networks, the likelihood, and the trained bundle."""
