"""The console script `fe-likelihoods`: check, run and report an update that one TOML file describes.

`main` has the commands, `sections` the keys of the file. This folder and `reporting` use both packages of the project.
"""
