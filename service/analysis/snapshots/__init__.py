"""Snapshots of a live machine as JSON: correlation functions and spectra with theory, orbits, and values of plots."""
