"""Gates: each verifies one thing about a task, and says what it measured."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
