"""What a claim about means is worth: it holds, it does not, or the intervals cannot tell.

A claim is made of expectations, such as "these rows collide less than those". Each is a weighted sum of means over the
same maps, whose interval crosses maps and trainings (:func:`rcdsac_trl.report.statistics.contrast`).

- *Less* holds if the whole interval lies below nothing. It does not hold if the whole interval lies above what would be
  called comparable. Otherwise nobody can tell. *More* is its mirror image.
- *Comparable* is what differs by less than :data:`COMPARABLE` of the mean of what is compared.
- A claim about *all* of k expectations holds if each holds; that *one* of them fails must be seen with the confidence
  1 - (1 - c) / k, since one of many seems to fail by chance. A claim about *any* is its mirror image.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal, NamedTuple

import numpy as np

from rcdsac_trl.report.read import METRIC_NAMES
from rcdsac_trl.report.statistics import CONFIDENCE, Array, Interval, Term, contrast, of_these_agents
from rcdsac_trl.report.training_scatter import TrainingError

COMPARABLE = 0.05
"""Share of a mean that counts as no difference. The paper calls 0.95 and 0.91 collisions comparable, which is 4 %, and
the rewards 449.9 and 425.0 different, which is 6 %."""

Expected = Literal["less", "more", "comparable"]


class Verdict(StrEnum):
    """What became of a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    OPEN = "cannot be told"
    MISSING = "runs missing"


class Cell(NamedTuple):
    """An agent's row of the paper's table, under one sensor; None is what a row is not told."""

    agent: str
    beta: float | None
    collision_weight: float | None
    sensor: str


@dataclass(frozen=True)
class Group:
    """Cells whose mean is compared, each counting alike."""

    name: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Expectation:
    """What a weighted sum of the means of groups should be.

    Attributes:
        groups: what is compared.
        weights: of each group in the sum.
        metric: which mean.
        expected: of the sum.
        difference: what the sum is called.
    """

    groups: tuple[Group, ...]
    weights: tuple[float, ...]
    metric: str
    expected: Expected
    difference: str = "Difference"

    @property
    def cells(self) -> list[Cell]:
        """All cells it needs, each once."""
        return list(dict.fromkeys(cell for group in self.groups for cell in group.cells))


def _weighted(expectation: Expectation) -> Iterator[tuple[float, Cell]]:
    """Yield the cells of a sum, each with its weight."""
    for group, weight in zip(expectation.groups, expectation.weights, strict=True):
        for cell in group.cells:
            yield weight / len(group.cells), cell


def than(first: Group, expected: Expected, second: Group, metric: str = "collisions") -> Expectation:
    """Expect of the mean of the first group that it is less, or more, than that of the second, or comparable."""
    return Expectation((first, second), (1.0, -1.0), metric, expected)


@dataclass(frozen=True)
class Claim:
    """One of the paper's claims.

    Attributes:
        says: the claim, as one sentence without its full stop.
        sensor: under which it is judged, or several.
        expectations: of which it is made.
        quantifier: whether all of them must hold, or any one.
    """

    says: str
    sensor: str
    expectations: tuple[Expectation, ...]
    quantifier: Literal["all", "any"] = "all"


@dataclass(frozen=True)
class Judged:
    """An expectation and what was found.

    Attributes:
        expectation: which one.
        here: the mean of each group.
        paper: the same by the paper; NaN where it has none.
        interval: of the weighted sum of the means.
        verdict: of this expectation, for itself.
    """

    expectation: Expectation
    here: tuple[float, ...]
    paper: tuple[float, ...]
    interval: Interval
    verdict: Verdict

    @property
    def against(self) -> tuple[int, float]:
        """How much the numbers speak against what was expected: by the verdict, then by the difference."""
        value = self.interval.value
        verdict = (Verdict.HOLDS, Verdict.OPEN, Verdict.FAILS).index(self.verdict)
        return verdict, {"less": value, "more": -value, "comparable": abs(value)}[self.expectation.expected]


@dataclass(frozen=True)
class Finding:
    """A claim and what was found.

    Attributes:
        claim: which one.
        verdict: what became of it.
        judged: those of its expectations of which everything was measured.
        missing: what was not measured of it.
        measured: by what it was judged.
        of_agents: the same over maps alone, which speaks of the agents that were driven and not of their recipe; None
            where the verdict speaks of them already, since nobody knows how another training would differ.
    """

    claim: Claim
    verdict: Verdict
    judged: tuple[Judged, ...]
    missing: tuple[Cell, ...]
    measured: "Measured"
    of_agents: "Finding | None" = None


class Measured:
    """Means of cells: the episodes that were driven, and what the paper has there.

    Args:
        values: a metric under a cell, ``[training seeds, maps, episodes]``; None if nobody drove it.
        paper: a metric under a cell by the paper; NaN if it has none.
        unit: what the second axis is, in the plural: ``"maps"``.
        names: what metrics are called.
        error: what other trainings would change in a weighted sum of cells' means in a metric, None if nobody knows
            how they differ; without it the cells of a claim alone say so.
    """

    def __init__(
        self,
        values: Callable[[Cell, str], Array | None],
        paper: Callable[[Cell, str], float],
        unit: str = "maps",
        names: Mapping[str, str] = METRIC_NAMES,
        error: Callable[[Sequence[tuple[float, Cell]], str], TrainingError | None] | None = None,
    ) -> None:
        self._values = values
        self._paper = paper
        self._known: dict[tuple[Cell, str], Array | None] = {}
        self.unit = unit
        self.names = names
        self._error = error

    def of_agents(self) -> "Measured":
        """Return the same for these very agents, of which training seeds say nothing of other trainings."""

        def together(cell: Cell, metric: str) -> Array | None:
            values = self.values(cell, metric)
            return None if values is None else of_these_agents(values)

        return Measured(together, self._paper, self.unit, self.names)

    def error(self, expectation: Expectation) -> TrainingError | None:
        """Return what other trainings would change in the sum of an expectation; None if nobody knows."""
        return None if self._error is None else self._error(list(_weighted(expectation)), expectation.metric)

    def values(self, cell: Cell, metric: str) -> Array | None:
        """Return what was measured under a cell, None if nothing was."""
        if (cell, metric) not in self._known:
            self._known[cell, metric] = self._values(cell, metric)
        return self._known[cell, metric]

    def mean(self, group: Group, metric: str) -> float:
        """Return the mean over a group's cells; NaN where one is missing."""
        found = [self.values(cell, metric) for cell in group.cells]
        return float(np.mean([np.nan if values is None else np.nanmean(values) for values in found]))

    def paper(self, group: Group, metric: str) -> float:
        """Return the paper's mean over a group's cells; NaN where it has none."""
        return float(np.mean([self._paper(cell, metric) for cell in group.cells]))

    def has(self, cell: Cell, metric: str) -> bool:
        """Say whether a cell was driven, and the metric ever measured."""
        values = self.values(cell, metric)
        return values is not None and bool(np.isfinite(values).any())

    def interval(self, expectation: Expectation, confidence: float) -> Interval:
        """Return the sum of an expectation, all of whose cells are there, with its interval."""
        terms = []
        for weight, cell in _weighted(expectation):
            values = self.values(cell, expectation.metric)
            assert values is not None
            terms.append(Term(weight, values, f"{cell.agent} {cell.sensor}"))
        # Where it is not known of one sensor how trainings differ, half of their error would mislead.
        unknown = None if self._error is None else TrainingError()
        return contrast(terms, confidence, self.error(expectation) or unknown)

    def num_seeds(self, expectations: Sequence[Expectation]) -> tuple[int, int]:
        """Return the fewest and the most training seeds of what was measured; 0 if nothing was."""
        seeds = [shape[0] for shape in self._shapes(expectations)]
        return min(seeds, default=0), max(seeds, default=0)

    def speaks_of_trainings(self, expectations: Sequence[Expectation]) -> bool:
        """Say whether intervals are over other trainings, too."""
        if self._error is None:
            return self.num_seeds(expectations)[1] > 1
        return any(self.error(one) is not None for one in expectations)

    def num_units(self, expectations: Sequence[Expectation]) -> int:
        """Return how many maps, or other units, were driven; 0 if nothing was measured."""
        return next((shape[1] for shape in self._shapes(expectations)), 0)

    def _shapes(self, expectations: Sequence[Expectation]) -> list[tuple[int, ...]]:
        wanted = ((cell, one.metric) for one in expectations for cell in one.cells)
        return [values.shape for cell, metric in wanted if (values := self.values(cell, metric)) is not None]


def judge(interval: Interval, expected: Expected, margin: float) -> Verdict:
    """Hold an interval against what was expected.

    Args:
        interval: of a difference.
        expected: of the difference.
        margin: differences up to this one are comparable.

    Example:
        >>> judge(Interval(-0.3, -0.5, -0.1), "less", margin=0.05).value
        'holds'
        >>> judge(Interval(0.0, -0.02, 0.02), "less", margin=0.05).value  # comparable, so not less
        'does not hold'
        >>> judge(Interval(0.0, -0.4, 0.4), "less", margin=0.05).value
        'cannot be told'
    """
    low, high = interval.low, interval.high
    if np.isnan(low):  # nothing was measured, or one map, which says nothing of others
        return Verdict.OPEN
    if expected == "more":
        low, high = -high, -low
    if expected == "comparable":
        if -margin <= low and high <= margin:
            return Verdict.HOLDS
        return Verdict.FAILS if low > margin or high < -margin else Verdict.OPEN
    if high < 0.0:
        return Verdict.HOLDS
    return Verdict.FAILS if low >= -margin else Verdict.OPEN


def find(claim: Claim, measured: Measured) -> Finding:
    """Judge a claim by what was measured."""
    found = _find(claim, measured)
    expectations = [judged.expectation for judged in found.judged]
    if measured.speaks_of_trainings(expectations):
        return replace(found, of_agents=_find(claim, measured.of_agents()))
    return found


def _find(claim: Claim, measured: Measured) -> Finding:
    wanted = [(cell, one.metric) for one in claim.expectations for cell in one.cells]
    missing = dict.fromkeys(cell for cell, metric in wanted if not measured.has(cell, metric))
    there = [one for one in claim.expectations if not missing.keys() & set(one.cells)]
    judged = tuple(_judged(one, measured, CONFIDENCE) for one in there)
    return Finding(claim, _verdict(claim, judged, measured, bool(missing)), judged, tuple(missing), measured)


def _verdict(claim: Claim, judged: Sequence[Judged], measured: Measured, incomplete: bool) -> Verdict:
    """Make one verdict of many: one decides against "all" or for "any", else all must agree."""
    decisive, unanimous = Verdict.FAILS, Verdict.HOLDS
    if claim.quantifier == "any":
        decisive, unanimous = unanimous, decisive
    strict = 1.0 - (1.0 - CONFIDENCE) / max(len(judged), 1)
    if any(_judged(one.expectation, measured, strict).verdict == decisive for one in judged):
        return decisive
    if incomplete:
        return Verdict.MISSING
    return unanimous if all(one.verdict == unanimous for one in judged) else Verdict.OPEN


def _judged(expectation: Expectation, measured: Measured, confidence: float) -> Judged:
    here = tuple(measured.mean(group, expectation.metric) for group in expectation.groups)
    paper = tuple(measured.paper(group, expectation.metric) for group in expectation.groups)
    interval = measured.interval(expectation, confidence)
    margin = COMPARABLE * float(np.mean(np.abs(here)))
    return Judged(expectation, here, paper, interval, judge(interval, expectation.expected, margin))
