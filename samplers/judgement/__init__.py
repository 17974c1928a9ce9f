"""Quality of a run's result: findings during and after the run, and the verdict."""
