"""Predictions from posterior samples: propagation, reliability and model averaging."""
