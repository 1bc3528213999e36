"""``rotortrain commission``: the command, and the report that people read."""
