"""Plots of recordings."""
