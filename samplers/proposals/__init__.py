"""Proposal densities fitted to weighted points: mixtures of Student t and transformations of the parameters."""
