"""A noise with known parameters: a number instead of a prior."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from ..signals.channels import Channel
from .option_checks import as_number
from .protocol import Noise, noise_title

# methods of a noise, by the place of the parameters among their arguments
_METHODS = {
    "log_likelihood": 2,
    "standard_deviations": 0,
    "deviations": 0,
    "deviations_per_event": 0,
    "lag_one_correlations": 0,
    "response_deviations": 0,
    "whitened": 2,
}
_AGAIN = "under", "with_measurements"  # methods that return the noise for other data
_OF_THE_NOISE = "channels", "statistic", "shares_of", "effective_samples", "counts", "n_sets", "student"


class KnownNoise:
    """Noise some of whose parameters are known numbers.

    Parameters
    ----------
    noise : Noise
        The noise.
    known : mapping of str to float
        Values of parameters by their names [as for the noise].

    Raises
    ------
    ValueError
        If a name is no parameter of the noise, or a value is not a finite number.

    Examples
    --------
    >>> noise = KnownNoise(GaussianNoise(model.channels), {"sigma_displacement": 0.002})
    """

    def __init__(self, noise: Noise, known: Mapping[str, float]) -> None:
        if unknown := [name for name in known if name not in noise.parameter_names]:
            raise ValueError(
                f"KnownNoise: {noise_title(noise)} has no parameters {', '.join(unknown)}; its parameters are "
                f"{', '.join(noise.parameter_names)}"
            )
        finite = "a finite number", np.isfinite
        self.noise = noise
        self.known = {name: as_number(self, name, value, *finite) for name, value in known.items()}
        self.parameter_names = tuple(name for name in noise.parameter_names if name not in self.known)

    def __repr__(self) -> str:
        return f"KnownNoise({self.noise!r}, {self.known!r})"

    @property
    def title(self) -> str:
        """Title of the noise, with the known values."""
        return f"{noise_title(self.noise)}, with {', '.join(f'{k} = {v:g}' for k, v in self.known.items())}"

    @property
    def parameter_channels(self) -> dict[str, Channel]:
        """Channels of the parameters that are standard deviations."""
        return {name: channel for name, channel in self.noise.parameter_channels.items() if name not in self.known}

    def complete(self, parameters: np.ndarray) -> np.ndarray:
        """All parameters (..., n_noise) of the noise, from the unknown ones."""
        parameters, places = np.asarray(parameters, dtype=float), iter(range(len(self.parameter_names)))
        columns = [
            np.full(parameters.shape[:-1], self.known[name]) if name in self.known else parameters[..., next(places)]
            for name in self.noise.parameter_names
        ]
        return np.stack(columns, axis=-1)

    def log_likelihood(self, statistics: np.ndarray, n_samples: Any, parameters: np.ndarray) -> np.ndarray:
        """Log-likelihood (n,), as of the noise."""
        return self.noise.log_likelihood(statistics, n_samples, self.complete(parameters))

    def __getattr__(self, name: str) -> Any:
        """Optional members of the noise, with all its parameters."""
        noise = vars(self).get("noise")
        if noise is None or name not in (*_METHODS, *_AGAIN, *_OF_THE_NOISE):
            raise AttributeError(f"{type(self).__name__} has no {name}")
        member = getattr(noise, name)
        if name in _AGAIN:
            return lambda *arguments: KnownNoise(member(*arguments), self.known)
        return partial(self._called, member, _METHODS[name]) if name in _METHODS else member

    def _called(self, method: Callable[..., Any], place: int, *arguments: Any, **keywords: Any) -> Any:
        given = list(arguments)
        given[place] = self.complete(given[place])
        return method(*given, **keywords)
