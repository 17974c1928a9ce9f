"""Structural finite-element models as black-box log-likelihoods."""
