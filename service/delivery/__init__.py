"""Notification: event streams over HTTP, webhooks, and metrics for Prometheus."""
