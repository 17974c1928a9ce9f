"""Damage of a column from its response: measures, limit states and their probabilities."""
