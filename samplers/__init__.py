"""Tempered ensemble samplers behind the interface of emcee."""
