"""Clients for a monitor's HTTP API, and for its alarm logs over Zenoh."""
