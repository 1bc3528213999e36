"""Vibration levels: what is seen of a machine without any model of it."""
