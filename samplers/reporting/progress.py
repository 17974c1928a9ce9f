"""Progress of a run: a bar of tqdm in a terminal or a notebook, and one line per minute elsewhere.

The bar of the annealing counts evaluated points and names the latest stage; the bar of a guide counts simulations of
its search, then the effective size of its draws. The most important figures come first, because a narrow terminal cuts
off the rest.
"""

import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from ..emcee_names import get_progress_bar
from ..evaluation.evaluator import Evaluator
from ..reports import AnnealingResult, GuideTick, Report, Restart, Stage, Sweep
from ..tempering.population import Population

SECONDS_BETWEEN_LINES = 60.0
SECONDS_BETWEEN_FIGURES = 0.1
OF_GUIDES = "{desc} [{elapsed}{postfix}]"
ORDER = ("beta", "log Z", "failures", "ESS", "acceptance", "simulations", "running")  # the most important figures first


class _Lines:
    """A file for tqdm that writes each new state, except the empty first state, as one line of stderr."""

    def __init__(self) -> None:
        self._last: str | None = None

    def write(self, text: str) -> None:
        """Write a state without its control characters, if it has changed."""
        line = text.strip()
        if line and line != self._last:
            if self._last is not None:
                sys.stderr.write(line + "\n")
            self._last = line

    def flush(self) -> None:
        """Flush stderr."""
        sys.stderr.flush()


def _open_bar(display: bool | str, total: int | None, **kwargs: Any) -> Any:
    """Return a bar of tqdm for `display` True, no bar for False, and emcee's bar of this name for a str.

    Where stderr is neither a terminal nor a notebook, the bar writes at most one line per minute and the last state.
    """
    if display is not True:
        return get_progress_bar(display, total, **kwargs)
    from tqdm import tqdm as terminal_bar
    from tqdm.auto import tqdm

    part = "|{bar:5}|"
    if tqdm.display is not terminal_bar.display:  # in a notebook
        part = "|{bar}|"
    elif "file" not in kwargs and not sys.stderr.isatty():
        rare = {"mininterval": SECONDS_BETWEEN_LINES, "maxinterval": SECONDS_BETWEEN_LINES}
        kwargs, part = rare | kwargs | {"file": _Lines()}, ""
    counted = "{desc}: {n_fmt}{unit} [{elapsed}{postfix}]"
    if total:
        counted = "{desc}: {percentage:3.0f}%" + part + " {n_fmt}/{total_fmt}{unit} [{elapsed}<{remaining}{postfix}]"
    return tqdm(total=total, **{"miniters": 0, "bar_format": counted} | kwargs)


def _count(search: GuideTick) -> str:
    """Which simulation of a search runs, of about how many, rounded to two digits."""
    if not search.simulations + search.expected:
        return search.phase
    number, most = max(1, round(search.simulations)), float(f"{search.expected:.2g}")
    about = (f" of about {most:.0f}" if number <= most else f", {most:.0f} were expected") if most else ""
    return f"{search.phase}: simulation {number}{about}"


class Progress:
    """Shows a run in a bar: a context manager that observes an `Evaluator`, with `bar` as emcee's arguments
    ``progress`` and ``progress_kwargs``. The bar counts "evaluations", which ``function.when_simulated`` may announce,
    or `step` another `unit` up to a `total`.
    """

    def __init__(
        self,
        bar: Mapping[str, Any],
        evaluator: Evaluator,
        function: Callable,
        label: str,
        unit: str,
        total: int | None = None,
    ):
        labels = {"desc": label, "unit": f" {unit}"} | dict(bar["progress_kwargs"] or {})
        self._bar = _open_bar(bar["progress"] if total != 0 else False, total, **labels)
        self._evaluator, self._counts_points = evaluator, unit == "evaluations"
        self._own = "" if labels["desc"] == label else f"{labels['desc']}, "  # a label of the user is kept
        self._text = ""  # what the run does at present; empty before it is known
        self._search: GuideTick | None = None  # the latest one of the search of a guide
        self._count_is_ours = bar["progress"] is True and "bar_format" not in labels
        self._announce: Callable = getattr(function, "when_simulated", lambda callback: None)
        self._silent = not hasattr(self._bar, "set_postfix")  # emcee's silent bar has only update
        self._figures: dict[str, Any] = {}
        self._part = 0.0  # of a point: simulations of a point that has several
        self._drawn = time.perf_counter()

    def __enter__(self) -> "Progress":
        self._bar.__enter__()
        self._evaluator.running, self._shown = 0, self._evaluator.done
        if not self._silent:
            self._evaluator.observer = self._draw_now_and_then
            if not self._evaluator.asynchronous:
                self._announce(self._simulated)
        return self

    def __exit__(self, *error: object) -> None:
        if not self._silent:
            self._evaluator.observer = None
            self._announce(None)
            self._draw()
        self._bar.__exit__(*error)

    def _simulated(self, points: float, waits: str = "") -> None:
        """Simulations of points that are evaluated, or of a search, have ended, or wait for something."""
        if waits:
            self._bar.set_description_str(f"{self._own}{waits}")
            return
        if self._search is not None:
            self._search = self._search._replace(simulations=self._search.simulations + points)
        self._part += points if self._evaluator.running > 0 else 0.0
        whole = int(self._part + 1e-9)
        self._part -= whole
        self._evaluator.count(0, whole)

    def show(self, result: AnnealingResult, population: Population, report: Report) -> None:
        """Show a report of the annealing."""
        if self._silent or not isinstance(report, Sweep | Stage | GuideTick | Restart):
            return
        begins, effective = False, f"{population.effective_sample_size:.0f}"
        if isinstance(report, GuideTick):
            begins, self._search = not self._text, report if report.phase == "search" else None
            self._text = f"draws: effective size {effective} of {report.target}"
            self._figures = {} if self._search else {"simulations": round(report.simulations)}
            if self._count_is_ours:
                self._bar.bar_format = OF_GUIDES
            if result.rounds:
                self._figures["log Z"] = f"{result.rounds[-1].log_evidence:.2f}"
        elif isinstance(report, Sweep) or not result.rounds:
            acceptance = f"{getattr(report, 'acceptance', 0.0):.2f}"
            self._figures = {"beta": f"{population.beta:.3g}", "ESS": effective, "acceptance": acceptance}
            if result.ladder:
                self._figures["log Z"] = f"{sum(stage.log_evidence_increment for stage in result.ladder):.2f}"
                self._text = f"stage {len(result.ladder)}"
        self._draw()
        if begins:  # the first simulation may take long
            self._bar.refresh()

    def step(self, steps: int) -> None:
        """Advance a bar that does not count points."""
        if self._silent:
            self._bar.update(steps)
        else:
            self._draw(steps)

    def _draw_now_and_then(self) -> None:
        if time.perf_counter() - self._drawn >= SECONDS_BETWEEN_FIGURES:
            self._draw()

    def _draw(self, steps: int = 0) -> None:
        """Show the figures, and advance the bar by steps, or by the points since the last time."""
        self._drawn, evaluator = time.perf_counter(), self._evaluator
        if self._counts_points:
            steps, self._shown = evaluator.done - self._shown, evaluator.done
        counts = {"failures": len(evaluator.record.failed + evaluator.record.counted), "running": evaluator.running}
        figures = self._figures | {name: number for name, number in counts.items() if number}
        if text := _count(self._search) if self._search else self._text:
            self._bar.set_description_str(f"{self._own}{text}", refresh=False)
        self._bar.set_postfix({name: str(figures[name]) for name in ORDER if name in figures}, refresh=False)
        self._bar.update(steps)
