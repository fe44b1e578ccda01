"""Episodes: the rollout that every gate and job plays, and what is kept of it."""
