"""Structural models: objects with named parameters that turn them into responses."""
