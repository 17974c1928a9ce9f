"""Simulations that are kept: in memory and in a file, with labels of their code, verified before they are used."""
