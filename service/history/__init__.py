"""The history: alarms, reports, readings, checkpoints, tokens and the audit log, in SQLite or PostgreSQL."""
