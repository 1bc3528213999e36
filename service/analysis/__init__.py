"""What windows and recordings show: orbits, spectra, correlations, trends, and what theory predicts of them."""
