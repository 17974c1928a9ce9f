"""Structural models: the built-in ones and wrappers for a user's own."""
