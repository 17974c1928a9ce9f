"""How simulations are run and stored: model protocol, executors, processes, and labels of code."""
