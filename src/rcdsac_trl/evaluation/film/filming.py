"""A film of an evaluation's episodes, and a picture of their trajectories."""

import io
from collections.abc import Sequence
from pathlib import Path

from PIL import Image
from tensordict.nn import TensorDictModuleBase
from tqdm import tqdm

from rcdsac_trl.config.evaluation_settings import VideoSettings
from rcdsac_trl.evaluation.film.episode_film import Track, film
from rcdsac_trl.evaluation.film.recording import Moment, Recorder
from rcdsac_trl.evaluation.film.trajectories import trajectories
from rcdsac_trl.evaluation.film.video import write_video
from rcdsac_trl.robot.limits import MOTOR_PERIOD_S
from rcdsac_trl.rollout.make_agent import unpacked_loss
from rcdsac_trl.rollout.map_evaluator import Agent, Course, driver
from rcdsac_trl.rollout.quantile_predictor import QuantilePredictor
from rcdsac_trl.rollout.worker import Team
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.interrupts import interruption_point
from rcdsac_trl.world.task.episode import draw_motor_steps


def write_film(
    course: Course, agent: Agent | None, video: VideoSettings, headings: Sequence[str], folder: Path
) -> list[Path]:
    """Drive the episodes of a map once more, film one under every condition, and draw the trajectories.

    All agents drive again, so that those that are filmed do, bit by bit, what they did when they were measured.

    Args:
        course: what is driven.
        agent: what drives; None: the baseline drives.
        video: which episode is filmed.
        headings: one a condition.
        folder: takes the files.

    Returns:
        The files.
    """
    tracks = recorded(course, agent, video.map, video.episode)
    motor_steps = draw_motor_steps(course.world.task, course.split, course.seed, video.map, video.episode)
    named = [Track(heading, track) for heading, track in zip(headings, tracks, strict=True)]
    frames = tqdm(film(named, motor_steps * MOTOR_PERIOD_S), total=len(tracks[0]), unit="frame", disable=None)
    name = f"map{video.map}-episode{video.episode}"
    films = write_video(frames, folder / f"video-{name}", video.fps)
    picture = io.BytesIO()
    Image.fromarray(trajectories(named)).save(picture, "png", optimize=True)
    atomic.write(folder / f"ways-{name}.png", picture.getvalue())
    return [*films, folder / f"ways-{name}.png"]


def recorded(course: Course, agent: Agent | None, map_index: int, episode: int) -> list[list[Moment]]:
    """Drive a map, and return the moments of one episode under every condition."""
    rows = [block * course.num_episodes + episode for block in range(len(course.conditions))]
    predictor = None
    if agent is not None and course.trained.algo.critic == "quantile":
        predictor = QuantilePredictor(unpacked_loss(course.trained, agent.loss).critics, rows)
    watching: list[Recorder] = []

    def watch(team: Team, policy: TensorDictModuleBase) -> Recorder:
        watching.append(Recorder(policy, team.env.agents, rows, predictor))
        return watching[0]

    actor, loss = (None, None) if agent is None else agent
    with driver(course, actor, loss, wrap=watch) as drive:
        drive(map_index, interruption_point)
    return watching[0].tracks
