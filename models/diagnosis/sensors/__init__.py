"""Sensor faults, distinguished from machine faults by each channel's samples and by comparing pairs of channels."""
