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
from ..signals.text_files import dimension_of
from ..units import to_si


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
        Different names of the load cases, or numbers such as positions of a load.
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
        names, errors = [channel.name for channel in self.channels], self.errors or {}
        if isinstance(self.cases, str) or not len(self.cases) or len(set(self.cases)) != len(self.cases):
            raise ValueError(f"LoadTest: expected different names of load cases; got {self.cases!r}")
        if bad := {name: each for name, each in errors.items() if name not in names or not 0.0 < each < np.inf}:
            raise ValueError(
                f"LoadTest: errors must be positive standard deviations [SI] of {', '.join(names)}; got {bad}"
            )
        along = {"axis": self.axis, "points": tuple(self.cases)}
        measurements = Measurements(tuple(self.channels), 1.0, self.values, self.description, **along)
        object.__setattr__(self, "measurements", measurements)

    @property
    def known(self) -> dict[str, float]:
        """Known errors as numbers for the mapping of priors: ``{"sigma_<channel>": error}``."""
        return {f"sigma_{name}": float(error) for name, error in (self.errors or {}).items()}

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
    numbers from 1. `errors` are as in `LoadTest`. Raises ValueError if a column is missing, or a unit is unknown or
    not stated.
    """
    table, wanted = read_table(path, labels=cases or ""), []
    columns_of = {column.name: column for column in table.columns}
    for channel, unit in zip(channels, units_of(channels, units), strict=True):
        name = (columns or {}).get(channel.name, channel.name)
        ends = {each: re.fullmatch(rf"{re.escape(name)}(?:\s*[\[(].*|_(.+))?", each) for each in columns_of}
        named = [each for each, end in ends.items() if end and (end[1] is None or dimension_of(end[1]))]
        wanted.append((named[0] if len(named) == 1 else name, channel.dimension, unit, channel.name))
    values = [to_si(*each) for each in table.samples(wanted, stacklevel=2)]
    first = next(iter(columns_of))
    cases = cases or (None if first in [name for name, *_ in wanted] else first)
    if cases is not None and cases not in columns_of:
        raise ValueError(f"{table.file}: no column {cases!r} of load cases; the columns are {', '.join(columns_of)}")
    points, more = tuple(str(k + 1) for k in range(len(table.lines))), {}
    if cases is not None:
        column = columns_of[cases]
        are_names = column.kind == "text" or np.isnan(column.values).any()
        points, more = (column.cells, {}) if are_names else (tuple(column.values.tolist()), {"axis": cases})
    return LoadTest(channels, points, values, errors=errors, description=f"load test of {Path(path).name}", **more)
