"""Which stored simulations may be used: the model's generation, or a generation that new simulations agree with.

If a model's label is unknown in a file, some stored rows are simulated again, chosen to cover the parameter space. If
all agree, the label is *adopted*: it is added to the rows' generation. If one differs, a new generation begins.
"""

import logging
import time

import numpy as np

from .comparison import Repetition, VerifyingRun, difference_of, is_transient, row_of_response
from .labels import OWN, Trust, labels_of
from .rows import StoredSimulation
from .simulation_cache import MAX_CANDIDATES, SimulationCache, rows_to_compare

__all__ = ["LATEST", "MAX_ATTEMPTS", "Adoption", "choose_rows"]

logger = logging.getLogger(__name__)

FIRST_COMPARED = 3  # rows in the first batch; each further batch has four times as many, until a row differs
LATEST = 100  # rows among which the latest success is looked for
MAX_ATTEMPTS = 4  # simulations that may fail for other reasons than the model
PAUSE_SECONDS = 60.0  # before another attempt, if no simulation could be compared
LARGEST = 3  # rows with the largest misfits, and failed rows nearest to successful rows


class Adoption:
    """Finds the generation of a model in a file; `trust` is locked during a search."""

    def __init__(self, cache: SimulationCache, trust: Trust, again: Repetition) -> None:
        self.cache, self.trust, self.again = cache, trust, again

    def generation(self, fingerprint: str, run: VerifyingRun) -> int | None:
        """Generation whose rows are used; None if no rows of this identity can be used yet.

        The fingerprint is that for statistics, as in `SimulationCache.look_up`, or the model's for responses.
        """
        found = self.trust.generations.get(fingerprint)
        if found is None:
            with self.trust.lock:
                found = self._find(fingerprint, run)
                if found is not None:
                    self.trust.generations[fingerprint] = found
        return found

    def begin(self, fingerprint: str, run: VerifyingRun) -> None:
        """Begin a new generation, with the simulations that differed from stored ones."""
        used = {*self.cache.generations_of(fingerprint), *self.cache.generations_of(run.model.fingerprint, "responses")}
        self.trust.begin(self.cache.file, run.model, used)
        text = "%s: stored simulations of this %s differ from new ones; they stay in the file and are not used"
        logger.warning(text, self.cache.path, type(run.model).__name__)
        new = [row for (name, *_), row in self.again.found.items() if name == fingerprint]
        if new and fingerprint != run.model.fingerprint:
            thetas, stored = np.array([theta for theta, _ in new]), self.trust.stored
            misfit, reasons = np.array([row.misfit for _, row in new]), [row.reason for _, row in new]
            place = stored.generation, stored.id
            self.cache.store(fingerprint, thetas, run.n_steps, misfit, reasons, 0.0, *place)
            self.cache.store_failures(run.model, thetas, reasons, stored.generation)
            self.trust.add_own(thetas, stored.generation, fingerprint, run.model.fingerprint)
        self.again.found.clear()

    def _find(self, fingerprint: str, run: VerifyingRun) -> int | None:
        trust, cache, n = self.trust, self.cache, rows_to_compare(self.cache.verify)
        of_responses = fingerprint == run.model.fingerprint
        present = cache.generations_of(fingerprint, "responses" if of_responses else "simulations")
        present = [each for each in present if self._rows(fingerprint, run, each, LATEST)]
        if present and time.monotonic() < trust.pause_ends:
            return None
        stored = trust.find(cache.file, run.model)
        if present and n:
            return self._search(fingerprint, run, present, n) if stored is None else self._complete(fingerprint, run, n)
        if present and stored is None:
            trust.adopt(cache.file, run.model, present[0], 0)
            stored = trust.stored
        return None if stored is None else stored.generation

    def _complete(self, fingerprint: str, run: VerifyingRun, n: int) -> int | None:
        """The generation of a known label; compares further rows if only a few were compared before."""
        trust, stored, before = self.trust, self.trust.find(self.cache.file, run.model), self.trust.stored
        if stored.compared < n:
            same = {each.id for each in labels_of(self.cache.file, stored.source) if each.label == stored.label}
            rows = self._rows(fingerprint, run, stored.generation, n + MAX_ATTEMPTS)
            left = min(n, sum(row.label not in same for row in rows)) - stored.compared
            if left > 0 and not self._adopts(fingerprint, run, stored.generation, left):
                return trust.stored.generation if trust.stored is not before else None
        return stored.generation

    def _search(self, fingerprint: str, run: VerifyingRun, present: list[int], n: int) -> int | None:
        """The generation that an unknown label belongs to, according to new simulations; None if they cannot tell."""
        logger.warning(
            "%s: the code, a file, a package or the machine of this %s is not that of its stored simulations; up to %d "
            "of them are simulated again, to see whether they can be used",
            self.cache.path,
            type(run.model).__name__,
            min(n, len(self._rows(fingerprint, run, present[0]))),
        )
        for generation in present:
            adopts = self._adopts(fingerprint, run, generation, n)
            if adopts is None:
                return None
            if adopts:
                return self.trust.stored.generation
        self.begin(fingerprint, run)
        return self.trust.stored.generation

    def _rows(
        self, fingerprint: str, run: VerifyingRun, generation: int, most: int = MAX_CANDIDATES
    ) -> list[StoredSimulation]:
        """Rows of a generation, the latest first; for responses, without statistics."""
        if fingerprint == run.model.fingerprint:
            points = self.cache.response_points(run.model, generation, most)
            return [StoredSimulation(theta, None, "", label) for theta, label in points]
        rows = self.cache.stored_rows(fingerprint, generation, run.n_numbers, run.n_steps, most)
        return [row for row in rows if not (row.reason and self.cache.retry_failures)]

    def _adopts(self, fingerprint: str, run: VerifyingRun, generation: int, n: int) -> bool | None:
        """Whether a generation's rows agree with new simulations, so that its label is adopted; None: cannot tell."""
        trust, rows = self.trust, self._rows(fingerprint, run, generation)
        chosen = choose_rows(rows, n, np.random.default_rng())
        if fingerprint == run.model.fingerprint:
            responses = self.cache.look_up_responses(run.model, np.array([row.theta for row in chosen]), generation)
            pairs = zip(chosen, responses, strict=True)
            chosen = [row_of_response(row.theta, found, row.label, run) for row, found in pairs if found is not None]
        same, compared = self._compare(fingerprint, run, chosen)
        if same and compared < min(n, len(rows)) / 2:
            trust.pause_ends = time.monotonic() + PAUSE_SECONDS
            return None
        if not same:
            if trust.stored is not None:  # a label that was adopted with fewer rows
                self.begin(fingerprint, run)
            return False
        before = 0 if trust.stored is None else trust.stored.compared
        trust.adopt(self.cache.file, run.model, generation, min(before + compared, OWN))
        text = "%s: %d stored simulations of this %s agree with new ones: all are used"
        logger.warning(text, self.cache.path, compared, type(run.model).__name__)
        return True

    def _compare(self, fingerprint: str, run: VerifyingRun, rows: list[StoredSimulation]) -> tuple[bool, int]:
        """Whether rows agree with the new simulations that were not stopped, and how many were compared."""
        size, attempts, compared = FIRST_COMPARED, 0, 0
        tolerances = self.again.tolerances(run)
        while rows and not (attempts >= MAX_ATTEMPTS and compared == 0):
            some, rows = rows[:size], rows[size:]
            attempts += len(some)
            size *= 4
            for row, new in zip(some, self.again.simulate(fingerprint, some, run), strict=True):
                if is_transient(new.reason):
                    continue
                compared += 1
                if bool(row.reason) != bool(new.reason):
                    return False, compared
                if not row.reason and difference_of(row.misfit, new, run, tolerances[row.label]) is not None:
                    return False, compared
        self.cache.verified += compared
        return True, compared


# coverage of the space ------------------------------------------------------------------------------------------------


def choose_rows(rows: list[StoredSimulation], n: int, rng: np.random.Generator) -> list[StoredSimulation]:
    """Choose n rows, of which the latest is the first, that would show a change of the model in a part of the space.

    The space is divided into n cells with about equal numbers of rows. One row per cell is chosen: a special row if
    there is one, otherwise a random row. A change that concerns a share p of the rows is then missed with a probability
    of at most (1 - p)^n, as with n random rows, and less if the changed part is connected. Special rows come first: the
    latest row, failed rows nearest to successful ones, largest misfits, extremes of each parameter.
    """
    if len(rows) <= n:
        return list(rows)
    thetas = np.array([row.theta for row in rows])
    scale = np.ptp(thetas, axis=0)
    thetas = (thetas - thetas.min(axis=0)) / np.where(scale > 0.0, scale, 1.0)
    special = _special(thetas, rows)
    rank = {row: place for place, row in enumerate(special)}
    chosen = []
    for cell in _cells(np.arange(len(rows)), thetas, n, rng):
        first = min(cell, key=lambda row: rank.get(row, len(rows)))
        chosen.append(int(first) if first in rank else int(rng.choice(cell)))
    order = {row: rank.get(row, len(rows) + place) for place, row in enumerate(rng.permutation(chosen).tolist())}
    return [rows[row] for row in sorted(chosen, key=order.__getitem__)]


def _special(thetas: np.ndarray, rows: list[StoredSimulation]) -> list[int]:
    """Indices of special rows, one kind after the other, without repetitions."""
    failed = np.array([bool(row.reason) for row in rows])
    extremes = [end for column in thetas.T for end in (int(column.argmin()), int(column.argmax()))]
    sums = np.array([np.nan if row.reason or row.misfit is None else np.sum(row.misfit) for row in rows])
    largest = np.argsort(np.where(np.isfinite(sums), -sums, np.inf), kind="stable")[:LARGEST]
    boundary = []
    if failed.any() and not failed.all():
        inside, outside = np.flatnonzero(failed)[:200], np.flatnonzero(~failed)
        distance = np.array([np.square(thetas[outside] - thetas[row]).sum(axis=1).min() for row in inside])
        boundary = inside[np.argsort(distance, kind="stable")[:LARGEST]].tolist()
    return list(dict.fromkeys([0, *boundary, *largest.tolist(), *extremes]))


def _cells(rows: np.ndarray, thetas: np.ndarray, n: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Divide rows into n parts, each time along the widest parameter (a random one of equally wide parameters)."""
    if n == 1:
        return [rows]
    width = np.ptp(thetas[rows], axis=0)
    axis = int(rng.choice(np.flatnonzero(width >= width.max())))
    ordered = rows[np.argsort(thetas[rows, axis], kind="stable")]
    left = n // 2
    cut = min(max(round(len(rows) * left / n), left), len(rows) - (n - left))
    return [*_cells(ordered[:cut], thetas, left, rng), *_cells(ordered[cut:], thetas, n - left, rng)]
