"""Controllers: what writes the commands."""
