"""Proposal densities: mixtures of Student t distributions on transformed parameters."""
