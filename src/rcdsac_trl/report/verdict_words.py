"""Findings in words and tables: the verdict of every claim, with its numbers."""

from collections import Counter
from collections.abc import Sequence

import pandas as pd

from rcdsac_trl.report.formats import interval, number
from rcdsac_trl.report.statistics import CONFIDENCE_TEXT
from rcdsac_trl.report.verdicts import Finding, Judged, Verdict

_SIDES = " · "
_COUNTED = {Verdict.HOLDS: "as claimed", Verdict.FAILS: "not so", Verdict.OPEN: "cannot be told"}


def tally(findings: Sequence[Finding]) -> str:
    """Count the verdicts.

    Returns:
        Such as ``"4 hold, 1 does not hold, 2 cannot be told"``.
    """
    counts = Counter(finding.verdict for finding in findings)
    words = {
        Verdict.HOLDS: ("holds", "hold"),
        Verdict.FAILS: ("does not hold", "do not hold"),
        Verdict.OPEN: ("cannot be told", "cannot be told"),
        Verdict.MISSING: ("lacks runs", "lack runs"),
    }
    return ", ".join(
        f"{counts[verdict]} {word[counts[verdict] > 1]}" for verdict, word in words.items() if counts[verdict]
    )


def verdict_lines(findings: Sequence[Finding]) -> list[str]:
    """Return a line a claim about which there is something to say, and one that counts the others."""
    told = [finding for finding in findings if finding.judged]
    lines = [f"{one.verdict.value:14}  {one.claim.sensor:17}  {one.claim.says}" for one in told]
    untold = len(findings) - len(told)
    return [*lines, f"{untold} claims lack every run they need"] if untold else lines


def numbers(finding: Finding) -> str:
    """Return the numbers of a verdict: of several comparisons how many are as claimed, and the one that says most.

    That is the one that speaks most against a claim about all, or most for a claim about any. Empty where nothing could
    be compared.
    """
    if not finding.judged:
        return ""
    if len(finding.claim.expectations) == 1:
        return _numbers(finding, finding.judged[0])
    if finding.claim.quantifier == "all":
        which, shown = "Weakest", max(finding.judged, key=lambda one: one.against)
    else:
        which, shown = "Strongest", min(finding.judged, key=lambda one: one.against)
    return f"{_counted(finding.judged)} {which}: {_numbers(finding, shown)}"


def of_agents(finding: Finding) -> str:
    """Return what the maps alone say of the agents that were driven; empty where that is the verdict already."""
    alone = finding.of_agents
    if alone is None or not alone.judged:
        return ""
    told = "" if alone.verdict == Verdict.MISSING else f" {alone.verdict.value.capitalize()}."
    if len(alone.judged) > 1:
        return f"{_counted(alone.judged)}{told}"
    return f"{_interval(alone.judged[0])}.{told}"


def missing(finding: Finding) -> str:
    """Name the rows that were not measured, an agent's together; empty if none is missing."""
    absent: dict[tuple[str, str], list[str]] = {}
    for cell in finding.missing:
        told = next((f"{value:g}" for value in (cell.beta, cell.collision_weight) if value is not None), "")
        absent.setdefault((cell.agent, cell.sensor), []).append(told)
    named = (
        f"{agent} ({sensor})" + (f" at {', '.join(settings)}" if settings != [""] else "")
        for (agent, sensor), settings in absent.items()
    )
    return "; ".join(named)


def over(finding: Finding) -> str:
    """Say what the intervals are over: maps, and trainings where it is known how these differ."""
    expectations = [one.expectation for one in finding.judged]
    fewest, most = finding.measured.num_seeds(expectations)
    if not most:
        return ""
    units = f"{finding.measured.num_units(expectations)} {finding.measured.unit}"
    if not finding.measured.speaks_of_trainings(expectations):
        return f"{units} alone: one training of each agent" if most == 1 else f"{units} alone"
    trainings = f"{most}" if fewest == most else f"{fewest} to {most}"
    return f"{units} and other trainings: {trainings} of each agent here"


def as_table(findings: Sequence[Finding]) -> pd.DataFrame:
    """Return findings as text, one row each."""
    return pd.DataFrame(
        [
            {
                "claim": finding.claim.says,
                "sensor": finding.claim.sensor,
                "verdict": finding.verdict.value,
                "numbers": numbers(finding),
                "interval over": over(finding),
                "of these very agents": of_agents(finding),
                "not measured": missing(finding),
            }
            for finding in findings
        ]
    )


def evidence(findings: Sequence[Finding]) -> pd.DataFrame:
    """Return every comparison behind the findings, one row each, as text with the decimals of its metric."""
    rows = []
    for finding in findings:
        for one in finding.judged:
            metric = one.expectation.metric
            rows.append(
                {
                    "claim": finding.claim.says,
                    "sensor": finding.claim.sensor,
                    "compared": _SIDES.join(group.name for group in one.expectation.groups),
                    "mean of": finding.measured.names[metric],
                    "here": _SIDES.join(number(value, metric) for value in one.here),
                    "paper": _SIDES.join(number(value, metric) for value in one.paper),
                    "difference": number(one.interval.value, metric, signed=True),
                    CONFIDENCE_TEXT: _interval(one),
                    "expected": one.expectation.expected,
                    "so": one.verdict.value,
                }
            )
    return pd.DataFrame(rows)


def _numbers(finding: Finding, one: Judged) -> str:
    metric = one.expectation.metric
    means = [
        f"{group.name}: {number(here, metric)} (paper {number(paper, metric)})"
        for group, here, paper in zip(one.expectation.groups, one.here, one.paper, strict=True)
    ]
    value = number(one.interval.value, metric, signed=True)
    unit = finding.measured.names[metric]
    return f"{', '.join(means)} {unit}. {one.expectation.difference} {value} {_interval(one)}."


def _interval(one: Judged) -> str:
    return interval(one.interval.low, one.interval.high, one.expectation.metric, signed=True)


def _counted(judged: Sequence[Judged]) -> str:
    counts = Counter(one.verdict for one in judged)
    said = [f"{counts[verdict]} {word}" for verdict, word in _COUNTED.items() if counts[verdict]]
    return f"{len(judged)} comparison{'s' if len(judged) > 1 else ''}: {', '.join(said)}."
