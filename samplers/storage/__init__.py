"""Backends, the journal that makes runs resumable, and the evaluation of log-probabilities."""
