r"""Whether the posteriors of several tests, or of several parts of a record, agree on their parameters.

Two posteriors of the same parameter differ by chance. The difference between their means is compared with the standard
deviation of this difference: for K tests with means :math:`m_k` and covariances :math:`C_k`,

.. math::

   Q = \sum_k (m_k - \bar m)^T C_k^{-1} (m_k - \bar m), \qquad
   \bar m = \left(\sum_k C_k^{-1}\right)^{-1} \sum_k C_k^{-1} m_k .

For normal posteriors and flat priors Q has a chi-squared distribution if all tests have the same parameters. For two
tests it is the squared Mahalanobis distance of the difference. The prior is taken out of each posterior by weights, and
the distribution of Q is simulated from the samples themselves, so that skewed posteriors and finite samples do not
cause false alarms. See ``docs/theory/hierarchy.rst``.

References
----------
W. G. Cochran (1954), The combination of estimates from different experiments, Biometrics 10, 101-129,
doi:10.2307/3001666.

M. Raveri, W. Hu (2019), Concordance and discordance in cosmology, Physical Review D 99, 043506,
doi:10.1103/PhysRevD.99.043506, section IV: parameter differences.

S. Holm (1979), A simple sequentially rejective multiple test procedure, Scandinavian Journal of Statistics 6, 65-70.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..text_tables import number, text_table
from .pareto_smoothing import LARGEST_SHAPE, smoothed_weights
from .scales import Scales, scales_of
from .stored_posterior import StoredPosterior, log_density_on_scale, on_scale

__all__ = ["Agreement", "PairAgreement", "compare_tests"]

_DRAWS = 2000  # of the distribution of Q under agreement
_FEWEST_EXCEEDING = 20  # of them, for a probability from their number
_FEWEST_EFFECTIVE = 20.0  # samples of a test
_LARGEST_VARIANCE_RATIO = 0.5  # of posterior to prior: above it, a test says too little about a parameter
_PRIOR_DRAWS = 5000
_AT_BOUND = 0.02  # probability of the prior next to a bound
_POWER = 0.8
_SMALLEST_P = 1e-12  # smaller probabilities depend on tails without samples


class PairAgreement(NamedTuple):
    """Agreement of two tests.

    Attributes
    ----------
    tests : tuple of str
        Their names.
    differences : dict of str to float
        Mean of the second minus mean of the first test, in standard deviations of this difference [-], for each
        parameter about which both tests have information.
    standard_deviations : dict of str to float
        Standard deviations of the differences: of the natural logarithm for a logarithmic scale, or in the unit of the
        parameter.
    distance : float
        Mahalanobis distance of all parameters together [-].
    p_value : float
        Probability of a distance at least as large if both tests have the same parameters; 1e-12 or less is stated as
        1e-12.
    adjusted : float
        The same, corrected for the number of pairs (Holm 1979).
    """

    tests: tuple[str, str]
    differences: dict[str, float]
    standard_deviations: dict[str, float]
    distance: float
    p_value: float
    adjusted: float

    def __str__(self) -> str:
        rows = [("parameter", "difference [sd]")]
        rows += [(name, f"{value:+.1f}") for name, value in self.differences.items()]
        table = text_table(rows)
        numbers = (
            f"distance {number(self.distance)}, p = {number(self.p_value, 2)}, corrected {number(self.adjusted, 2)}"
        )
        return f"{self.tests[0]!r} and {self.tests[1]!r}: {numbers}\n{table}"


class Agreement(NamedTuple):
    """Agreement of several tests; ``str`` gives a table and sentences.

    Attributes
    ----------
    pairs : tuple of PairAgreement
        All pairs of tests.
    p_value : float
        Probability that tests with the same parameters differ at least as much, all tests together. NaN if there is no
        parameter about which all tests have information.
    scatter : float
        Root of Q over its degrees of freedom [-], near 1 for tests that agree: how many times the differences between
        the tests exceed their errors.
    detectable : dict of str to float
        Difference of each parameter between two tests that the comparison of this parameter alone finds with
        probability 0.8: the median over the pairs, on the scale of `PairAgreement.standard_deviations`.
    level : float
        Probability below which tests are said to disagree.
    logarithmic : tuple of str
        Parameters that are compared on a logarithmic scale.
    messages : tuple of str
        What limits the comparison; empty if nothing was found.
    left_out : dict of str to tuple of str
        Tests with parameters that were not compared, because the test says too little about them or its prior cannot be
        taken out.
    """

    pairs: tuple[PairAgreement, ...]
    p_value: float
    scatter: float
    detectable: dict[str, float]
    level: float
    logarithmic: tuple[str, ...]
    messages: tuple[str, ...]
    left_out: dict[str, tuple[str, ...]]

    @property
    def agree(self) -> bool | None:
        """False where a pair or all tests together disagree, else True; None (not known) if something was left out."""
        if self.smallest_p < self.level:
            return False
        return None if self.left_out else True

    @property
    def smallest_p(self) -> float:
        """Twice the smaller p-value, of all tests together and the pairs (corrected); twice because it is chosen."""
        of_pairs = min(pair.adjusted for pair in self.pairs)
        if len(self.pairs) == 1 or np.isnan(self.p_value):
            return of_pairs
        return min(2.0 * min(of_pairs, self.p_value), 1.0)

    @property
    def sentence(self) -> str:
        """The result in words, and what follows for predictions."""
        p = f"p < {2 * _SMALLEST_P:.0g}" if self.smallest_p <= 2.0 * _SMALLEST_P else f"p = {self.smallest_p:.1g}"
        if self.agree is not False:
            limits = ", ".join(self._difference(name, value) for name, value in self.detectable.items())
            unknown = "; ".join(f"{', '.join(names)} of {test!r}" for test, names in self.left_out.items())
            unknown = (
                unknown and f"Whether all tests agree is not known: {unknown} could not be compared. In the rest: "
            )
            return (
                f"{unknown}No disagreement was found ({p}). A true difference between two tests of {limits} is found "
                f"in {_POWER:.0%} of such comparisons; smaller ones may be there."
            )
        found = [pair for pair in self.pairs if pair.adjusted < self.level]
        if len(self.pairs) == 1:
            (pair,) = self.pairs
            who = f"{pair.tests[0]!r} and {pair.tests[1]!r} disagree"
        elif found:
            pair = min(found, key=lambda each: (each.adjusted, -each.distance))
            who = (
                f"{len(found)} of {len(self.pairs)} pairs of tests disagree, most of all {pair.tests[0]!r} and "
                f"{pair.tests[1]!r},"
            )
        else:
            pair = max(self.pairs, key=lambda each: each.distance)
            who = (
                f"All tests together disagree, although no single pair does; {pair.tests[0]!r} and {pair.tests[1]!r} "
                "differ most,"
            )
        name = max(pair.differences, key=lambda each: abs(pair.differences[each]))
        size = abs(pair.differences[name])
        difference = self._difference(name, size * pair.standard_deviations[name])
        return (
            f"{who} by {size:.1f} standard deviations in {name} ({difference}; {p}): predictions for a further one "
            "must carry the spread between the tests (Hierarchy), not the error of their mean."
        )

    def _difference(self, name: str, value: float) -> str:
        """A difference on the scale of the comparison, in words."""
        return f"{np.expm1(value):.1%} of {name}" if name in self.logarithmic else f"{value:.3g} in {name}"

    def __str__(self) -> str:
        names = list(self.detectable)
        rows = [["difference [sd]", *names, "distance", "p of pair", "corrected"]]
        for pair in self.pairs:
            values = [f"{pair.differences[name]:+.1f}" if name in pair.differences else "-" for name in names]
            chances = f"{pair.distance:.1f}", number(pair.p_value, 2), number(pair.adjusted, 2)
            rows.append([", ".join(pair.tests), *values, *chances])
        lines = [text_table(rows)]
        lines.append(f"all together: p = {self.p_value:.2g}, scatter {self.scatter:.1f} times the errors")
        return "\n".join([*lines, self.sentence, *self.messages])


class _Test(NamedTuple):
    """The likelihood of one test as weighted samples (n, dim) of the parameters that it has information about."""

    names: list[str]
    points: np.ndarray
    weights: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    effective: float


def compare_tests(
    tests: Mapping[str, StoredPosterior],
    names: Sequence[str],
    *,
    scales: Mapping[str, str] | None = None,
    level: float = 0.01,
    seed: int = 0,
) -> Agreement:
    """Compare the posteriors of several tests, events, or parts of one record. No simulation is run.

    Parameters
    ----------
    tests : mapping of str to StoredPosterior
        Two tests or more, with independent data. Their effective sample sizes matter: state ``effective_sample_size``
        for the correlated samples of a chain.
    names : sequence of str
        Parameters to compare, which every test has. Other parameters, such as noise parameters, are integrated out.
    scales : mapping of str to {"log", "linear"}, optional
        Scale on which a parameter is compared, and on which the prior that is taken out becomes flat. Default: "log"
        for parameters whose priors are positive, else "linear".
    level : float
        Probability below which tests are said to disagree, corrected for the number of pairs.
    seed : int
        Seed of the simulated distribution of the distances.

    Returns
    -------
    Agreement

    Raises
    ------
    ValueError
        For fewer than two tests, unknown parameters or scales, a joint prior of compared and other parameters, fewer
        than 20 effective samples, or no parameter about which two tests have information.

    Notes
    -----
    A disagreement has many causes: a structure that changes with amplitude or time, a wrong model, or posteriors that
    are too narrow because their noise model is wrong (`residual_checks`). In each case the error of the mean is not the
    uncertainty of a further test.

    The distribution of the distances under agreement assumes that a test's estimation error is distributed like its
    samples about their mean, mirrored (exact where the likelihood is a location family on the chosen scale, such as a
    normal one), and that covariances of n effective samples have the errors of a Wishart distribution. Probabilities
    beyond the simulated ones have the tail of a chi-squared distribution.

    A test says too little about a parameter if the posterior variance is more than half the prior variance; the
    parameter is then left out of pairs with this test, and a message says so.

    Examples
    --------
    >>> print(compare_tests({"EQ1": first, "EQ2": second}, ["frequency", "damping"]))
    """
    names, logarithmic = _check(tests, names, scales, level)
    rng, messages, found = np.random.default_rng(seed), [], {}
    for name, stored in tests.items():
        try:
            found[name] = _likelihood(stored, names, logarithmic, f"test {name!r}", messages)
        except ValueError as error:
            raise ValueError(f"test {name!r}: {error}") from None
    pairs = []
    for a, b in itertools.combinations(found, 2):
        shared = [name for name in names if name in found[a].names and name in found[b].names]
        if shared:
            pairs.append(_pair((a, b), _selected(found[a], shared), _selected(found[b], shared), shared, rng))
    if not pairs:
        raise ValueError(f"compare_tests: no two tests have information about one of {', '.join(names)}: {messages}")
    pairs = [pair._replace(adjusted=p) for pair, p in zip(pairs, _holm([pair.p_value for pair in pairs]), strict=True)]
    shared = [name for name in names if all(name in each.names for each in found.values())]
    p_value, scatter = np.nan, np.nan
    if shared:
        several = [_selected(each, shared) for each in found.values()]
        q, p_value = _homogeneity(several, rng) if len(several) > 2 else (pairs[0].distance ** 2, pairs[0].p_value)
        scatter = np.sqrt(q / (len(shared) * (len(several) - 1)))
    return Agreement(
        tuple(pairs),
        float(p_value),
        float(scatter),
        _detectable(pairs, names, level),
        level,
        tuple(name for name, log in zip(names, logarithmic, strict=True) if log),
        tuple(messages),
        {
            test: tuple(name for name in names if name not in each.names)
            for test, each in found.items()
            if len(each.names) < len(names)
        },
    )


def _check(
    tests: Mapping[str, StoredPosterior], names: Sequence[str], scales: Mapping[str, str] | None, level: float
) -> tuple[list[str], np.ndarray]:
    """Names of the parameters and whether their scales are logarithmic; ValueError for impossible arguments."""
    if (
        not isinstance(tests, Mapping)
        or len(tests) < 2
        or not all(isinstance(each, StoredPosterior) for each in tests.values())
    ):
        raise ValueError(f"compare_tests: expected a mapping of two or more names to StoredPosterior; got {tests!r}")
    if isinstance(names, str) or not names or len(set(names)) != len(names):
        raise ValueError(f"compare_tests: names must be different names of parameters, such as ['k']; got {names!r}")
    if not 0.0 < level < 0.5:
        raise ValueError(f"compare_tests: level is a small probability, such as 0.01; got {level!r}")
    scales = {} if scales is None else dict(scales)
    if unknown := [name for name, each in scales.items() if name not in names or each not in ("log", "linear")]:
        raise ValueError(
            f"compare_tests: scales are 'log' or 'linear', for the parameters {', '.join(names)}; got {unknown} in "
            f"{scales}"
        )
    for test, stored in tests.items():
        if missing := [name for name in names if name not in stored.prior.names]:
            raise ValueError(
                f"test {test!r} has no parameters {', '.join(missing)}; it has {', '.join(stored.prior.names)}"
            )

    def positive(name: str) -> bool:
        return all(each.prior.bounds[each.prior.names.index(name), 0] >= 0.0 for each in tests.values())

    return list(names), np.array([scales.get(name, "log" if positive(name) else "linear") == "log" for name in names])


def _likelihood(
    stored: StoredPosterior, names: list[str], logarithmic: np.ndarray, what: str, messages: list[str]
) -> _Test:
    """A test's posterior without its prior, for the parameters that it has information about."""
    scales = scales_of(["log" if each else "linear" for each in logarithmic])
    prior, points = on_scale(stored, names, scales)
    draws = prior.rvs(_PRIOR_DRAWS, 0)
    draws = np.where(logarithmic, np.log(np.where(logarithmic, np.maximum(draws, 1e-300), 1.0)), draws)
    own = np.exp(stored.log_weights)
    variance = own @ np.square(points - own @ points)
    ratio = variance / draws.var(axis=0)
    if not (variance > 0.0).all():
        raise ValueError("all samples have the same value of a parameter: a posterior is needed")
    kept = np.flatnonzero(ratio <= _LARGEST_VARIANCE_RATIO)
    messages += [
        f"{what} says too little about {names[i]}: the variance of its posterior is {ratio[i]:.0%} of that of its "
        "prior; it is not compared"
        for i in np.flatnonzero(ratio > _LARGEST_VARIANCE_RATIO)
    ]
    for i in kept:
        low, high = np.quantile(draws[:, i], [_AT_BOUND, 1.0 - _AT_BOUND])
        bounds = prior.bounds[i]
        ends = (np.isfinite(bounds[0]) and not logarithmic[i] and own[points[:, i] < low].sum() > 0.5 * _AT_BOUND) or (
            np.isfinite(bounds[1]) and own[points[:, i] > high].sum() > 0.5 * _AT_BOUND
        )
        if ends:
            messages.append(
                f"{what}: its samples of {names[i]} reach a bound of the prior, which cuts its likelihood off: the "
                "distances in this parameter are not reliable"
            )
    nothing = _Test([], points[:, :0], own, np.zeros(0), np.zeros((0, 0)), stored.effective_sample_size)
    if stored.effective_sample_size < _FEWEST_EFFECTIVE:
        raise ValueError(
            f"a comparison needs {_FEWEST_EFFECTIVE:.0f} effective samples or more; got "
            f"{stored.effective_sample_size:.1f}"
        )
    if not kept.size:
        return nothing
    names, points = [names[i] for i in kept], points[:, kept]
    log_prior = log_density_on_scale(stored.prior.subset(names), Scales(*(each[kept] for each in scales)), points)
    possible = own > 0.0
    weights = np.zeros(len(own))
    weights[possible], shape = smoothed_weights(stored.log_weights[possible] - log_prior[possible])
    effective = stored.effective_sample_size * min(np.square(own).sum() / np.square(weights).sum(), 1.0)
    if effective < _FEWEST_EFFECTIVE or (shape > LARGEST_SHAPE and np.ptp(log_prior[possible]) > 0.0):
        messages.append(
            f"{what}: the prior cannot be taken out reliably ({effective:.0f} effective samples, at least "
            f"{_FEWEST_EFFECTIVE:.0f} are needed; Pareto shape {shape:.2f}, at most {LARGEST_SHAPE}). Sample this test "
            "again with a wider prior of "
            f"{', '.join(names)}, or give more samples"
        )
    if effective < _FEWEST_EFFECTIVE:
        messages[-1] += "; it is not compared"
        return nothing
    mean = weights @ points
    centered = points - mean
    bias = 1.0 - 1.0 / effective
    return _Test(names, points, weights, mean, (weights * centered.T) @ centered / bias, effective)


def _selected(test: _Test, names: list[str]) -> _Test:
    """The test with a subset of its parameters."""
    rows = [test.names.index(name) for name in names]
    return _Test(
        names, test.points[:, rows], test.weights, test.mean[rows], test.covariance[np.ix_(rows, rows)], test.effective
    )


def _pair(
    tests: tuple[str, str], first: _Test, second: _Test, names: list[str], rng: np.random.Generator
) -> PairAgreement:
    q, p_value = _homogeneity([first, second], rng)
    sd = np.sqrt(first.covariance.diagonal() + second.covariance.diagonal())
    differences = (second.mean - first.mean) / sd
    return PairAgreement(
        tests,
        dict(zip(names, differences.tolist(), strict=True)),
        dict(zip(names, sd.tolist(), strict=True)),
        float(np.sqrt(q)),
        p_value,
        p_value,
    )


def _homogeneity(tests: list[_Test], rng: np.random.Generator) -> tuple[float, float]:
    """Cochran's Q of several tests, and the probability of one at least as large if their parameters are the same.

    In each simulated case a test's error is one of its samples, mirrored about the mean, plus the error that the mean
    has because the samples are finite; its covariance has the error of a Wishart distribution.
    """
    from scipy.stats import chi2

    means = np.stack([each.mean for each in tests])
    q = float(_cochran(means[None], np.stack([each.covariance for each in tests])[None])[0])
    k, dim = means.shape
    errors, covariances = np.empty((_DRAWS, k, dim)), np.empty((_DRAWS, k, dim, dim))
    for i, each in enumerate(tests):
        root = np.linalg.cholesky(each.covariance)
        rows = rng.choice(len(each.points), _DRAWS, p=each.weights)
        of_mean = rng.standard_normal((_DRAWS, dim)) @ root.T / np.sqrt(each.effective)
        errors[:, i] = each.mean - each.points[rows] + of_mean
        factor = root @ _wishart_roots(each.effective - 1.0, dim, rng)
        covariances[:, i] = factor @ factor.swapaxes(-1, -2)
    simulated = np.sort(_cochran(errors, covariances))
    exceeding = _DRAWS - np.searchsorted(simulated, q)
    if exceeding >= _FEWEST_EXCEEDING:
        return q, float((exceeding + 1.0) / (_DRAWS + 1.0))
    degrees = dim * (k - 1)
    largest = simulated[-_FEWEST_EXCEEDING]
    tail = chi2.sf(q * chi2.isf(_FEWEST_EXCEEDING / _DRAWS, degrees) / largest, degrees)
    return q, max(float(tail), _SMALLEST_P)


def _cochran(means: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Cochran's Q (n,) of means (n, k, dim) with covariances (n, k, dim, dim)."""
    precisions = np.linalg.inv(covariances)
    scaled = np.einsum("nkij,nkj->nki", precisions, means)
    common = np.linalg.solve(precisions.sum(axis=1), scaled.sum(axis=1)[..., None])[..., 0]
    offset = means - common[:, None]
    return np.einsum("nki,nkij,nkj->n", offset, precisions, offset)


def _wishart_roots(degrees: float, dim: int, rng: np.random.Generator) -> np.ndarray:
    """Cholesky factors (n, dim, dim) of Wishart matrices over their degrees of freedom (Bartlett's decomposition)."""
    roots = np.tril(rng.standard_normal((_DRAWS, dim, dim)), -1)
    for i in range(dim):
        roots[:, i, i] = np.sqrt(rng.chisquare(degrees - i, _DRAWS))
    return roots / np.sqrt(degrees)


def _holm(p_values: list[float]) -> list[float]:
    """P-values corrected for their number, after Holm (1979)."""
    p, n = np.array(p_values), len(p_values)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty(n)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * (n - np.arange(n))), 1.0)
    return adjusted.tolist()


def _detectable(pairs: list[PairAgreement], names: list[str], level: float) -> dict[str, float]:
    """Differences of single parameters that are found with the stated power, at the level corrected for all pairs."""
    from scipy.stats import norm

    needed = norm.isf(0.5 * level / len(pairs)) + norm.ppf(_POWER)
    sds = {name: [p.standard_deviations[name] for p in pairs if name in p.standard_deviations] for name in names}
    return {name: float(needed * np.median(values)) for name, values in sds.items() if values}
