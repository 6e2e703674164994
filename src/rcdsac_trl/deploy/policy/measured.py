"""What was measured of an agent: ``measured.json`` in its folder, which cards, lists and tables are made from."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rcdsac_trl.errors import UserInputError

MEASURED_NAME = "measured.json"
MEASURED_VERSION = 2
"""Of the file's format."""


@dataclass(frozen=True)
class Estimate:
    """A mean over the episodes of an evaluation and its confidence interval, with the map as the unit."""

    mean: float
    low: float
    high: float

    @property
    def half_width(self) -> float:
        """Half of the interval's length."""
        return (self.high - self.low) / 2.0


@dataclass(frozen=True)
class MeasuredCondition:
    """What was measured under one condition.

    Attributes:
        label: what drove, in words.
        beta: it was told; None for none.
        collision_weight: it was told; None for none.
        metrics: means an episode, by the names of ``episodes.csv``, and ``collision_free``, a share.
        collisions_by_thing: by what was hit (``"all"`` for anything): ``per_episode``; ``outside_share`` of these with
            the contact outside the sensor's sectors; ``never_share`` of what had never been sensed. Empty where nobody
            looked.
    """

    label: str
    beta: float | None
    collision_weight: float | None
    metrics: Mapping[str, Estimate]
    collisions_by_thing: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)

    @property
    def told(self) -> tuple[float | None, float | None]:
        """Beta and collision weight, which tell conditions apart."""
        return self.beta, self.collision_weight


@dataclass(frozen=True)
class Measured:
    """All that was measured of an agent.

    Attributes:
        row: what the paper calls it.
        conditions: in the order of beta.
        protocol: ``split``, ``seed``, ``num_maps``, ``num_episodes``, ``sampled``, and the settings ``map`` and
            ``task`` of what was driven.
        rules_version: of the task; results of different versions do not compare.
        map_version: of the generator.
        confidence: of the intervals.
        train_seed: of the one training.
        weights_sha256: of the weights that ship.
        as_shipped: whether exactly these were driven; else the agent was, in single precision.
        commit: of the version that measured.
        command: measures the same again.
        precision: largest differences that rounding made, by quantity; empty where nobody looked.
        calibration: one entry a beta: how far the worst tenth of the returns lies below what was expected
            (``tail_depth``), how far the critics say (``predicted_tail_depth``), and ``coverage``, by fraction the
            share of returns below that quantile. Empty where nobody looked.
        limits: sentences.
        told_calibration: of what the agent tells while it drives as it acts, one entry a beta of what its critics say
            (``told`` is ``"raw"``) and, where it recalibrates them, of that (``"recalibrated"``): maps, episodes, seed
            and ``states``; means ``earned`` and ``predicted``; depths and ``coverage`` as above. Empty where nobody
            looked.
    """

    row: str
    conditions: tuple[MeasuredCondition, ...]
    protocol: Mapping[str, Any]
    rules_version: int
    map_version: int
    confidence: float
    train_seed: int | None
    weights_sha256: str
    as_shipped: bool
    commit: str
    command: str
    precision: Mapping[str, float] = field(default_factory=dict)
    calibration: tuple[Mapping[str, Any], ...] = ()
    limits: tuple[str, ...] = ()
    told_calibration: tuple[Mapping[str, Any], ...] = ()

    @property
    def num_episodes(self) -> int:
        """How many there are under each condition."""
        return int(self.protocol["num_maps"]) * int(self.protocol["num_episodes"])

    def ends(self, metric: str) -> tuple[float, ...]:
        """Return a metric's means at the most averse and the least averse condition; one where there is only that.

        Example:
            >>> condition = MeasuredCondition("SAC", None, None, {"collisions": Estimate(2.7, 2.4, 3.1)})
            >>> Measured("SAC", (condition,), {}, 2, 1, 0.95, 0, "", True, "", "").ends("collisions")
            (2.7,)
        """
        ends = self.conditions[:1] if len(self.conditions) == 1 else (self.conditions[0], self.conditions[-1])
        return tuple(condition.metrics[metric].mean for condition in ends)

    def to_json(self) -> str:
        """Return the file's text."""
        return (
            json.dumps(
                {"format_version": MEASURED_VERSION} | asdict(self), indent=2, allow_nan=False, ensure_ascii=False
            )
            + "\n"
        )


def read_measured(folder: Path) -> Measured | None:
    """Return what was measured of the agent of a weights folder; None where the folder does not say.

    Raises:
        UserInputError: if it says so in a way that cannot be read.
    """
    path = folder / MEASURED_NAME
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise UserInputError(f"{path} cannot be read ({error}): publish the agent anew, or remove the file") from error
    try:
        values = json.loads(text)
        version = values.pop("format_version")
        if version not in range(1, MEASURED_VERSION + 1):
            raise ValueError(f"it is of format {version}, this version reads 1 to {MEASURED_VERSION}")
        return measured_of(values)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise UserInputError(
            f"{path} cannot be read ({type(error).__name__}: {error}): publish the agent anew, or remove the file"
        ) from error


def measured_of(values: Mapping[str, Any]) -> Measured:
    """Return what plain values say, as files have them."""
    conditions = tuple(
        MeasuredCondition(
            **{**condition, "metrics": {name: Estimate(**value) for name, value in condition["metrics"].items()}}
        )
        for condition in values["conditions"]
    )
    lists = {name: tuple(values.get(name, ())) for name in ("calibration", "limits", "told_calibration")}
    return Measured(**{**values, **lists, "conditions": conditions})
