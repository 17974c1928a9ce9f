"""The annealing from prior to posterior: weights, resampling, mutation, evidence and diagnostics."""
