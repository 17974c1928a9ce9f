"""Packages are found, not listed; the folder data/ at the top level is installed as `fe_likelihoods.data`.

Everything else is in pyproject.toml, which cannot combine found packages with a renamed one, nor name a temporary
folder for what a wheel is built in: the folder of the source stays as it was.
"""

import tempfile

from setuptools import find_packages, setup

with tempfile.TemporaryDirectory() as folder:
    setup(
        packages=[*find_packages(include=["fe_likelihoods*", "samplers*"]), "fe_likelihoods.data"],
        options={"build": {"build_base": folder}, "egg_info": {"egg_base": folder}},
    )
