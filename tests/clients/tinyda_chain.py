"""Chains of tinyDA on a server of UM-Bridge: ``python tinyda_chain.py URL KIND < settings > samples``, both JSON.

tinyDA pins NumPy and arviz to versions that this library does not use, so this script runs in an environment of its
own, imports nothing of the library, and knows it as a server alone.
"""

import contextlib
import json
import sys

import numpy as np
import tinyDA
import umbridge
from scipy import stats


class Flat:
    """Prior of density one: that of the library is in the posterior that is served."""

    def logpdf(self, x):
        return 0.0


class Served:
    """Log-likelihood that is the output of the model."""

    def loglike(self, output):
        return float(output[0])


def main():
    """Sample, and write the samples (n_chains, n_draws, ndim)."""
    url, kind = sys.argv[1:]
    settings = json.load(sys.stdin)
    np.random.seed(settings["seed"])  # noqa: NPY002 - tinyDA draws from the global stream
    model = tinyDA.UmBridgeModel(umbridge.HTTPModel(url, kind))
    if kind == "posterior":
        target = tinyDA.Posterior(Flat(), Served(), model)
        proposal = tinyDA.AdaptiveMetropolis(np.diag(np.square(settings["scale"])), adaptive=True)
    else:
        prior = stats.multivariate_normal(settings["mean"], settings["covariance"])
        data = np.array(settings["data"])
        target = tinyDA.Posterior(
            prior, tinyDA.GaussianLogLike(data, settings["sigma"] ** 2 * np.eye(len(data))), model
        )
        proposal = tinyDA.GaussianRandomWalk(np.array(settings["step"]))
    starts, burn_in = [np.array(start) for start in settings["starts"]], settings["burn_in"]
    with contextlib.redirect_stdout(sys.stderr):
        chains = tinyDA.sample(target, proposal, settings["draws"], len(starts), starts, force_sequential=True)
    samples = [[link.parameters.tolist() for link in chains[f"chain_{i}"][burn_in:]] for i in range(len(starts))]
    json.dump(samples, sys.stdout)


if __name__ == "__main__":
    main()
