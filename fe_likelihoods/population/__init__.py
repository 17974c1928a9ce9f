"""Several events or tests: populations of posteriors, comparisons between them, and ratios to predictions."""
