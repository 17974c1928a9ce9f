"""Models of the error between measured and simulated response."""
