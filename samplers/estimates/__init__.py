"""Estimates from weighted points: pure functions of numbers."""
