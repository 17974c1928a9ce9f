"""Figures of records, measurements, responses, residuals, predictions and structures."""
