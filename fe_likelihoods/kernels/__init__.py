"""Compiled mechanics on bare arrays: one law per file. See `jit.py` for how they are compiled and cached."""
