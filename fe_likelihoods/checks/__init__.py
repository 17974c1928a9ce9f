"""What speaks against data, models, results and predictions: functions that take numbers and return findings."""
