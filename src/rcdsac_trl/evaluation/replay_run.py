"""A replay from its config: what was recorded, who is asked, and the tables of it."""

from collections.abc import Generator, Sequence
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from omegaconf import DictConfig

from rcdsac_trl.config.replay_settings import ReplaySettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.deploy import Policy
from rcdsac_trl.deploy.recordings.open_recording import open_recording
from rcdsac_trl.deploy.recordings.sensor_recording import SensorRecording
from rcdsac_trl.evaluation.film.replay_film import FPS, frames
from rcdsac_trl.evaluation.film.video import check_extra, write_video
from rcdsac_trl.evaluation.measured_run import Findings, MeasuredRun
from rcdsac_trl.evaluation.recorded_drive import RecordedDrive, row_of, seen_from
from rcdsac_trl.evaluation.recording_survey import Survey, kinds_of, survey
from rcdsac_trl.release.named_agent import NamedAgent, named_agent
from rcdsac_trl.rollout.evaluation_pool import Rows
from rcdsac_trl.system.progress import Watch, Work, counted
from rcdsac_trl.system.provenance import commit


def make_replay(cfg: DictConfig) -> MeasuredRun:
    """Make a replay of a recording; refuses before anything is written.

    It writes ``commands.csv``, one row a control period; ``seen.csv``, where something was seen, to 10 cm;
    ``replay.json``; and, if asked for, a film.

    Raises:
        UserInputError: for a missing agent or recording, and whatever would keep the agent from being asked.
    """
    settings = read_config(cfg, ReplaySettings)
    if settings.record:
        check_extra()
    agent = named_agent(settings.run, settings.checkpoint)
    policy = Policy(agent.weights())
    policy.check_beta(settings.beta)
    recording, found = _looked_through(settings)
    drive = RecordedDrive(recording, found, policy, settings)

    def measure(watch: Watch) -> Generator[Rows, None, None]:
        rows = []
        for number, period in enumerate(drive.periods()):
            # Only what is filmed is kept whole.
            row = {"row": row_of(period), "seen": np.unique(seen_from(period).round(1), axis=0)}
            rows.append(row | ({"period": period} if settings.record else {}))
            watch(number)
        yield rows

    return MeasuredRun(
        kind="replay",
        out=_default_out(recording, agent, settings) if settings.out is None else Path(settings.out),
        described=_described(recording, found, agent, policy, settings),
        unit="recording",
        num_units=1,
        unit_steps=drive.num_periods,
        processes=0,
        measure=measure,
        findings=_findings,
        film=partial(_film, drive.period_s) if settings.record else None,
    )


@lru_cache(maxsize=1)  # a command makes what it runs twice, first to see whether it can
def _looked_through(settings: ReplaySettings) -> tuple[SensorRecording, Survey]:
    assert settings.recording is not None
    recording = open_recording(Path(settings.recording))
    return recording, survey(recording, settings)


def _described(
    recording: SensorRecording, found: Survey, agent: NamedAgent, policy: Policy, settings: ReplaySettings
) -> dict[str, Any]:
    files = [recording.path] if recording.path.is_file() else sorted(recording.path.iterdir())
    return {
        "recording": recording.path.name,
        "recorded_bytes": sum(file.stat().st_size for file in files),
        "topics": kinds_of(found.topics, recording),
        "duration_s": round(found.ended_s - found.began_s, 3),
        "waypoints": found.waypoints,
        "run": settings.run,
        "agent": policy.config.name,
        "sensor": policy.config.sensor,
        "max_range_m": policy.robot.lidar.max_range_m,
        **agent.described,
        "acting": asdict(policy.acting),
        "beta": policy.default_beta if settings.beta is None else settings.beta,
        "zero_means": settings.zero_means,
        "nan_means": settings.nan_means,
        "laser": settings.laser,
        "fractions": [round(float(fraction), 6) for fraction in policy.fractions],
        "commit": commit(),
    }


def _default_out(recording: SensorRecording, agent: NamedAgent, settings: ReplaySettings) -> Path:
    who = agent.stem if agent.stem and agent.out == Path() else f"{agent.out.name}-{agent.stem}".strip("-")
    beta = "" if settings.beta is None else f"-beta{settings.beta:g}"
    ways = "" if settings.waypoints == "auto" else f"-{settings.waypoints}"
    return Path("replay") / f"{recording.path.stem}-{who}{beta}{ways}"


def _findings(rows: Rows) -> Findings:
    table = pd.DataFrame([row["row"] for row in rows])
    seen = np.unique(np.concatenate([row["seen"] for row in rows]), axis=0)
    tables = {"commands.csv": table, "seen.csv": pd.DataFrame(seen, columns=["x_m", "y_m"])}
    return Findings({name: table.to_csv(index=False, float_format="%.6g") for name, table in tables.items()})


def _film(period_s: float, folder: Path, rows: Rows) -> Sequence[Path]:
    periods = [row["period"] for row in rows]
    with Work(f"{counted(1, 'film')}, for {folder}", 1, "film") as work:
        pictures = work.within(frames(periods), len(periods))
        return write_video(pictures, folder / "replay", FPS / period_s)
