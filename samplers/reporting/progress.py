"""Progress of a run: a bar of tqdm in a terminal or a notebook, and one line per minute elsewhere.

The bar of the annealing has evaluated points and the latest stage, the bar of a guide simulations of its search, then
the effective size of its draws. The most important figures come first, because a narrow terminal cuts off the rest.
"""

import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from tqdm import tqdm as terminal_bar

from ..emcee_names import get_progress_bar
from ..evaluation.evaluator import Evaluator
from ..reports import AnnealingResult, GuideTick, Report, Restart, Stage, Sweep
from ..tempering.population import Population

SECONDS_BETWEEN_LINES = 60.0
SECONDS_BETWEEN_FIGURES = 0.1
WITHOUT_TOTAL = "{desc} [{elapsed}{postfix}]"
WITH_TOTAL = "{desc}: {percentage:3.0f}%|{bar:5}| {n_fmt}/{total_fmt}{unit} [{elapsed}<{remaining}{postfix}]"


class _Lines:
    """A file for tqdm that writes each new state, except the empty first state, as one line of stderr."""

    _last = ""

    def write(self, text: str) -> None:
        """Write a state without its control characters, if it has changed."""
        line = text.strip()
        if line and line != self._last:
            sys.stderr.write(f"{line}\n" if self._last else "")
            self._last = line


def open_bar(display: bool | str, total: int | None, **kwargs: Any) -> Any:
    """A bar of tqdm, disabled if `display` is False; emcee's bar of this name for a str.

    Where stderr is neither a terminal nor a notebook, the bar writes at most one line per minute and the last state.
    """
    if isinstance(display, str):
        return get_progress_bar(display, total, **kwargs)
    if not display:
        return terminal_bar(disable=True)
    from tqdm.auto import tqdm

    options = {"miniters": 0, "bar_format": WITH_TOTAL if total else WITHOUT_TOTAL}
    if tqdm.display is terminal_bar.display and not sys.stderr.isatty():
        interval = dict.fromkeys(("mininterval", "maxinterval"), SECONDS_BETWEEN_LINES)
        options |= {"file": _Lines(), **interval}
    return tqdm(total=total, **options | kwargs)


class Progress:
    """Shows a run in a bar: a context manager that observes an `Evaluator`, with `bar` as emcee's arguments
    ``progress`` and ``progress_kwargs``. Without a `total`, evaluations are counted, which ``function.when_simulated``
    may announce; else `step` counts sweeps.
    """

    def __init__(
        self, bar: Mapping[str, Any], evaluator: Evaluator, function: Callable, label: str, total: int | None = None
    ):
        kwargs = {"desc": label, "unit": " sweeps"} | dict(bar["progress_kwargs"] or {})
        self._bar = open_bar(bar["progress"] if total != 0 else False, total, **kwargs)
        self._evaluator, self._label, self._total = evaluator, label, total
        self._text = ""  # what the run does at present; empty before it is known
        self._search: GuideTick | None = None  # the latest one of the search of a guide
        self._announce: Callable = getattr(function, "when_simulated", lambda callback: None)
        self._figures: dict[str, Any] = {}
        self._drawn = time.perf_counter()

    def __enter__(self) -> "Progress":
        self._bar.__enter__()
        self._evaluator.running, self._begun = 0, self._evaluator.done
        if not self._bar.disable:
            self._evaluator.observer = self._draw_now_and_then
            if not self._evaluator.asynchronous:
                self._announce(self._simulated)
        return self

    def __exit__(self, *error: object) -> None:
        if not self._bar.disable:
            self._evaluator.observer = None
            self._announce(None)
            self.step(0)
        self._bar.__exit__(*error)

    def _simulated(self, points: float, waits: str = "") -> None:
        """Simulations of points that are evaluated, or of a search, have ended, or wait for something."""
        if waits:
            self._bar.set_description_str(waits)
            return
        if self._search is not None:
            self._search = self._search._replace(simulations=self._search.simulations + points)
        self._evaluator.count(0, points)

    def show(self, result: AnnealingResult, population: Population, report: Report) -> None:
        """Show a report of the annealing."""
        if not isinstance(report, Sweep | Stage | GuideTick | Restart):
            return
        begins, effective = not self._text, f"{population.effective_sample_size:.0f}"
        if isinstance(report, GuideTick):
            self._search = report if report.phase == "search" else None
            self._text = f"draws: effective size {effective} of {report.target}"
            self._figures = {"log Z": f"{result.rounds[-1].log_evidence:.2f}"} if result.rounds else {}
            self._figures |= {} if self._search else {"simulations": f"{report.simulations:.0f}"}
        elif isinstance(report, Sweep) or not result.rounds:
            self._figures = {"beta": f"{population.beta:.3g}"}
            if result.ladder:
                self._figures["log Z"] = f"{sum(stage.log_evidence_increment for stage in result.ladder):.2f}"
                self._text = f"stage {len(result.ladder)}"
            self._figures |= {"ESS": effective, "acceptance": f"{getattr(report, 'acceptance', 0.0):.2f}"}
        self.step(0)
        if begins and self._search:  # the first simulation may take long
            self._bar.refresh()

    def _draw_now_and_then(self) -> None:
        if time.perf_counter() - self._drawn >= SECONDS_BETWEEN_FIGURES:
            self.step(0)

    def step(self, steps: int) -> None:
        """Show the figures, and advance a bar of sweeps."""
        self._drawn, evaluator = time.perf_counter(), self._evaluator
        counts = {"failures": len(evaluator.record.failed + evaluator.record.counted), "running": evaluator.running}
        figures = self._figures | {name: f"{number:.0f}" for name, number in counts.items() if number}
        if self._total is None:
            counted = f"{self._text or self._label}: {evaluator.done - self._begun:.0f} evaluations"
            text = self._text if "simulations" in figures else counted
            if self._search is not None:
                text = f"{self._search.phase}: {self._search.simulations:.0f} simulations"
            self._bar.set_description_str(text, refresh=False)
        self._bar.set_postfix(figures, refresh=False)
        self._bar.update(steps)
