r"""Do the numbers of cards hold? They are held against what was measured again, on other maps.

Both are means with intervals over maps, of independent maps where the seeds differ. A number holds unless the two means
lie further apart than errors of this size explain: with half widths :math:`h_1, h_2` of their 95 % intervals, about
:math:`\sqrt{h_1^2 + h_2^2}`. That is said of each number at 95 %; so many are looked at that some of them would be
further apart by chance, so the p-values are adjusted by Holm's method for all numbers of a call: true cards are
refuted by at most one call in twenty.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from scipy import stats

from rcdsac_trl.report.card import measured_values
from rcdsac_trl.report.statistics import CONFIDENCE, Interval, holm

CLAIMED = ("collisions", "reward")
"""Metrics of a card that are checked, under each of its conditions."""
_FORMS = {"collisions": ".2f", "reward": ".0f"}


def agreement(claimed: Interval, claimed_maps: int, measured: Interval, measured_maps: int) -> float:
    """Return the p-value of two means this far apart if both are of the same agent: Welch's test, from intervals.

    The second interval counts as at least as wide as the card's would be over so few maps: where an agent collides
    seldom, maps on which it does less by chance give a narrow one, too, and true cards were refuted in a fifth of the
    calls with 10 maps.

    Args:
        claimed: mean and interval of a card.
        claimed_maps: over how many maps.
        measured: likewise, measured again.
        measured_maps: likewise.

    Example:
        >>> round(agreement(Interval(1.0, 0.8, 1.2), 50, Interval(1.3, 1.05, 1.55), 50), 3)
        0.063
        >>> agreement(Interval(0.0, 0.0, 0.0), 50, Interval(0.0, 0.0, 0.0), 30)
        1.0
    """
    difference = abs(claimed.value - measured.value)
    of_card = _variance(claimed, claimed_maps)
    variances = [of_card, max(_variance(measured, measured_maps), of_card * claimed_maps / measured_maps)]
    total = sum(variances)
    if total == 0.0:  # nothing ever varied
        return float(difference == 0.0)
    shares = ((v / total) ** 2 / (maps - 1) for v, maps in zip(variances, (claimed_maps, measured_maps), strict=True))
    return float(2.0 * stats.t.sf(difference / math.sqrt(total), 1.0 / sum(shares)))


def _variance(interval: Interval, maps: int) -> float:
    """Return the variance of a mean over maps, from its interval, which is as wide as Student's."""
    half_width = (interval.high - interval.low) / 2.0
    return float((half_width / stats.t.ppf((1.0 + CONFIDENCE) / 2.0, maps - 1)) ** 2)


def compared(name: str, card: Mapping[str, Any], again: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Hold a card's numbers against what was measured again.

    Args:
        name: of the agent.
        card: ``measured.json``.
        again: of :func:`~rcdsac_trl.report.card.measured_values`, under the same conditions.

    Returns:
        One row a number: `agent`, `condition`, `metric`; `claimed`, `claimed_low`, `claimed_high` and `measured`,
        `measured_low`, `measured_high`; `allowed`, how far apart two true means lie in 95 % of the cases; and
        `p_value`, not adjusted.
    """
    found = {(entry["beta"], entry["collision_weight"]): entry for entry in again["conditions"]}
    maps = card["protocol"]["num_maps"], again["protocol"]["num_maps"]
    rows = []
    for condition in card["conditions"]:
        measured_again = found[condition["beta"], condition["collision_weight"]]
        for metric in CLAIMED:
            claimed, measured = (
                Interval(value["mean"], value["low"], value["high"])
                for value in (condition["metrics"][metric], measured_again["metrics"][metric])
            )
            half_widths = ((interval.high - interval.low) / 2.0 for interval in (claimed, measured))
            rows.append(
                {
                    "agent": name,
                    "condition": condition["label"],
                    "metric": metric,
                    **{f"claimed{part}": getattr(claimed, key) for part, key in _PARTS.items()},
                    **{f"measured{part}": getattr(measured, key) for part, key in _PARTS.items()},
                    "allowed": math.hypot(*half_widths),
                    "p_value": agreement(claimed, maps[0], measured, maps[1]),
                }
            )
    return rows


_PARTS = {"": "value", "_low": "low", "_high": "high"}


def with_verdicts(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return the rows of all agents with `p_value` adjusted for their number, and `holds`."""
    table = pd.DataFrame(rows)
    table["p_value"] = holm(table["p_value"].tolist())
    return table.assign(holds=table["p_value"] >= 1.0 - CONFIDENCE)


def verified(agents: Sequence[tuple[str, Path, Path]]) -> tuple[str, str, list[str]]:
    """Say which numbers of cards hold.

    Args:
        agents: of each its name, the ``measured.json`` of its card, and the folder of the evaluation that measured it
            again.

    Returns:
        Text; the table of :func:`with_verdicts` as CSV; and the numbers that do not hold, in words.
    """
    rows = [
        row
        for name, card, folder in agents
        for row in compared(name, json.loads(card.read_text(encoding="utf-8")), measured_values(folder))
    ]
    table = with_verdicts(rows)
    named = [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]
    refuted = [
        f"{row['agent']}, {row['condition']}: {row['metric']} {_number(row['claimed'], row['metric'])}, measured "
        f"{_number(row['measured'], row['metric'])}"
        for row in named
        if not row["holds"]
    ]
    return _text(named), table.to_csv(index=False, float_format="%.6g"), refuted


def _text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a line a number, and what they say together."""
    shown = pd.DataFrame(
        {
            "": [f"{row['agent']}  {row['condition']}" if row["metric"] == CLAIMED[0] else "" for row in rows],
            "metric": [row["metric"] for row in rows],
            "card": [_cell(row, "claimed") for row in rows],
            "measured": [_cell(row, "measured") for row in rows],
            "apart": [_number(abs(row["claimed"] - row["measured"]), row["metric"]) for row in rows],
            "usual": [f"≤ {_number(row['allowed'], row['metric'])}" for row in rows],
            "p": [f"{row['p_value']:.2g}" for row in rows],
            "verdict": ["holds" if row["holds"] else "DOES NOT HOLD" for row in rows],
        }
    )
    lines = shown.to_string(index=False, justify="left").splitlines()
    holding = sum(bool(row["holds"]) for row in rows)
    return "\n".join(
        [
            *(line.rstrip() for line in lines),
            "",
            f"{holding} of {len(rows)} numbers hold. usual: how far apart two means of one agent lie in "
            f"{CONFIDENCE:.0%} of the cases;",
            f"p: adjusted for all {len(rows)} (Holm), so that true cards are refuted in at most "
            f"{1 - CONFIDENCE:.0%} of the calls.",
        ]
    )


def _cell(row: Mapping[str, Any], of: str) -> str:
    value, low, high = (_number(row[f"{of}{part}"], row["metric"]) for part in _PARTS)
    return f"{value} [{low}, {high}]"


def _number(value: float, metric: str) -> str:
    return format(value, _FORMS[metric])
