"""Webhooks: alarm events posted to other programs, signed, in order, until they are taken."""
