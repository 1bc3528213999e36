"""The HTTP API: one module for each group of routes, put together in `service.api.app`."""
