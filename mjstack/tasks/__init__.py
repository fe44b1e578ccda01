"""Tasks: what has to be achieved, and the check for it."""
