"""Priors, noise models, the likelihood and the posterior."""
