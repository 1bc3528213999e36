"""Plots of recordings: what is to be seen (trend, correlation, orbit, spectrum, waterfall), and its drawing."""
