"""A monitor's HTTP API in Python, and its alarm logs over Zenoh."""
