"""Mutation kernels: emcee moves that adapt to the population of a tempering stage."""
