"""Static load tests: deflections, strains or rotations under several load cases, as data without time."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from ..models.function import FunctionModel
from ..signals.channels import Channel, Measurements
from ..text_tables import text_table
from ..units import from_si

__all__ = ["LoadTest"]


@dataclass(frozen=True, eq=False, repr=False)
class LoadTest:
    """Measured values under load cases, such as trucks at several places.

    Its measurements have a sample for each load case instead of a time. Any model whose response is (n_channels,
    n_cases), with ``dt=1`` and ``n_steps=len(cases)``, can be compared with them: a `FunctionModel`, an
    `ExecutableModel` whose output file has a line for each load case, or an `OpenSeesModel`.

    Parameters
    ----------
    channels : sequence of Channel
        The sensors.
    cases : sequence of str
        Names of the load cases.
    values : (n_channels, n_cases) array_like
        Measured values [SI]; NaN where one is missing.
    errors : mapping of str to float, optional
        Known standard deviations of sensors [SI], by the names of channels.

    Raises
    ------
    ValueError
        If names repeat, the shape does not fit, or an error is of no channel or not positive.

    Examples
    --------
    >>> test = LoadTest(channels, ["truck at midspan", "truck at quarter point"], to_si(deflections, "mm"))
    >>> model = test.model(deflection, ("EI",))
    >>> posterior = Posterior(FELikelihood(model, test.measurements), {"EI": LogNormal(1.0, 0.3)} | test.known)
    """

    channels: Sequence[Channel]
    cases: Sequence[str]
    values: Any
    _: KW_ONLY
    errors: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        channels, cases = tuple(self.channels), tuple(map(str, self.cases))
        errors, names = dict(self.errors or {}), [channel.name for channel in channels]
        if isinstance(self.cases, str) or not cases or len(set(cases)) != len(cases):
            raise ValueError(f"LoadTest: expected different names of load cases; got {self.cases!r}")
        values = Measurements(channels, 1.0, self.values).values
        if values.shape[1] != len(cases):
            raise ValueError(f"LoadTest: expected a value for each of {len(cases)} load cases; got {values.shape[1]}")
        if bad := [name for name, error in errors.items() if name not in names or not 0.0 < error < np.inf]:
            raise ValueError(
                f"LoadTest: errors must be positive standard deviations [SI] of {', '.join(names)}; got "
                f"{', '.join(f'{name}: {errors[name]!r}' for name in bad)}"
            )
        for name, value in (("channels", channels), ("cases", cases), ("values", values), ("errors", errors)):
            object.__setattr__(self, name, value)

    @property
    def measurements(self) -> Measurements:
        """The values as measurements with one step per load case."""
        return Measurements(self.channels, 1.0, self.values, "load test", axis="load case", points=self.cases)

    @property
    def known(self) -> dict[str, float]:
        """Known errors as numbers for the mapping of priors: ``{"sigma_<channel>": error}``."""
        return {f"sigma_{name}": float(error) for name, error in self.errors.items()}

    def model(self, function: Callable[..., Any], parameter_names: Sequence[str], **options: Any) -> FunctionModel:
        """Model of a function of theta that returns (n_channels, n_cases) [SI], options of `FunctionModel`."""
        return FunctionModel(function, parameter_names, self.channels, 1.0, len(self.cases), **options)

    def table(self, response: Any) -> str:
        """Measured and computed values (n_channels, n_cases) in the units of the channels, as text."""
        response = np.reshape(response, self.values.shape)
        rows = [["load case", *(f"{c.name} [{c.unit}]{end}" for c in self.channels for end in ("", " computed"))]]
        for place, case in enumerate(self.cases):
            pairs = zip(self.values[:, place], response[:, place], self.channels, strict=True)
            shown = [float(from_si(x, c.unit, c.dimension)) for one, other, c in pairs for x in (one, other)]
            rows.append([case, *(f"{x:.4g}" for x in shown)])
        return text_table(rows)
