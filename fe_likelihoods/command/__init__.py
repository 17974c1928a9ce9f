"""The console script `fe-likelihoods`: check, run and report an update that one TOML file describes.

Start at `main` for the commands, at `schema` for the keys of the file. Only this folder and `fe_likelihoods.reporting`
use both packages of the project.
"""
