"""Metrics of the monitor for Prometheus, read from snapshots when somebody asks."""
