"""Benchmarks: ``python -m benchmarks`` prints one table and stores it in ``results/benchmarks.json``.

A benchmark is a function of the number of repeats that returns a list of `Row`; `__main__` lists all of them. No time
is asserted, because machines differ and are shared.
"""
