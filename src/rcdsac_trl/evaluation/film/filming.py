"""A film of an evaluation's episodes, and a picture of their trajectories."""

import io
import itertools
from collections.abc import Sequence
from pathlib import Path

from PIL import Image
from tensordict.nn import TensorDictModuleBase

from rcdsac_trl.config.evaluation_settings import VideoSettings
from rcdsac_trl.deploy.policy.recalibration import Recalibration
from rcdsac_trl.evaluation.film.episode_film import Track, film
from rcdsac_trl.evaluation.film.recording import Moment, Recorder
from rcdsac_trl.evaluation.film.trajectories import trajectories
from rcdsac_trl.evaluation.film.video import write_video
from rcdsac_trl.rollout.make_agent import unpacked_loss
from rcdsac_trl.rollout.map_evaluator import Agent, EvaluationSpec, map_evaluator
from rcdsac_trl.rollout.quantile_predictor import QuantilePredictor
from rcdsac_trl.rollout.worker import RolloutWorker
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.interrupts import at_safe_points, interruption_point
from rcdsac_trl.system.progress import Work
from rcdsac_trl.world.task.episode import draw_motor_steps


def write_film(
    spec: EvaluationSpec,
    agent: Agent | None,
    video: VideoSettings,
    headings: Sequence[str],
    folder: Path,
    recalibration: Recalibration | None = None,
) -> list[Path]:
    """Drive the episodes of a map once more, film one under every condition, and draw the trajectories.

    All agents drive again, so that those that are filmed do, bit by bit, what they did when they were measured.

    Args:
        spec: what is driven.
        agent: what drives; None: the baseline drives.
        video: which episode is filmed.
        headings: one a condition.
        folder: takes the files.
        recalibration: by which the agent tells the quantiles of its return.

    Returns:
        The files.
    """
    tracks = recorded(spec, agent, video.map, video.episode, recalibration)
    motor_steps = draw_motor_steps(spec.world.task, spec.split, spec.seed, video.map, video.episode)
    named = [Track(heading, track) for heading, track in zip(headings, tracks, strict=True)]
    name = f"map{video.map}-episode{video.episode}"
    with Work(f"a film of {len(tracks[0])} steps", 1, "film") as work:
        frames = work.within(film(named, motor_steps * spec.world.robot.motor_period_s), len(tracks[0]))
        films = write_video(frames, folder / f"video-{name}", video.fps)
    picture = io.BytesIO()
    Image.fromarray(trajectories(named)).save(picture, "png", optimize=True)
    atomic.write(folder / f"ways-{name}.png", picture.getvalue())
    return [*films, folder / f"ways-{name}.png"]


def recorded(
    spec: EvaluationSpec,
    agent: Agent | None,
    map_index: int,
    episode: int,
    recalibration: Recalibration | None = None,
) -> list[list[Moment]]:
    """Drive a map, and return the moments of one episode under every condition."""
    rows = [block * spec.num_episodes + episode for block in range(len(spec.conditions))]
    predictor = None
    # With navigation around it an agent is told, and driven, otherwise than the environment says.
    if agent is not None and not spec.navigation.is_on and spec.trained.algo.critic == "quantile":
        predictor = QuantilePredictor(unpacked_loss(spec.trained, agent.loss).critics, rows)
    watching: list[Recorder] = []

    def watch(worker: RolloutWorker, policy: TensorDictModuleBase) -> Recorder:
        watching.append(Recorder(policy, worker.env.agents, rows, predictor, recalibration))
        return watching[0]

    actor, loss = (None, None) if agent is None else agent
    steps = itertools.count(1)
    with (
        at_safe_points(),
        map_evaluator(spec, actor, loss, wrap=watch) as drive,
        Work(f"map {map_index} once more, for the film", 1, "map") as work,
    ):

        def before_step() -> None:
            interruption_point()
            work.reach(next(steps) / spec.world.task.episode_steps)

        drive(map_index, before_step)
    return watching[0].tracks
