"""The running service: its processes and threads."""
