"""Studies and measurements of speed: ``python -m benchmarks [NAME]``; README.md lists them.

A benchmark is a function of the number of repeats, with options as keyword arguments, that returns or yields rows:
NamedTuples of one type, whose fields are the columns of its table. `__main__` lists all of them. No time is asserted,
because machines differ and are shared.
"""
