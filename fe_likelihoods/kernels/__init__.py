"""Compiled mechanics on bare arrays, one law per file; `jit.py` says how they are compiled and cached."""
