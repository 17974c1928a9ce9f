"""``python -m fe_likelihoods``: the console script ``fe-likelihoods``."""

from .command.main import main

__all__ = []

if __name__ == "__main__":
    main(prog_name="fe-likelihoods")
