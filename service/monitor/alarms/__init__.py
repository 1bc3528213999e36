"""Alarms of one machine: life cycle, delays, shelving and suppression. Pure: time comes in as an argument."""
