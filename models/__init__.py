"""Shared vocabulary and mathematics: signals, physics, diagnosis. Pure: no network, clock, thread or global state."""
