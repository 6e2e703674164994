"""What a person should know before driving with an agent, as Markdown, and in a line."""

from collections.abc import Mapping, Sequence
from typing import Any

from rcdsac_trl.deploy.policy.acting import ActingSettings
from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.policy.measured import Estimate, Measured
from rcdsac_trl.robot.range_sensor import NUM_BINS
from rcdsac_trl.robot.robot_settings import RobotSettings

# Metric, what it is called in a card, and how its numbers are written.
_SHOWN = (
    ("collisions", "collisions", ".2f"),
    ("reward", "reward", ".0f"),
    ("collision_free", "free of collision", ".2f"),
    ("goals", "goals", ".2f"),
    ("mean_speed_m_per_s", "m/s", ".2f"),
    ("success", "first goal reached untouched", ".2f"),
)
# What can be hit, as `collisions.csv` has it, and what it is called in a card.
_THINGS = (
    ("all", "all"),
    ("outer_wall", "outer walls"),
    ("inner_wall", "inner walls"),
    ("mapped_clutter", "clutter the planner knows"),
    ("unmapped_clutter", "clutter it does not know"),
    ("mover", "movers"),
)


# What rounding may change, as `release.rounding` names it, and by how much.
_ROUNDED = {
    "linear_speed_m_per_s": "its linear speed by {} m/s",
    "angular_speed_rad_per_s": "its angular speed by {} rad/s",
    "quantile": "its quantiles of the return by {}",
}


def summary(config: AgentConfig, acting: ActingSettings, measured: Measured | None) -> str:
    """Return in a line what an agent is, how it acts, and what is known of how it drives."""
    parts = [config.name, f"sensor {config.sensor}"]
    if config.memory_s > 0.0:
        parts.append(f"remembers {config.memory_s:g} s")
    if config.context is not None and config.context_range is not None:
        parts.append(f"{config.context} in [{config.context_range[0]:g}, {config.context_range[1]:g}]")
    elif config.fixed_beta is not None:
        parts.append(f"for beta={config.fixed_beta:g} alone")
    parts.append(f"robot {config.robot.name}")
    if acting.chooses:
        parts.append(f"chooses among {acting.num_candidates} actions")
    if measured is not None:
        collisions, rewards = ([c.metrics[name].mean for c in measured.conditions] for name in ("collisions", "reward"))
        parts.append(f"an episode: collisions {_span(collisions, 2)}, reward {_span(rewards, 0)}")
    return ", ".join(parts)


def _span(values: Sequence[float], digits: int) -> str:
    """Write the smallest and the largest of some numbers, or the only one."""
    low, high = (f"{value:.{digits}f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def limits_of(config: AgentConfig) -> tuple[str, ...]:
    """Return what nobody should expect of an agent, in sentences."""
    return (
        f"Trained in simulation only, on a differential-drive robot of {config.robot.circumradius_m:.3g} m radius.",
        "It has driven no real robot: keep the speed limit and the stop zone on, and a hand on the emergency stop.",
        "One training with one seed: another agent of the same recipe will differ by more than the intervals say.",
    )


def model_card(config: AgentConfig, num_parameters: int, measured: Measured | None = None) -> str:
    """Return the card of an agent.

    Args:
        config: what it is.
        num_parameters: how many numbers were learnt.
        measured: what is known of how it drives.
    """
    told = "none"
    if config.context is not None and config.context_range is not None:
        told = f"`{config.context}` in [{config.context_range[0]:g}, {config.context_range[1]:g}]"
    if config.fixed_beta is not None:
        told += f"; it was trained for beta = {config.fixed_beta:g} alone"
    origin = "\n".join(
        f"| {key} | {_written(value)} |" for key, value in config.provenance.items() if value is not None
    )
    remembered = f", what it saw in the last {config.memory_s:g} s" if config.memory_s > 0.0 else ""
    reported = "raw, not recalibrated" if config.recalibration is None else str(config.recalibration)
    reports = f"| reports | quantiles of the return, {reported} |\n" if config.critic == "quantile" else ""
    driving = "" if measured is None else f"\n{driving_section(measured)}\n"
    sentences = limits_of(config) if measured is None else measured.limits
    limits = "\n".join(f"- {sentence}" for sentence in sentences)
    return f"""# {config.name}, {config.sensor} sensor

A navigation agent of rcdsac_trl: recurrent actor and {config.num_critics}
{config.critic} critic(s), {num_parameters:,} parameters.

```python
import rcdsac_trl

policy = rcdsac_trl.load("this/folder")  # or the folder's name, if `rcdsac-trl agents` lists it
```

| | |
|---|---|
| drives | `{config.robot.name}`, {_described(config.robot)} |
| reads | {NUM_BINS} range bins of which the `{config.sensor}` sensor has some, two waypoints, velocities{remembered} |
| input besides | {told} |
| risk measure | {config.measure} |
| acts every | {config.period_s[0]:g} to {config.period_s[1]:g} s |
| acts by | {config.acting} |
{reports}| gives | linear velocity in m/s, angular velocity in rad/s |
{origin}
{driving}
## Limits

{limits}
"""


def driving_section(measured: Measured) -> str:
    """Return what was measured, as a section of a card."""
    told = measured.protocol
    parts = [
        "## How it drives",
        f"Means of {measured.num_episodes} episodes of {told['task']['episode_steps']} steps on {told['num_maps']} "
        f"{told['split']} maps (seed {told['seed']}; maps of version {measured.map_version},\nrules of version "
        f"{measured.rules_version}), which it was never trained on and never chosen by; {measured.confidence:.0%} "
        f"intervals with the map as the unit.\n{_alone(told['task'])} {_precision(measured)}",
        _driving_table(measured).rstrip(),
        f"To measure it again on the same maps: `{measured.command}`.",
    ]
    if any(condition.collisions_by_thing for condition in measured.conditions):
        parts.append(f"What is hit, times an episode:\n\n{_collision_table(measured)}".rstrip())
    if measured.calibration:
        parts.append(
            "What the critics predict, beside realised returns (all: true quantiles would show the fraction):\n\n"
            f"{_calibration_table(measured)}".rstrip()
        )
    if measured.told_calibration:
        first = measured.told_calibration[0]
        driven = f"{first['num_maps']} evaluation maps x {first['num_episodes']} episodes (seed {first['seed']})"
        parts.append(
            f"The return that it reports while it drives, beside what it earns on {driven}; raw: as its critics "
            f"predict:\n\n{_told_table(measured)}".rstrip()
        )
    return "\n\n".join(parts)


def _alone(task: Mapping[str, Any]) -> str:
    """Say what stood between the agent and the wheels while it was measured: what its task put there.

    Example:
        >>> _alone({"stop_zone_share": 0.5})
        'A stop zone limited it in 50% of the episodes; it had neither detours nor a watchdog.'
    """
    if share := task.get("stop_zone_share", 0.0):
        return f"A stop zone limited it in {share:.0%} of the episodes; it had neither detours nor a watchdog."
    return "It drove alone: no stop zone, no detours, no watchdog."


def _precision(measured: Measured) -> str:
    changes = [_ROUNDED[quantity].format(f"{by:.1g}") for quantity, by in measured.precision.items()]
    changed = f" Half precision changes {', '.join(changes)} at most." if changes else ""
    if measured.as_shipped:
        return f"It was measured as it ships, in half precision.{changed}"
    return f"It was measured in single precision and ships in half.{changed}"


def _driving_table(measured: Measured) -> str:
    shown = [entry for entry in _SHOWN if all(entry[0] in condition.metrics for condition in measured.conditions)]
    rows = [
        [condition.label, *(cell(condition.metrics[metric], form) for metric, _, form in shown)]
        for condition in measured.conditions
    ]
    return markdown_table(["condition", *(heading for _, heading, _ in shown)], rows)


def _collision_table(measured: Measured) -> str:
    looked = [condition for condition in measured.conditions if condition.collisions_by_thing]
    rows = []
    for condition in looked:
        by_thing = condition.collisions_by_thing
        hit = [f"{by_thing.get(thing, {}).get('per_episode') or 0.0:.2f}" for thing, _ in _THINGS]
        rows.append(
            [condition.label, *hit, *(_share(by_thing["all"], key) for key in ("outside_share", "never_share"))]
        )
    headings = ["condition", *(heading for _, heading in _THINGS), "outside the sensor's sectors", "never sensed"]
    return markdown_table(headings, rows)


def _share(of_all: Mapping[str, float | None], key: str) -> str:
    share = of_all.get(key)
    return "" if share is None else f"{share:.0%}"


def _calibration_table(measured: Measured) -> str:
    fractions = list(measured.calibration[0]["coverage"])
    rows = [
        [
            "all" if entry["beta"] is None else f"{entry['beta']:g}",
            f"{entry['predicted_tail_depth']:.2f}",
            f"{entry['tail_depth']:.2f}",
            *(f"{entry['coverage'][fraction]:.0%}" for fraction in fractions),
        ]
        for entry in measured.calibration
    ]
    covered = [f"returns below the quantile of {float(fraction):.0%}" for fraction in fractions]
    return markdown_table(["β", "depth of the worst tenth, predicted", "realised", *covered], rows)


def _told_table(measured: Measured) -> str:
    rows = [
        [
            "all" if entry["beta"] is None else f"{entry['beta']:g}",
            entry["told"],
            f"{entry['predicted']:.1f} / {entry['earned']:.1f}",
            f"{entry['predicted_tail_depth']:.1f} / {entry['tail_depth']:.1f}",
            *(f"{share:.0%}" for share in entry["coverage"].values()),
        ]
        for entry in sorted(measured.told_calibration, key=lambda entry: (entry["beta"] or 0.0, entry["told"] != "raw"))
    ]
    covered = [f"below the {float(fraction):.0%} quantile" for fraction in measured.told_calibration[0]["coverage"]]
    headings = [
        "β",
        "quantiles",
        "mean return, predicted / realised",
        "depth of the worst tenth, predicted / realised",
        *covered,
    ]
    return markdown_table(headings, rows)


def cell(estimate: Estimate, form: str) -> str:
    """Write a mean with its interval.

    Example:
        >>> cell(Estimate(1.03, 0.88, 1.18), ".2f")
        '1.03 [0.88, 1.18]'
    """
    return f"{estimate.mean:{form}} [{estimate.low:{form}}, {estimate.high:{form}}]"


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    r"""Return a table as Markdown.

    Example:
        >>> markdown_table(["a", "b"], [["1", "2"]])
        '| a | b |\n| --- | --- |\n| 1 | 2 |\n'
    """
    return "".join(f"| {' | '.join(row)} |\n" for row in (headings, ["---"] * len(headings), *rows))


def _written(value: Any) -> str:
    """Write where an agent comes from: a number that was learnt in so many digits as anybody compares."""
    return f"{value:.3f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def _described(robot: RobotSettings) -> str:
    """Say of a robot what somebody compares with the own one."""
    shape = (
        f"{robot.length_m:g} x {robot.width_m:g} m" if robot.shape == "rectangle" else f"{robot.radius_m:g} m radius"
    )
    return (
        f"{robot.shape} of {shape}, {robot.min_linear_velocity:g} to {robot.max_speed_m_per_s:g} m/s, "
        f"{robot.max_turn_deg_per_s:g} degrees/s, range sensor up to {robot.lidar.max_range_m:g} m"
    )
