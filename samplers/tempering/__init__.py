"""The annealing from prior to posterior: moves, chains from leaders, recycling, rounds of a guide."""
