"""Snapshots of a live machine: correlations and spectra beside what theory predicts, and orbits, as JSON."""
