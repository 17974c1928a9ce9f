"""Likelihood and posterior of a model given measurements, and the simulations that they need."""
