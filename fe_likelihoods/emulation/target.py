"""The posterior as modes and emulators need it: standard normal coordinates, responses, statistics, noise.

In the coordinates z of `Prior.from_normal` the prior is the standard normal, so bounds need no attention, the prior is
part of the least squares (its residuals are z), and every parameter has the same scale.
"""

import hashlib
import json
from collections.abc import Callable, Generator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..priors.scales import Scales
from .archive import Archive

Remember = Callable[..., Sequence[np.ndarray] | None]  # `samplers.tempering.guide.GuideSession.remember`
Steps = Generator[Callable[[], Any] | None, Any, Any]  # functions to call; None after each batch of simulations

LARGEST_FACTOR = 30.0  # between the ends of the prior's central 95 %, up to which a parameter is a factor
_SMALLEST = 1e-300  # positive parameters are at least this before their logarithm is taken
_AT_BOUND = 8.5  # from about 8.3, parameters are rounded to a bound that is not zero
_WIDTHS = 7.0, 3.0, 1.0, 0.3, 0.1  # half widths of the grids on which noise parameters are first searched
_GRID = np.linspace(-1.0, 1.0, 41)
_STEP = 1e-4  # relative, of derivatives by differences in memory


class Runs(NamedTuple):
    """Simulations at n points of the structural coordinates."""

    numbers: np.ndarray  # (n,) in the archive of the target; -1 where failed
    statistics: np.ndarray  # (n, n_numbers) of the residuals; NaN where failed
    failed: np.ndarray  # (n,) bool


class NoiseFit(NamedTuple):
    """Noise parameters that fit given statistics best."""

    coords: np.ndarray  # (n_noise,), standard normal; empty if they are integrated out
    log_density: float  # log-likelihood plus the log-prior of these coordinates


def nothing_stored(_: str, compute: Callable[[], Sequence[np.ndarray]] | None = None) -> Sequence[np.ndarray] | None:
    """`Remember` that stores nothing."""
    return None if compute is None else compute()


def at_once(steps: Steps, ended: Callable[[], None] = lambda: None) -> Any:
    """Result of steps whose functions are called here, and `ended` after each batch."""
    answer = None
    while True:
        try:
            item = steps.send(answer)
        except StopIteration as end:
            return end.value
        answer = ended() if item is None else item()


class ResponseTarget:
    """A posterior in standard normal coordinates, first the structural ones, and its `archive` of simulations;
    ValueError as for its `data`. `unchecked` is not empty until the model's derivatives are compared with a difference.
    """

    def __init__(self, posterior: Any) -> None:
        self.posterior, self._prior = posterior, posterior.prior
        self.data = posterior.likelihood.histories()
        self.ndim, self.n_structural = posterior.ndim, len(self.data.parameter_names)
        self.n_noise = self.ndim - self.n_structural
        self.n_steps = self.data.shape[1]
        self.archive, self._whole = Archive(self.data.statistic, self.data.shape), self
        self.unchecked = [True] if self.data.differentiable else []
        self._structural = self._prior.subset(self._prior.names[: self.n_structural])
        self._noise = self._prior.subset(self._prior.names[self.n_structural :]) if self.n_noise else None
        at = np.array([[-_AT_BOUND], [-3.0], [-2.0], [2.0], [3.0]]) * np.ones(self.n_structural)
        least, lower, low, high, higher = self.parameters(at)
        factors = (least >= 0.0) & (low > 0.0) & (high < LARGEST_FACTOR * low)
        # of inputs of emulators: logarithms where priors are lognormal; of factors themselves, logarithms (products, as
        # E I, are linear), or reciprocals (as deflections of springs in series are), whose tails draws miss near zero
        linear = 1 - np.array(self._structural.logarithmic)
        logs = linear * ~factors
        powers = np.array([linear, logs, logs - factors * (higher < LARGEST_FACTOR * lower)])
        self.scales = [Scales(each) for each in np.unique(powers, axis=0)]
        self._straight = [Scales(logs), Scales(np.ones_like(logs))]

    def first_parts(self, shares: Sequence[float]) -> list["ResponseTarget"]:
        """The same posterior for the first parts of the record, see `FELikelihood.first_parts`."""
        parts = self.posterior.likelihood.first_parts(shares)
        targets = [ResponseTarget(type(self.posterior)(part, self._prior)) for part in parts]
        for each, part in zip(targets, parts, strict=True):
            each.unchecked = self.unchecked
            if part.model is self.posterior.likelihood.model:  # cannot be shortened: the same simulations are used
                each._whole, each.archive = self, self.archive.view(each.data.statistic, ~part.measured.missing)
        return targets

    # ------------------------------------------------------------------ coordinates

    def parameters(self, coords: np.ndarray) -> np.ndarray:
        """Parameters (n, ndim) at coordinates (n, ndim), or structural ones at coordinates (n, n_structural)."""
        return (self._prior if coords.shape[1] == self.ndim else self._structural).from_normal(coords)

    def coordinates(self, parameters: np.ndarray) -> np.ndarray:
        """Coordinates of parameters (n, ndim), or of structural ones (n, n_structural), finite also where these were
        rounded to a bound."""
        prior = self._prior if parameters.shape[1] == self.ndim else self._structural
        coords = prior.to_normal(parameters)
        return np.where(np.isinf(coords), np.copysign(_AT_BOUND, coords), coords)

    def with_volume(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of parameters as `coordinates`, and the logarithm (n,) of their volume over the parameters'
        volume: the log-density of parameters minus that of the coordinates; -inf outside the prior's support.
        """
        prior = self._prior if parameters.shape[1] == self.ndim else self._structural
        coords, log_prior = self.coordinates(parameters), np.atleast_1d(prior.logpdf(parameters))
        inside = np.isfinite(coords).all(axis=1) & np.isfinite(log_prior)
        return coords, np.where(inside, log_prior - self.log_prior(np.where(inside[:, None], coords, 0.0)), -np.inf)

    def scaled(self, coords: np.ndarray, scales: Scales) -> np.ndarray:
        """Structural parameters on scales, and noise coordinates, at coordinates (n, >= d), not smooth near a bound."""
        parameters = self.parameters(coords[:, : self.n_structural])
        positive = np.where(scales.power < 1, np.maximum(parameters, _SMALLEST), parameters)
        return np.column_stack([scales.to_scale(positive), coords[:, self.n_structural :]])

    def unscaled(self, scaled: np.ndarray, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (n, ndim) of what `scaled` returns, and the logarithm (n,) of their volume over its volume.

        The logarithm is -inf outside the support of the prior.
        """
        points = scaled[:, : self.n_structural]
        coords, volume = self.with_volume(scales.from_scale(points))
        return np.column_stack([coords, scaled[:, points.shape[1] :]]), volume + scales.log_jacobian(points).sum(axis=1)

    def lines(self, first: np.ndarray, last: np.ndarray, shares: np.ndarray) -> list[np.ndarray]:
        """Coordinates (n, n_structural) at shares (n,) of the way between two points, straight in logarithms, or else
        in parameters."""
        ends = [self.scaled(np.array([first, last]), each) for each in self._straight]
        lines = [begin + shares[:, None] * (end - begin) for begin, end in ends]
        return [self.unscaled(line, each)[0] for line, each in zip(lines, self._straight, strict=True)]

    def log_prior(self, coords: np.ndarray) -> np.ndarray:
        """Standard normal log-density (n,) of coordinates (n, k)."""
        return -0.5 * np.square(coords).sum(axis=-1) - 0.5 * np.log(2.0 * np.pi) * coords.shape[-1]

    def density_of_parameters(self, log_density: Callable, parameters: np.ndarray) -> np.ndarray:
        """Log-density (n,) of parameters (n, ndim), from a log-density of coordinates; -inf outside the support."""
        coords, result = self.with_volume(parameters)
        inside = result > -np.inf
        if inside.any():
            result[inside] += log_density(coords[inside])
        return result

    # ------------------------------------------------------------------ simulations

    def new_points(self, coords: np.ndarray) -> int:
        """Number of structural coordinates (n, n_structural) that `run` has not simulated yet."""
        return len({row.tobytes() for row in coords} - self.archive.number_of.keys())

    def run(self, coords: np.ndarray, remember: Remember = nothing_stored, thetas: np.ndarray | None = None) -> Steps:
        """Simulate structural coordinates (n, n_structural), whose parameters are `thetas` if given, once each; returns
        `Runs`.

        Yields what is to be called, so that no search stands between a sampler and a model; residuals are rounded to
        single precision, so that a resumed run is the same.
        """
        if self._whole is not self:  # which leaves nothing new
            yield from self._whole.run(coords, remember, thetas)
        thetas = self.parameters(coords) if thetas is None else thetas
        keys = [row.tobytes() for row in coords]
        new = list({key: row for row, key in enumerate(keys) if key not in self.archive.number_of}.values())
        for k in range(0, len(new), self.data.together):
            rows = new[k : k + self.data.together]
            found = yield from self._stored("residuals", self.data.simulate, thetas[rows], remember)
            residuals, statistics, reasons = found
            self.data.recall(thetas[rows], statistics, json.loads(reasons.tobytes().decode()))
            good = np.isfinite(residuals).all(axis=(1, 2)) & np.isfinite(statistics).all(axis=1)
            numbers = np.full(len(rows), -1)
            numbers[good] = self.archive.add(coords[rows][good], residuals[good], statistics[good])
            self.archive.number_of |= {keys[row]: number for row, number in zip(rows, numbers, strict=True)}
        numbers, known = np.array([self.archive.number_of[key] for key in keys], int), self.archive.statistics
        statistics = np.full((len(keys), known.shape[1]), np.nan)
        statistics[numbers >= 0] = known[np.searchsorted(self.archive.numbers, numbers[numbers >= 0])]
        return Runs(numbers, statistics, numbers < 0)

    def derivatives(self, coords: np.ndarray, remember: Remember = nothing_stored) -> Steps:
        """Derivatives of residuals by coordinates (n, n_structural), as numbers (n, n_structural) in the archive, from
        the model's own. Yields as `run`.
        """
        if self._whole is not self:
            return (yield from self._whole.derivatives(coords, remember))
        thetas, steps = self.parameters(coords), _STEP * np.eye(self.n_structural)
        (found,) = yield from self._stored("slopes of residuals", self.data.derivatives, thetas, remember)
        numbers = []
        for at, slopes in zip(coords, found, strict=True):
            by_coords = (self.parameters(at + steps) - self.parameters(at - steps)) / (2 * _STEP)
            numbers.append(self.archive.add_histories(np.tensordot(by_coords, slopes.astype(float), 1)))
        return np.array(numbers)

    def _stored(self, kind: str, function: Callable, thetas: np.ndarray, remember: Remember) -> Steps:
        """What a function of parameters returns, or what an earlier run has stored of it."""
        text = f"{kind} of {self.data.identity}".encode()
        key = hashlib.blake2b(text + thetas.tobytes(), digest_size=16).hexdigest()
        if (found := remember(key)) is None:
            computed = yield partial(function, thetas)
            found = remember(key, lambda: computed)
        return found

    # ------------------------------------------------------------------ the noise

    def log_likelihood(self, statistics: np.ndarray, coords: np.ndarray) -> np.ndarray:
        """Log-likelihood (n,) of statistics (n, n_numbers) at coordinates (n, n_noise) of the noise parameters."""
        return self.data.log_likelihood(statistics, coords if self._noise is None else self._noise.from_normal(coords))

    def noise_density(self, statistics: np.ndarray, coords: np.ndarray) -> np.ndarray:
        """Log-density (n,) of coordinates (n, n_noise) of the noise parameters, for one row of statistics."""
        repeated = np.broadcast_to(statistics, (len(coords), len(statistics)))
        return np.nan_to_num(self.log_likelihood(repeated, coords) + self.log_prior(coords), nan=-1e300)

    def fit_noise(self, statistics: np.ndarray, start: np.ndarray | None = None) -> NoiseFit:
        """Noise parameters that fit statistics (n_numbers,) best: nothing is simulated.

        The search begins at coordinates (n_noise,) near the result, or with a grid.
        """
        from scipy.optimize import minimize  # slow to import

        coords = np.zeros(self.n_noise) if start is None else start
        if not self.n_noise:
            return NoiseFit(coords, float(self.noise_density(statistics, coords[None])[0]))
        for width in _WIDTHS if start is None else ():
            for k in range(self.n_noise):
                trial = np.repeat(coords[None], len(_GRID), axis=0)
                trial[:, k] += width * _GRID
                coords = trial[np.argmax(self.noise_density(statistics, trial))]
        options = {"gtol": 1e-2, "eps": _STEP}
        found = minimize(lambda z: -self.noise_density(statistics, z[None])[0], coords, method="BFGS", options=options)
        return NoiseFit(found.x, -float(found.fun))

    def slopes(self, statistics: np.ndarray, coords: np.ndarray) -> np.ndarray:
        """Derivatives (n_numbers,) of the log-likelihood by the statistics, at fixed noise parameters."""
        # each by itself: channels in different units differ by any factor
        sizes, n = np.abs(statistics), len(statistics)
        steps = _STEP * np.where(sizes > 0.0, sizes, 1e-9 * sizes.max() or 1.0)
        shifted = np.concatenate([statistics + np.diag(steps), statistics - np.diag(steps * (sizes > 0.0))])
        values = self.log_likelihood(shifted, np.broadcast_to(coords, (2 * n, len(coords))))
        return (values[:n] - values[n:]) / np.diag(shifted[:n] - shifted[n:])  # sums of squares are nowhere below zero
