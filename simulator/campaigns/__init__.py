"""Simulation campaigns behind ``rotortrain``: random windows, training, evaluation, studies and their pages."""
