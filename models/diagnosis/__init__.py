"""Diagnosis of windows: their statistics, the diagnosticians, the checks of the sensors, and the verdict."""
