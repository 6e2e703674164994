"""What is wrong with a call that can be told without torch: each verb looks here before it imports what it works with.

Whoever makes the verb's object reads the same settings again, and refuses what shows only then.
"""

import os
from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.config.calibration_settings import CalibrationSettings
from rcdsac_trl.config.course_settings import CourseSettings
from rcdsac_trl.config.evaluation_settings import EvaluationSettings
from rcdsac_trl.config.named_folder import default_training, find_agent
from rcdsac_trl.config.play_settings import PlaySettings
from rcdsac_trl.config.release_settings import ExportSettings, PublishSettings
from rcdsac_trl.config.replay_settings import ReplaySettings
from rcdsac_trl.config.run_config import agent_of_run, read_config
from rcdsac_trl.config.shipped_settings import VerificationSettings
from rcdsac_trl.deploy import find_weights
from rcdsac_trl.deploy.recordings.open_recording import open_recording
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.listening import check_can_listen
from rcdsac_trl.system.resources import check_empty, check_out, check_writable
from rcdsac_trl.world.maps.map_source import check_maps


def look_at_evaluation(cfg: DictConfig) -> None:
    """Refuse settings, a run and values of beta that `evaluate` cannot take.

    Raises:
        UserInputError: naming what is wrong.
    """
    settings = read_config(cfg, EvaluationSettings)
    if settings.run is None:
        trained = default_training()
    else:
        trained = find_agent(settings.run, settings.checkpoint, half_precision=settings.half_precision).settings()
    settings.conditions_of(trained)
    settings.latency_of(trained)
    chosen = settings.world_of(trained)
    chosen.world_for(settings.num_episodes)  # refuses a robot that does not fit
    chosen.check_maps()
    _look_at_out(settings.out)


def look_at_calibration(cfg: DictConfig) -> None:
    """Refuse settings and a run that `calibrate` cannot take.

    Raises:
        UserInputError: naming what is wrong.
    """
    settings = read_config(cfg, CalibrationSettings)
    if settings.run is not None:
        found = find_agent(settings.run, settings.checkpoint, half_precision=settings.half_precision)
        trained = found.settings()
        settings.conditions_of(trained)
        settings.horizon_in(trained.task.episode_steps)
        settings.check_missing(trained.learner.gamma, trained.task.episode_steps)
        settings.acting_of(trained)
        check_maps(trained.map, trained.task.min_path_m, trained.robot.circumradius_m)
    _look_at_out(settings.out)


def look_at_course(cfg: DictConfig) -> None:
    """Refuse settings and names that `course` cannot take.

    Raises:
        UserInputError: naming what is wrong.
    """
    settings = read_config(cfg, CourseSettings)
    for run in settings.runs:
        if not os.path.exists(run):  # then it can only be the name of a shipped agent
            find_weights(run)
    _look_at_out(settings.out)


def look_at_export(cfg: DictConfig) -> None:
    """Refuse settings and a run that `export` cannot take.

    Raises:
        UserInputError: naming what is wrong.
    """
    settings = read_config(cfg, ExportSettings)
    if settings.run is not None and (found := find_agent(settings.run, settings.checkpoint)).is_run:
        agent_of_run(found.path)
    if settings.out is not None:
        check_empty(Path(settings.out))


def look_at_publication(cfg: DictConfig) -> None:
    """Refuse settings and runs that `publish` cannot take.

    Raises:
        UserInputError: naming what is wrong.
    """
    settings = read_config(cfg, PublishSettings)
    for run in settings.runs:
        agent_of_run(Path(run))
    for folder in (settings.weights, settings.results):
        check_writable(Path(folder))


def look_at_verification(cfg: DictConfig) -> None:
    """Refuse settings and agents that `verify` cannot take.

    Raises:
        UserInputError: naming what is wrong.
    """
    settings = read_config(cfg, VerificationSettings)
    settings.claims()
    check_writable(Path(settings.out))


def look_at_play(cfg: DictConfig) -> None:
    """Refuse settings, agents and maps that `play` cannot take.

    Raises:
        UserInputError: naming what is wrong.
    """
    settings = read_config(cfg, PlaySettings)
    check_can_listen(settings.host, settings.port)
    for run in settings.runs:
        find_agent(run)
    for path in settings.maps:
        if not os.path.exists(path):
            raise UserInputError(f"maps={path} does not exist: name a file that map=file takes")
    check_writable(Path(settings.films))


def look_at_replay(cfg: DictConfig) -> None:
    """Refuse settings, an agent and a recording that `replay` cannot take.

    Raises:
        UserInputError: naming what is wrong.
    """
    settings = read_config(cfg, ReplaySettings)
    find_agent(settings.run, settings.checkpoint)
    assert settings.recording is not None
    open_recording(Path(settings.recording))
    _look_at_out(settings.out)


def _look_at_out(out: str | None) -> None:
    if out is not None:
        check_out(Path(out))
