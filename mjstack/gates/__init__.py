"""Gates: each verifies one thing about a task, and says what it measured."""
