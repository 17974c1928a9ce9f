"""The posterior as modes and emulators need it: standard normal coordinates, responses, statistics, noise.

In the coordinates z of `Prior.from_normal` the prior is the standard normal, so bounds need no attention, the prior is
part of the least squares (its residuals are z), and every parameter has the same scale. The density of the posterior in
these coordinates is

    log p(z) = log phi(z) + log L(S(y - R(z)), eta(z)),

with the response R at the structural parameters, the statistics S of the residuals, and the noise parameters eta.
"""

import copy
import hashlib
import json
from collections.abc import Callable, Generator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from ..signals.durations import growing_durations
from ..simulation.model import most_responses
from .archive import Archive
from .data_sets import DataSets

__all__ = ["NoiseFit", "Remember", "ResponseTarget", "Runs", "Steps", "at_once", "nothing_stored"]

Remember = Callable[..., Sequence[np.ndarray] | None]  # `samplers.tempering.guide.GuideSession.remember`
Steps = Generator[Callable[[], Any] | float, Any, Any]  # functions to call, and costs of what was called

_HALF_LOG_TWO_PI = 0.5 * float(np.log(2.0 * np.pi))
_WIDTHS = 7.0, 3.0, 1.0, 0.3, 0.1  # half widths of the grids on which noise parameters are first searched
_WIDTHS_AROUND_START = 1.0, 0.1
_GRID = np.linspace(-1.0, 1.0, 41)
_SLOPE_STEP = 1e-4
SCALES = "parameters", "logarithms", "reciprocals"
_LARGEST_FACTOR = 30.0  # between the ends of the prior's central 95 %, up to which a parameter is a factor
_SMALLEST_SLOPE = 1e-6  # of a parameter by its coordinate, in units of its spread in the prior
_MAP_STEP = 1e-5  # of coordinates, for the derivatives of the parameters
_SMALL_STEP = 1e-4  # share of a step from which its direction in scaled parameters is found
_LOG_LIMITS = -690.0, 690.0
_SMALLEST = 1e-300  # positive parameters are at least this before their logarithm or reciprocal is taken
_AT_BOUND = 8.5  # from about 8.3, parameters are rounded to a bound that is not zero
_NOISE_STEP, _NOISE_SLOPE = 1e-3, 1e-2  # of noise coordinates: difference, and slope of the log-density at the best
_LARGE = 1e300
_MANY = 10_000  # runs of a pool whose size is not known


def _finite(coords: np.ndarray) -> np.ndarray:
    """Coordinates of parameters that were rounded to a bound of their prior are finite: `_AT_BOUND`."""
    return np.where(np.isinf(coords), np.copysign(_AT_BOUND, coords), coords)


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


def at_once(steps: Steps) -> Any:
    """Result of steps whose functions are called here."""
    answer = None
    while True:
        try:
            item = steps.send(answer)
        except StopIteration as end:
            return end.value
        answer = item() if callable(item) else None


class ResponseTarget:
    """A posterior in standard normal coordinates, first the structural ones, and its `archive` of simulations.

    ValueError as for `DataSets`, whose `model`, `measured`, `statistic` and `with_gaps` these are. `differentiable`
    says whether the model has a method ``jacobian``; `unchecked` is not empty until its derivatives have been compared
    with a difference, and is shared with `shortened` targets; `scales` (n_channels,) are the standard deviations of
    the measured channels [SI], 1 for a constant channel.
    """

    def __init__(self, posterior: Any) -> None:
        self.posterior = posterior
        self._prior = posterior.prior
        self._data = DataSets(posterior.likelihood)
        self.model, self.measured, self.statistic = self._data.model, self._data.measured, self._data.statistic
        self.with_gaps = self._data.with_gaps
        self.ndim, self.n_structural = posterior.ndim, len(self.model.parameter_names)
        self.n_noise = self.ndim - self.n_structural
        self.n_steps = self.measured.shape[1]
        low, self._median, high = self._prior.from_normal(np.array([[-2.0], [0.0], [2.0]]) * np.ones(self.ndim))
        logarithmic = np.array(self._prior.logarithmic)
        factors = (low > 0.0) & (high < _LARGEST_FACTOR * low)  # the prior keeps them away from zero
        nothing = np.zeros(self.ndim, bool)
        self._scales = {
            "parameters": (logarithmic, nothing),
            "logarithms": (logarithmic | factors, nothing),
            "reciprocals": (logarithmic & ~factors, factors),
        }
        self._noise_prior = self._prior_of_noise()
        # of the noise coordinates over the noise parameters, at the median
        self._median_volume = 0.0
        if self._noise_prior is not None:
            zero, at = np.zeros((1, self.n_noise)), self._median[None, self.n_structural :]
            self._median_volume = float(np.squeeze(self._noise_prior.logpdf(at)) - self.log_prior(zero)[0])
        elif self.n_noise:  # the volume of structural parameters alone is not known
            self._scales = dict.fromkeys(self._scales, (nothing, nothing))
        self._logarithmic, self._reciprocal = self._columns("logarithms")
        self.archive = Archive(self.statistic, self.measured.shape)
        self._simulated: set[bytes] = set()
        self.differentiable, self.kinds = self._data.differentiable, self._data.kinds
        self.unchecked = [True] if self.differentiable else []
        self.scales = np.nanstd(self.measured, axis=1)
        self.scales[self.scales == 0.0] = 1.0
        pools = [part.simulator.pool for part, _ in posterior.likelihood.parts()]
        sizes = [1 if pool is None else getattr(pool, "n_workers", None) or _MANY for pool in pools]
        self._together = max(most_responses(self.model), *sizes)  # runs whose responses are in memory at once

    def shortened(self, shares: Sequence[float]) -> list["ResponseTarget"]:
        """The same posterior for the first parts of the record, the shortest first; none if the model has no ``first``.

        The shares are of the Arias intensity, at which the parts end.
        """
        if not hasattr(self.model, "first"):
            return []
        # differences, because a residual displacement is not motion
        likelihood = self.posterior.likelihood
        steps, measurements = np.diff(self.measured, axis=1), likelihood.measurements
        if self.with_gaps:
            if not measurements.simultaneous:
                return []
            missing = likelihood.measured.missing
            steps[missing[:, 1:] | missing[:, :-1]] = 0.0
        parts = []
        for seconds in growing_durations(steps, measurements.dt, shares)[:-1] if steps.any() else ():
            try:
                parts.append(self.posterior.first(measurements.start + seconds))
            except ValueError:
                if not self.with_gaps:
                    raise  # else a channel has no sample in this part
        targets = [ResponseTarget(part) for part in parts]
        for target in targets:
            target.unchecked = self.unchecked
        return targets

    # ------------------------------------------------------------------ coordinates

    def parameters(self, coords: np.ndarray) -> np.ndarray:
        """Parameters (n, ndim) at coordinates (n, ndim)."""
        return self._prior.from_normal(coords)

    def coordinates(self, parameters: np.ndarray) -> np.ndarray:
        """Coordinates (n, ndim) of parameters (n, ndim)."""
        return _finite(self._prior.to_normal(parameters))

    def _to_coordinates(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (n, ndim) of parameters, and the logarithm (n,) of their volume over the parameters' volume.

        The logarithm is -inf outside the support of the prior.
        """
        coords, log_volume = self.coordinates(parameters), np.full(len(parameters), -np.inf)
        log_prior = np.atleast_1d(self._prior.logpdf(parameters))
        inside = np.isfinite(coords).all(axis=1) & np.isfinite(log_prior)
        log_volume[inside] = log_prior[inside] - self.log_prior(coords[inside])
        return coords, log_volume

    def density_of_parameters(
        self, log_density: Callable[[np.ndarray], np.ndarray], parameters: np.ndarray
    ) -> np.ndarray:
        """Log-density (n,) of parameters (n, ndim), from a log-density of coordinates; -inf outside the support."""
        coords, result = self._to_coordinates(parameters)
        inside = np.flatnonzero(result > -np.inf)
        if len(inside):
            result[inside] += log_density(coords[inside])
        return result

    def at_median_noise(self, coords: np.ndarray) -> np.ndarray:
        """Parameters (n, ndim) at structural coordinates (n, n_structural)."""
        full = np.zeros((len(coords), self.ndim))
        full[:, : self.n_structural] = coords
        return self._prior.from_normal(full)

    def structural_parameters(self, coords: np.ndarray) -> np.ndarray:
        """Structural parameters (n, n_structural) at coordinates (n, n_structural)."""
        return self.at_median_noise(coords)[:, : self.n_structural]

    def _prior_of_noise(self) -> Any:
        """Prior of the noise parameters; None without any, or if they have a joint distribution with structural ones.

        The noise is fitted thousands of times, and the map of all parameters takes most of that time.
        """
        names = self._prior.names[self.n_structural :]
        try:
            return self._prior.subset(names) if names else None
        except ValueError:
            return None

    def _noise_parameters(self, coords: np.ndarray) -> np.ndarray:
        """Noise parameters (n, n_noise) at coordinates (n, n_noise)."""
        if self._noise_prior is not None:
            return self._noise_prior.from_normal(coords)
        full = np.zeros((len(coords), self.ndim))
        full[:, self.n_structural :] = coords
        return self._prior.from_normal(full)[:, self.n_structural :]

    def structural_coordinates(self, thetas: np.ndarray) -> np.ndarray:
        """Coordinates (n, n_structural) of structural parameters (n, n_structural)."""
        full = np.repeat(self._median[None], len(thetas), axis=0)
        full[:, : self.n_structural] = thetas
        return _finite(self._prior.to_normal(full)[:, : self.n_structural])

    def in_scale(self, name: str) -> "ResponseTarget":
        """The same target and archive, with scaled parameters that are one of `SCALES` where the prior is off zero.

        Other parameters are not transformed, except that those with a lognormal prior are logarithms.
        """
        other = copy.copy(self)
        other._logarithmic, other._reciprocal = self._columns(name)
        return other

    def _columns(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Columns of structural parameters whose logarithms and reciprocals a scale takes."""
        logarithmic, reciprocal = (np.flatnonzero(each[: self.n_structural]) for each in self._scales[name])
        return logarithmic, reciprocal

    def scaled_parameters(self, coords: np.ndarray) -> np.ndarray:
        """Structural parameters (n, n_structural), or a function of those that the prior keeps away from zero.

        A product of parameters, such as a stiffness E I, is linear in logarithms. Displacements of springs in series
        are linear in reciprocals, whose sign is changed so that they increase with the parameter. Responses are smooth
        functions of these, but not of the coordinates, which go to infinity as a parameter goes to a prior bound.
        """
        parameters = self.structural_parameters(coords)
        parameters[:, self._logarithmic] = np.log(np.maximum(parameters[:, self._logarithmic], _SMALLEST))
        parameters[:, self._reciprocal] = -1.0 / np.maximum(parameters[:, self._reciprocal], _SMALLEST)
        return parameters

    def line(self, first: np.ndarray, last: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """Coordinates (n, n_structural) at shares (n,) of the way from one point to another, in scaled parameters."""
        ends = self.scaled_parameters(np.stack([first, last]))
        return self._from_scaled(ends[0] + shares[:, None] * (ends[1] - ends[0]))

    def _from_scaled(self, scaled: np.ndarray) -> np.ndarray:
        """Coordinates (n, n_structural) of scaled parameters (n, n_structural), which are overwritten."""
        scaled[:, self._logarithmic] = np.exp(scaled[:, self._logarithmic])
        scaled[:, self._reciprocal] = -1.0 / np.minimum(scaled[:, self._reciprocal], -_SMALLEST)
        return self.structural_coordinates(scaled)

    def moved(self, coords: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Coordinates (n, n_structural) after steps (n, n_structural) that are straight in scaled parameters.

        Along a ridge of equal products, such steps keep the product. Where a coordinate would move by another multiple
        of its step than 0.3 to 3, as at a bound of the prior, the step is straight in the coordinates.
        """
        here = self.scaled_parameters(coords[None])
        slopes = (self.scaled_parameters(coords + _SMALL_STEP * steps) - here) / _SMALL_STEP
        reached = self._from_scaled(here + slopes)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = (reached - coords) / steps
        return np.where((ratio > 0.3) & (ratio < 3.0), reached, coords + steps)

    def scale_slopes(self, coords: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """Derivatives (n_structural,) of scaled parameters by their coordinates, over a spread (n_structural,).

        On a bound of the prior they can vanish, where any scale will do.
        """
        below, low, high, above = self.scaled_parameters(
            np.stack([-np.ones_like(coords), coords - spread, coords + spread, np.ones_like(coords)])
        )
        return np.maximum((high - low) / (2.0 * spread), _SMALLEST_SLOPE * (above - below))

    def region_in_scaled(self, centre: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centre (k,) and covariance (k, k) of coordinates, structural ones first, in scaled parameters."""
        slopes, d = np.ones(len(centre)), self.n_structural
        slopes[:d] = self.scale_slopes(centre[:d], np.sqrt(np.diag(covariance)[:d]))
        return self.scaled(centre[None])[0], covariance * np.outer(slopes, slopes)

    def scaled(self, coords: np.ndarray) -> np.ndarray:
        """Scaled parameters and noise coordinates (n, ndim) at coordinates (n, ndim): a ridge is straight in them."""
        return np.column_stack([self.scaled_parameters(coords[:, : self.n_structural]), coords[:, self.n_structural :]])

    def unscaled(self, scaled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (n, ndim) at scaled ones, and the logarithm (n,) of their volume over the scaled volume.

        The logarithm is -inf outside the support of the prior.
        """
        d = self.n_structural
        full = np.repeat(self._median[None], len(scaled), axis=0)
        full[:, :d] = scaled[:, :d]
        full[:, self._logarithmic] = np.exp(np.clip(full[:, self._logarithmic], *_LOG_LIMITS))
        possible = (full[:, self._reciprocal] < 0.0).all(axis=1)
        full[:, self._reciprocal] = -1.0 / np.minimum(full[:, self._reciprocal], -_SMALLEST)
        coords, log_volume = self._to_coordinates(full)
        coords[:, d:] = scaled[:, d:]
        stretch = np.log(full[:, self._logarithmic]).sum(axis=1)
        stretch += 2.0 * np.log(full[:, self._reciprocal]).sum(axis=1)
        return coords, np.where(possible, log_volume + stretch, -np.inf) - self._median_volume

    def log_prior(self, coords: np.ndarray) -> np.ndarray:
        """Standard normal log-density (n,) of coordinates (n, k)."""
        return -0.5 * np.square(coords).sum(axis=-1) - _HALF_LOG_TWO_PI * coords.shape[-1]

    # ------------------------------------------------------------------ simulations

    def new_points(self, coords: np.ndarray) -> int:
        """Number of structural coordinates (n, n_structural) that `run` has not simulated yet."""
        return len({row.tobytes() for row in coords} - self._simulated)

    def run(
        self, coords: np.ndarray, remember: Remember = nothing_stored, thetas: np.ndarray | None = None
    ) -> Generator[Callable[[], Any], Any, Runs]:
        """Simulate structural coordinates (n, n_structural), whose parameters are `thetas` if given, for the archive.

        Yields what is to be called, and is sent the result, so that no search stands between a sampler and a model.
        Residuals are rounded to single precision, in which they are stored, so that a resumed run is the same.
        """
        if thetas is None:
            self._simulated.update(row.tobytes() for row in coords)
            thetas = self.structural_parameters(coords)
        text, parts = f"residuals of {self._data.identity}".encode(), []  # files of earlier versions have responses
        for k in range(0, max(len(thetas), 1), self._together):
            some = thetas[k : k + self._together]
            key = hashlib.blake2b(text + some.tobytes(), digest_size=16).hexdigest()
            if (found := remember(key)) is None:
                simulated = yield partial(self._data.simulate, some)
                found = remember(key, lambda simulated=simulated: simulated)
            residuals, statistics, reasons = found
            self._data.recall(some, statistics, json.loads(reasons.tobytes().decode()))
            failed = ~(np.isfinite(residuals).all(axis=(1, 2)) & np.isfinite(statistics).all(axis=1))
            numbers = np.full(len(failed), -1)
            of_success = coords[k : k + self._together][~failed], residuals[~failed], statistics[~failed]
            numbers[~failed] = self.archive.add(*of_success)
            parts.append(Runs(numbers, statistics, failed))
        return Runs(*map(np.concatenate, zip(*parts, strict=True)))

    def derivatives(
        self, coords: np.ndarray, remember: Remember = nothing_stored
    ) -> Generator[Callable[[], Any], Any, np.ndarray]:
        """Derivatives of residuals by coordinates (n, n_structural), as numbers (n, n_structural) in the archive.

        They are the model's own derivatives times those of the parameters by the coordinates; in single precision, as
        residuals. Yields as `run`.
        """
        numbers = []
        size = max(1, self._together // self.n_structural)
        for k in range(0, len(coords), size):
            found = yield from self._derivatives(coords[k : k + size], remember)
            numbers += [self.archive.add_histories(each) for each in found]
        return np.array(numbers)

    def _derivatives(self, coords: np.ndarray, remember: Remember) -> Generator[Callable[[], Any], Any, np.ndarray]:
        n, d = coords.shape
        thetas = self.structural_parameters(coords)

        text = f"derivatives of {self.model.fingerprint}".encode()
        key = hashlib.blake2b(text + thetas.tobytes(), digest_size=16).hexdigest()
        if (stored := remember(key)) is None:
            computed = yield partial(self._data.derivatives, thetas)
            stored = remember(key, lambda: [computed])
        (found,) = stored
        moved = coords[:, None] + _MAP_STEP * np.stack([np.eye(d), -np.eye(d)])[:, None]
        ahead, behind = self.structural_parameters(moved.reshape(-1, d)).reshape(2, n, d, d)
        by_coords = np.einsum("nzp,npct->nzct", (ahead - behind) / (2.0 * _MAP_STEP), found.astype(float))
        return self._data.of_residuals(by_coords)

    # ------------------------------------------------------------------ the noise

    def log_likelihood(self, statistics: np.ndarray, coords: np.ndarray) -> np.ndarray:
        """Log-likelihood (n,) of statistics (n, n_numbers) at coordinates (n, n_noise) of the noise parameters."""
        parameters = self._noise_parameters(coords) if self.n_noise else coords
        return self._data.log_likelihood(statistics, parameters)

    def _noise_density(self, statistics: np.ndarray, coords: np.ndarray) -> np.ndarray:
        """Log-likelihood and log-prior (n,) of coordinates (n, n_noise) at the same statistics (n_numbers,)."""
        repeated = np.broadcast_to(statistics, (len(coords), len(statistics)))
        return self.log_likelihood(repeated, coords) + self.log_prior(coords)

    def fit_noise(self, statistics: np.ndarray, start: np.ndarray | None = None) -> NoiseFit:
        """Noise parameters that fit statistics (n_numbers,) best: nothing is simulated.

        The search begins at coordinates (n_noise,) near the result, such as the best ones of a neighbour, or with a
        grid.
        """
        if not self.n_noise:
            return NoiseFit(np.zeros(0), float(self._noise_density(statistics, np.zeros((1, 0)))[0]))
        coords = np.zeros(self.n_noise) if start is None else start
        for width in _WIDTHS if start is None else _WIDTHS_AROUND_START:
            for k in range(self.n_noise):
                trial = np.repeat(coords[None], len(_GRID), axis=0)
                trial[:, k] += width * _GRID
                coords = trial[np.argmax(self._noise_density(statistics, trial))]
        offsets = _NOISE_STEP * np.concatenate(
            [np.zeros((1, self.n_noise)), *np.eye(self.n_noise) * [[[1.0]], [[-1.0]]]]
        )

        def loss(at: np.ndarray) -> tuple[float, np.ndarray]:
            values = np.nan_to_num(-self._noise_density(statistics, at + offsets), nan=_LARGE, posinf=_LARGE)
            ahead, behind = np.split(values[1:], 2)
            return float(values[0]), (ahead - behind) / (2.0 * _NOISE_STEP)

        found = minimize(loss, coords, jac=True, method="BFGS", options={"gtol": _NOISE_SLOPE})
        return NoiseFit(found.x, -float(found.fun))

    def slopes(self, statistics: np.ndarray, coords: np.ndarray) -> np.ndarray:
        """Derivatives (n_numbers,) of the log-likelihood by the statistics, at fixed noise parameters."""
        width = len(statistics)
        sizes = np.abs(statistics)  # each by itself: channels in different units differ by any factor
        steps = _SLOPE_STEP * np.where(sizes > 0.0, sizes, 1e-9 * sizes.max())
        shifted = np.concatenate([statistics + np.diag(steps), statistics - np.diag(steps)])
        values = self.log_likelihood(shifted, np.broadcast_to(coords, (2 * width, self.n_noise)))
        return (values[:width] - values[width:]) / (2.0 * steps)
