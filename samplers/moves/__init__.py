"""Mutation kernels in the form of emcee moves."""
