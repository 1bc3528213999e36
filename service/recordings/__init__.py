"""Capturing messages into rotating files, keeping and dropping them, finding them again."""
