"""Vibration levels: figures of a machine's vibration that need no model of it."""
