"""Doubts about data, models, results and predictions: functions that take numbers and return findings."""
