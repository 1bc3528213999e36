"""The HTTP API: one module for each group of routes, assembled in `service.api.app`."""
