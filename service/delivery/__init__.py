"""Whoever is told of what happens: event streams over HTTP, webhooks, and metrics for Prometheus."""
