"""Tasks: what has to be achieved, and the evidence for it."""
