"""Figures of records, measurements, responses and structures."""
