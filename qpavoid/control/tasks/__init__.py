"""Tasks: rows A v = b."""
