"""Evaluation of the user's functions: how they are called, what they return, in which order points arrive."""
