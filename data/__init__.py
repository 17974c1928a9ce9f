"""Bundled synthetic data sets. See README.md in this folder."""
