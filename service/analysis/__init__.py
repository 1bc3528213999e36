"""Analysis of windows and recordings: orbits, spectra, correlation functions, trends, and predictions of theory."""
