"""Predictions from samples of the parameters: histories, peaks, probabilities of exceedance and fragility."""
