"""Sensor faults told from machine faults: what each channel's samples and what pairs of channels say."""
