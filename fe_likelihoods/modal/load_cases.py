"""Static load tests: deflections, strains or rotations under several load cases, as data without time."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..models.function import FunctionModel
from ..signals.channels import Channel, Measurements
from ..signals.read import units_of
from ..signals.tables import read_table
from ..units import to_si

__all__ = ["LoadTest", "read_load_test"]


@dataclass(frozen=True, eq=False, repr=False)
class LoadTest:
    """Measured values under load cases, such as trucks at several places.

    The attribute ``measurements`` has a sample for each load case instead of a time. Any model whose response is
    (n_channels, n_cases), with ``dt=1`` and ``n_steps=len(cases)``, can be compared with them: a `FunctionModel`, an
    `ExecutableModel` whose output file has a line for each load case, or an `OpenSeesModel`.

    Parameters
    ----------
    channels : sequence of Channel
        The sensors.
    cases : sequence of str, or of float
        Names of the load cases, or numbers such as positions of a load.
    values : (n_channels, n_cases) array_like
        Measured values [SI]; NaN where one is missing.
    errors : mapping of str to float, optional
        Known standard deviations of sensors [SI], by the names of channels.
    axis : str
        What the load cases are, for figures, such as "position of the truck [m]".
    description : str
        What was measured, where and when.

    Raises
    ------
    ValueError
        If names repeat, a shape does not fit, or an error is not possible.

    Examples
    --------
    >>> from fe_likelihoods.modal.load_cases import LoadTest
    >>> midspan = Channel("midspan", "displacement", "mm")
    >>> test = LoadTest([midspan], ["truck at midspan", "two trucks"], [[0.0021, 0.0039]], errors={"midspan": 1e-4})
    >>> bridge = test.model(lambda theta: np.array([[0.002, 0.004]]) / theta[0], ["EI"])
    >>> Posterior(FELikelihood(bridge, test.measurements), {"EI": LogNormal(1.0, 0.3)} | test.known).parameter_names
    ['EI']
    """

    channels: Sequence[Channel]
    cases: Sequence[str | float]
    values: Any
    _: KW_ONLY
    errors: Mapping[str, float] | None = None
    axis: str = "load case"
    description: str = "load test"

    def __post_init__(self) -> None:
        channels, cases, errors = tuple(self.channels), tuple(self.cases), dict(self.errors or {})
        names = [channel.name for channel in channels]
        if isinstance(self.cases, str) or not cases or len(set(cases)) != len(cases):
            raise ValueError(f"LoadTest: expected different names of load cases; got {self.cases!r}")
        if bad := {name: each for name, each in errors.items() if name not in names or not 0.0 < each < np.inf}:
            raise ValueError(
                f"LoadTest: errors must be positive standard deviations [SI] of {', '.join(names)}; got {bad}"
            )
        measurements = Measurements(channels, 1.0, self.values, self.description, axis=self.axis, points=cases)
        found = {"channels": channels, "cases": cases, "values": measurements.values, "errors": errors}
        for name, value in (found | {"measurements": measurements}).items():
            object.__setattr__(self, name, value)

    @property
    def known(self) -> dict[str, float]:
        """Known errors as numbers for the mapping of priors: ``{"sigma_<channel>": error}``."""
        return {f"sigma_{name}": float(error) for name, error in self.errors.items()}

    def model(self, function: Callable[..., Any], parameter_names: Sequence[str], **options: Any) -> Any:
        """Model of a function of theta that returns (n_channels, n_cases) [SI], options of `FunctionModel`."""
        return FunctionModel(function, parameter_names, self.channels, 1.0, len(self.cases), **options)


def read_load_test(
    path: str | Path,
    channels: Sequence[Channel],
    columns: Mapping[str, str] | None = None,
    units: str | Sequence[str] | Mapping[str, str] | None = None,
    cases: str | None = None,
    errors: Mapping[str, float] | None = None,
) -> LoadTest:
    """Read a load test from a CSV file or workbook with a header line and a line for each load case.

    `columns` has names of columns by the names of channels, where the column has not the name of the channel (with or
    without a unit); `units` are for files that state none, as in `read_columns`. `cases` is the column with the
    names of the load cases, or with numbers such as positions; default: the first column, if it is no channel, else
    numbers from 1. `errors` are those of `LoadTest`. Raises ValueError if a column is missing, or a unit is unknown or
    not stated.
    """
    table = read_table(path, labels=cases or "")
    names = [column.name for column in table.columns]

    def column_of(channel: Channel) -> str:
        wanted = (columns or {}).get(channel.name, channel.name)
        found = [name for name in names if wanted in (name, re.sub(r"\s*[\[(].*", "", name).strip())]
        return found[0] if len(found) == 1 else wanted

    given = zip(channels, units_of(channels, units), strict=True)
    wanted = [(column_of(each), each.dimension, unit, each.name) for each, unit in given]
    values = [to_si(*each) for each in table.samples(wanted, stacklevel=2)]
    chosen = cases or next((name for name in names[:1] if name not in [each[0] for each in wanted]), None)
    options = {"errors": errors, "description": f"load test of {Path(path).name}"}
    if chosen is None:
        return LoadTest(channels, [str(k + 1) for k in range(len(table.lines))], values, **options)
    if chosen not in names:
        raise ValueError(f"{table.file}: no column {chosen!r} of load cases; the columns are {', '.join(names)}")
    column = table.columns[names.index(chosen)]
    if column.kind == "text" or np.isnan(column.values).any():  # names
        return LoadTest(channels, column.cells, values, **options)
    return LoadTest(channels, column.values.tolist(), values, axis=chosen, **options)
