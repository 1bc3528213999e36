"""What windows and recordings show: correlations, spectra and orbits beside theory, as records and as pictures."""
