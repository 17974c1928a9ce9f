"""Speed, measured: ``python -m tests.benchmarks`` prints one table and keeps it in ``results/benchmarks.json``.

A benchmark is a function of the number of repeats that returns `Row`s; `__main__` holds the list of them. Nothing here
asserts a time: machines differ and are shared, tests must not depend on that.
"""
