"""What an agent's card says of how it drives, as numbers."""

import re
from dataclasses import dataclass

_CELLS = re.compile(r"\|\s*(.*?)\s*(?=\|)")
_FIRST_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@dataclass(frozen=True)
class DrivingRecord:
    """Means over the episodes of an evaluation under one condition.

    Attributes:
        condition: what drove, in words.
        collisions: an episode.
        reward: an episode.
    """

    condition: str
    collisions: float
    reward: float


def driving_record(card: str) -> tuple[DrivingRecord, ...]:
    """Read the table of a card; empty where it has none.

    Args:
        card: Markdown, as ``publish`` writes it.

    Example:
        >>> card = "| condition | collisions | reward |\\n|---|---|---|\\n| SAC | 2.71 [2.4, 3.1] | 512 [497, 528] |"
        >>> driving_record(card)
        (DrivingRecord(condition='SAC', collisions=2.71, reward=512.0),)
    """
    rows = [_CELLS.findall(line) for line in card.splitlines() if line.startswith("|")]
    heading = next((number for number, row in enumerate(rows) if {"collisions", "reward"} <= set(row)), None)
    if heading is None:
        return ()
    names = rows[heading]
    return tuple(
        DrivingRecord(row[0], _number(row[names.index("collisions")]), _number(row[names.index("reward")]))
        for row in rows[heading + 2 :]
        if len(row) == len(names)
    )


def _number(cell: str) -> float:
    found = _FIRST_NUMBER.match(cell)
    return float("nan") if found is None else float(found[0])
