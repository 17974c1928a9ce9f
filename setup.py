"""Packages are found, not listed; the folder data/ at the top level is installed as `fe_likelihoods.data`.

Everything else is in pyproject.toml, which cannot combine found packages with a renamed one.
"""

from setuptools import find_packages, setup

setup(packages=[*find_packages(include=["fe_likelihoods*", "samplers*"]), "fe_likelihoods.data"])
