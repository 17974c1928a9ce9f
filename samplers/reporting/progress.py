"""Progress of a run: a bar of tqdm in a terminal or a notebook, a line per minute where stderr is neither.

The bar names the latest stage, and shows what a user asks first from left to right: the time left, beta, the
log-evidence so far, failures. A narrow terminal cuts off the rest. Evaluations, simulations and failures are those
since the bar began, for the annealing or for the sweeps that its label names. It advances with every evaluated point.
After the first stage it also shows how many points are expected in all (`samplers.tempering.expected_cost`: a model of
the stages that are left, whose growth and cost are those of the stages so far). `left` is the time for the low and the
high end of that range, at the mean rate of this process so far. Seven to nine of ten runs end within it. It does not
foresee that recycling is given up, nor a change of the rate.
"""

import contextlib
import logging
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from types import TracebackType
from typing import Any

import emcee.pbar

from ..storage.evaluation import Evaluator
from ..tempering.expected_cost import Expected, expected_left
from ..tempering.population import GuideTick, Population, Report, Restart, Stage, Sweep
from ..tempering.results import AnnealingResult
from ..tempering.settings import Settings
from .messages import messages_above

__all__ = ["ANNEALING", "SWEEPS", "Progress", "as_duration", "get_progress_bar", "show_sweeps"]

logger = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 60.0
SECONDS_BETWEEN_FIGURES = 0.1
ANNEALING = "annealing"
SWEEPS = "sweeps at beta = 1"
# figures of the bar, the most important ones first: the width of a terminal ends them
ORDER = (
    *("left", "beta", "log Z", "failures", "ESS", "acceptance"),
    *("evaluations", "simulations", "running", "busy", "per hour"),
)


class _Lines:
    """A file for tqdm: each state of the bar is a line of the log, or of stderr where the log does not show INFO."""

    def __init__(self) -> None:
        self._last = ""

    def write(self, text: str) -> None:
        """Write a state without its control characters, if it has changed."""
        line = text.strip()
        if not line or line == self._last:
            return
        self._last = line
        if logger.isEnabledFor(logging.INFO):
            logger.info("%s", line)
        else:
            sys.stderr.write(line + "\n")
            sys.stderr.flush()

    def flush(self) -> None:
        """Lines are flushed as they are written."""


def get_progress_bar(display: bool | str, total: int | None, **kwargs: Any) -> Any:
    """A bar of tqdm, or emcee's silent one.

    Its attribute ``formats`` has the formats with and without a known total, unless the user gives a format.

    Parameters
    ----------
    display : bool or str
        False: no bar. True: tqdm's own for a terminal or a notebook; elsewhere the first and the last state and at most
        one line per minute, in the log at level INFO, or on stderr if that level is not enabled. A str: the bar of this
        name, as in emcee.
    total : int, optional
        Number of steps, if it is known.
    **kwargs
        Arguments of the bar.
    """
    if display is not True:
        return emcee.pbar.get_progress_bar(display, total, **kwargs)
    from tqdm import tqdm as terminal_bar
    from tqdm.auto import tqdm

    # tqdm.auto is a subclass of the bar of terminals or of that of notebooks
    in_notebook = tqdm.display is not terminal_bar.display
    part = "|{bar}|" if in_notebook else "|{bar:5}|"
    if not in_notebook and "file" not in kwargs and not sys.stderr.isatty():
        rare = {"mininterval": SECONDS_BETWEEN_LINES, "maxinterval": SECONDS_BETWEEN_LINES}
        kwargs, part = rare | kwargs | {"file": _Lines()}, ""
    counts = "{n_fmt}/{total_fmt}{unit} [{elapsed}{postfix}]"
    formats = f"{{desc}}: {{percentage:3.0f}}%{part} {counts}", "{desc}: {n_fmt}{unit} [{elapsed}{postfix}]"
    if "bar_format" in kwargs:
        return tqdm(total=total, **({"miniters": 0} | kwargs))
    bar = tqdm(total=total, **({"miniters": 0, "bar_format": formats[total is None]} | kwargs))
    bar.formats = formats
    return bar


def as_duration(low: float, high: float) -> str:
    """Two durations [s] as text, in a unit that suits the larger one: "about 2.1 to 3.4 h"."""
    size, unit = next(
        ((s, u) for s, u in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")) if high >= 2.0 * s), (1.0, "s")
    )
    first, last = (f"{value / size:.2g}" if value < 99.5 * size else f"{value / size:.0f}" for value in (low, high))
    return f"about {first} {unit}" if first == last else f"about {first} to {last} {unit}"


class Progress:
    """What a bar shows of a run: an observer of an `Evaluator`, to which it is attached as a context manager.

    Parameters
    ----------
    bar : tqdm bar, or emcee's silent one
        The bar.
    evaluator : Evaluator
        Evaluates the points.
    label : str
        Description of the bar, outside the phases of a guide.
    function : callable
        The posterior. Its method ``report()``, if it has one, gives ``simulations`` and ``failure_count``; its method
        ``when_simulated(callback)`` announces simulations of a batch as they end.
    settings : Settings, optional
        Those of an annealing whose number of evaluations can be expected; None: it is not known.
    size : (int, int)
        Numbers of walkers and parameters.
    counts_points : bool
        Whether the bar counts points; else it is advanced by `step` and `show` only.
    """

    def __init__(
        self,
        bar: Any,
        evaluator: Evaluator,
        label: str,
        function: Callable,
        settings: Settings | None,
        size: tuple[int, int],
        counts_points: bool = True,
    ):
        self._bar, self._evaluator, self._label, self._settings = bar, evaluator, label, settings
        self._size, self._counts_points = size, counts_points
        self._report: Callable[[], Mapping[str, Any]] | None = getattr(function, "report", None)
        self._announce: Callable | None = getattr(function, "when_simulated", None)
        self._open_queue: Callable | None = getattr(function, "evaluation_queue", None)
        self._silent = not hasattr(bar, "set_postfix")  # emcee's silent bar has only update
        self._recycling = settings is not None and bool(settings.recycle)
        self._figures: dict[str, str] = {}
        self._left: Expected | None = None  # after the latest stage, which ended with `_done_at_stage` points
        self._done_at_stage = self._done = self._running = self._new = self._shown = 0
        self._part = 0.0  # of a point: simulations of a point that has several
        self._begun = self._changed = self._drawn = time.perf_counter()
        self._busy, self._workers = 0.0, 0  # time of all workers [s], and their number; 0: not known
        self._guided = False
        self._messages = contextlib.ExitStack()
        self._simulations_before, self._failures_before = self._reported().get("simulations", 0), self._failures()

    def __enter__(self) -> "Progress":
        if not self._silent:
            self._messages.enter_context(messages_above(self._bar))
            self._workers = self._known_workers()
            self._evaluator.observer = self
            if self._announce is not None and not self._evaluator.asynchronous:
                self._announce(self._simulated)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if not self._silent:
            self._evaluator.observer = None
            if self._announce is not None:
                self._announce(None)
            if kind is None and self._settings is not None:
                self._left, self._done_at_stage = Expected(0.0, 0.0, 0.0), self._done
            self._messages.close()
            self._draw(0)

    def _known_workers(self) -> int:
        workers = self._evaluator.known_workers
        if workers is None and self._evaluator.pool is None and self._open_queue is not None:
            queue = self._open_queue()
            workers = queue.workers
            queue.close()
        return workers or 0

    # what the evaluator reports -----------------------------------------------------------------------------------

    def repeated(self, points: int) -> None:
        """Points of the interrupted run were taken from its journal."""
        self._done += points
        self._advance()

    def submitted(self, points: int) -> None:
        """Points begin to be evaluated, or wait for a worker."""
        self._count_time()
        self._running += points
        self._advance()

    def finished(self, points: int) -> None:
        """Points have been evaluated."""
        self._count_time()
        points = min(points, self._running)
        self._running -= points
        self._done += points
        self._new += points
        self._advance()

    def settled(self) -> None:
        """All points that were submitted have been evaluated."""
        self.finished(self._running)

    def _simulated(self, points: float) -> None:
        """Simulations have ended; those of a batch belong to points that were submitted."""
        self._part += points if self._running > 0 else 0.0
        whole = int(self._part + 1e-9)
        self._part -= whole
        self.finished(whole)

    # what the sampler reports -------------------------------------------------------------------------------------

    def show(self, result: AnnealingResult, population: Population, report: Report) -> None:
        """Show a report of the annealing."""
        if self._silent:
            return
        if isinstance(report, Sweep) or (isinstance(report, Stage) and self._counts_points):
            self._figures = {"beta": f"{population.beta:.3g}", "ESS": f"{population.effective_sample_size:.0f}"}
            self._figures["acceptance"] = f"{report.acceptance:.2f}"
            if result.ladder:
                self._figures["log Z"] = f"{sum(stage.log_evidence_increment for stage in result.ladder):.2f}"
        if isinstance(report, Sweep) or (isinstance(report, Stage) and not self._guided):
            self._name_stage(result)
        if isinstance(report, Restart | Sweep | GuideTick):
            self._guided = isinstance(report, GuideTick)
        if isinstance(report, Restart):
            self._recycling, self._left = False, None
        elif isinstance(report, Stage) and self._settings is not None:
            self._left, self._done_at_stage = None, self._done
            if report.beta < 1.0 or not self._recycling:
                choice = self._settings, *self._size, self._recycling
                self._left = expected_left(*choice, report.beta, result.ladder)
        elif isinstance(report, GuideTick):
            effective = f"{population.effective_sample_size:.0f}/{report.target}"
            self._figures = {"simulations": f"{report.simulations:.6g}", "ESS": effective}
            if result.rounds:
                self._figures["log Z"] = f"{result.rounds[-1].log_evidence:.2f}"
            self._bar.set_description_str(f"guide: {report.phase}", refresh=False)
            self._draw(int(report.finished), refresh=not report.finished)  # before a batch, which may take minutes
        elif isinstance(report, Sweep):
            self._draw(1)

    def _name_stage(self, result: AnnealingResult) -> None:
        own = "" if self._label == ANNEALING else f"{self._label}, "  # a label of the user is kept
        self._bar.set_description_str(
            f"{own}stage {len(result.ladder)}" if result.ladder else self._label, refresh=False
        )

    def step(self, steps: int) -> None:
        """Advance a bar that does not count points."""
        if self._silent:
            self._bar.update(steps)
        else:
            self._draw(steps)

    # the bar ------------------------------------------------------------------------------------------------------

    def _count_time(self) -> None:
        now = time.perf_counter()
        self._busy += min(self._running, self._workers) * (now - self._changed)
        self._changed = now

    def _advance(self) -> None:
        if time.perf_counter() - self._drawn >= SECONDS_BETWEEN_FIGURES:
            self._draw(0)

    def _draw(self, steps: int, refresh: bool = False) -> None:
        """Show the figures, and advance the bar by steps, or by the points since the last time."""
        self._drawn = time.perf_counter()
        left, total = self._still_expected(), getattr(self._bar, "total", None)
        if self._counts_points:
            steps, self._shown = self._done - self._shown, self._done
            self._set_total(None if left is None else self._done + round(left.likely))
        figures = self._figures | self._counts(left)
        made = getattr(self._bar, "n", 0) + steps
        if not self._counts_points and total and 0 < made < total:
            figures["left"] = as_duration(*2 * ((self._drawn - self._begun) * (total - made) / made,))
        self._bar.set_postfix({name: figures[name] for name in ORDER if name in figures}, refresh=refresh)
        if not refresh or steps > 0:
            self._bar.update(steps)

    def _set_total(self, total: int | None) -> None:
        self._bar.total = total
        if hasattr(self._bar, "formats"):
            self._bar.bar_format = self._bar.formats[not total]
        container = getattr(self._bar, "container", None)
        if container is not None and total:  # of a notebook, whose bar has a total of its own
            widget = container.children[1]
            widget.max, widget.bar_style, widget.layout.width = total, "", None

    def _still_expected(self) -> Expected | None:
        """The range after the latest stage, less what was evaluated since."""
        if self._left is None:
            return None
        since = self._done - self._done_at_stage
        return Expected(*(max(value - since, 0.0) for value in self._left))

    def _counts(self, left: Expected | None) -> dict[str, str]:
        """Figures that change with every point."""
        seconds, reported = max(self._drawn - self._begun, 1e-9), self._reported()
        figures = {"evaluations": str(self._done)} if self._done > 0 and not self._counts_points else {}
        made = self._new
        if "simulations" in reported:
            made = reported["simulations"] - self._simulations_before
            figures |= {} if "simulations" in self._figures else {"simulations": str(made)}
        if self._running > 0:
            figures["running"] = str(self._running)
        if made > 0:
            figures["per hour"] = f"{3600.0 * made / seconds:.3g}"
        if self._workers > 1:
            figures["busy"] = f"{100.0 * self._busy / (self._workers * seconds):.0f} %"
        failures = self._failures() - self._failures_before
        if failures > 0:
            figures["failures"] = str(failures)
        if left is not None and left.high > 0.0 and self._new > 0:
            pace = seconds / self._new
            figures["left"] = as_duration(pace * left.low, pace * left.high)
        return figures

    def _failures(self) -> int:
        """Failed evaluations of the run, and failed simulations of this process, so far."""
        return self._evaluator.failures.count + self._reported().get("failure_count", 0)

    def _reported(self) -> Mapping[str, Any]:
        return {} if self._report is None else self._report()


def show_sweeps(
    states: Iterator[Any],
    bar: Mapping[str, Any],
    sweeps: int | None,
    per_state: int,
    evaluator: Evaluator,
    function: Callable,
    size: tuple[int, int],
) -> Iterator[Any]:
    """Pass on the states of a chain, each of which takes `per_state` sweeps, and show how many of `sweeps` are made.

    Parameters
    ----------
    states : iterator of State
        The states.
    bar : mapping
        Arguments ``progress`` and ``progress_kwargs`` of `emcee.EnsembleSampler.sample`.
    sweeps : int, optional
        Number of all sweeps; None without an end.
    per_state : int
        Sweeps per state.
    evaluator, function, size
        As for `Progress`.
    """
    labels = {"desc": SWEEPS, "unit": " sweeps"} | dict(bar["progress_kwargs"] or {})
    with (
        get_progress_bar(bar["progress"] and sweeps != 0, sweeps, **labels) as shown,
        Progress(shown, evaluator, labels["desc"], function, None, size, counts_points=False) as progress,
    ):
        for state in states:
            progress.step(per_state)
            yield state
