"""JSON that leaves the monitor, on Zenoh keys and over HTTP: its fields and what they mean.

Every number is finite or null; every field with a unit has it in its name. Relative changes, standard errors and
intervals are plain ratios: 0.01 is one per cent. Times in ns count from 1970-01-01 UTC.
"""
