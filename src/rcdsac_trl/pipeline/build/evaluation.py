"""An evaluation from its config."""

import sys
from collections.abc import Generator
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from rcdsac_trl.deploy.adaptive import BanditBeta
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.pipeline import logs, resources, runtime
from rcdsac_trl.pipeline.adaptive import BANDIT, play_bandit
from rcdsac_trl.pipeline.build.agent import make_average, make_loss, packed_loss
from rcdsac_trl.pipeline.build.driver import Agent, Course, driver
from rcdsac_trl.pipeline.build.filming import write_film
from rcdsac_trl.pipeline.build.read import evaluation_settings, settings_of_run, training_settings
from rcdsac_trl.pipeline.checkpoint import load_weights
from rcdsac_trl.pipeline.cli import compose
from rcdsac_trl.pipeline.drivers import Rows, drive_maps, resolve_processes
from rcdsac_trl.pipeline.evaluation import EvaluationRun
from rcdsac_trl.pipeline.metrics import Condition
from rcdsac_trl.pipeline.planners.baselines import PURSUIT, check_baseline, settings_of
from rcdsac_trl.pipeline.run_settings import EvaluationSettings, TrainingSettings
from rcdsac_trl.pipeline.saved import CHECKPOINTS, Name, find
from rcdsac_trl.pipeline.settings import WorldSettings
from rcdsac_trl.pipeline.validation import packed
from rcdsac_trl.pipeline.video import check_extra
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.simulation import SIMULATION_BYTES


def evaluation(cfg: DictConfig) -> EvaluationRun:
    """Make an evaluation of a run or a baseline; refuses before anything is written.

    Raises:
        UserInputError: for a missing run, a beta that is missing or outside its domain, a sensor that does not fit, a
            baseline that cannot drive.
    """
    settings = evaluation_settings(cfg)
    if settings.record:
        check_extra()
    trained = _trained(settings)
    algo = trained.algo if settings.run is not None else None
    conditions = [Condition()] if algo is None else algo.conditions(settings.beta, settings.collision_weight)
    controllers = settings.beta_controller or ()
    # The bandit's episodes are among those of the fixed values: none is driven for it.
    driven = [*conditions, *(Condition(controller=name) for name in controllers if name != BANDIT)]
    world = _evaluation_world(settings, trained, len(driven))
    if settings.baseline is not None:
        check_baseline(settings.baseline, world.sensor)
    device = runtime.resolve_device(settings.device)
    processes = 0 if settings.gui else resolve_processes(settings.num_workers, settings.num_maps)
    simulations = max(1, processes) * world.num_agents
    remedy = "lower num_episodes or num_workers, or end other programs"
    resources.check_memory(f"{simulations} simulations", simulations * SIMULATION_BYTES, remedy)
    name = f"{settings.split}-seed{settings.seed}-{settings.num_maps}x{settings.num_episodes}"
    if settings.run is not None:
        checkpoints = Path(settings.run) / CHECKPOINTS
        find(checkpoints, settings.checkpoint)
        told = "".join(f"-{name}".replace("=", "_") for name in [*map(str, conditions), *controllers])
        default_out = Path(settings.run) / "evaluation" / f"{settings.checkpoint}-{name}{told}"
    else:
        default_out = Path("evaluation") / f"{settings.baseline}-{world.sensor}-{name}".replace(":", "-")

    course = Course(
        trained=trained,
        world=world,
        conditions=driven,
        split=settings.split,
        seed=settings.seed,
        num_episodes=settings.num_episodes,
        sampled=settings.sampled,
        device=device,
        threads=1 if settings.threads == "auto" else settings.threads,
        trips=True,
        controller=settings.controller if controllers else None,
        baseline=settings.baseline or PURSUIT,
    )

    @cache  # Read once: a training that goes on may write another checkpoint meanwhile.
    def agent() -> Agent | None:
        return None if algo is None else _read_agent(trained, checkpoints, settings.checkpoint)

    def maps() -> Generator[Rows, None, None]:
        make = partial(driver, course, *(agent() or (None,)))
        return drive_maps(make, settings.num_maps, processes)

    def film(folder: Path) -> list[Path]:
        name = str(settings.baseline) if algo is None else algo.name
        headings = [f"{name}  {condition.heading}".strip() for condition in driven]
        return write_film(course, agent(), settings.video, headings, folder)

    described = {
        "agent": settings.baseline if algo is None else algo.name,
        "measure": None if algo is None else algo.distortion.name,
        "sensor": world.sensor,
        "train_seed": None if algo is None else trained.seed,
        "checkpoint": None if algo is None else settings.checkpoint,
        "split": settings.split,
        "seed": settings.seed,
        "num_maps": settings.num_maps,
        "num_episodes": settings.num_episodes,
        "sampled": settings.sampled,
        "conditions": [*map(str, conditions), *controllers],
        "map": asdict(world.map_settings),
        "task": asdict(world.task),
        "commit": logs.commit(),
    }
    if controllers:
        described["controller"] = asdict(settings.controller)
    if settings.baseline is not None:
        described |= settings_of(settings.baseline)
    return EvaluationRun(
        out=Path(settings.out) if settings.out is not None else default_out,
        described=described,
        num_maps=settings.num_maps,
        maps=maps,
        more=partial(_played, settings) if BANDIT in controllers else None,
        film=film if settings.record else None,
    )


def _played(settings: EvaluationSettings, episodes: pd.DataFrame) -> pd.DataFrame:
    """Return the episodes that a bandit would have driven."""
    chosen, turned = settings.beta, settings.controller
    assert chosen is not None
    bandit = BanditBeta(
        sorted(chosen),
        stream(settings.seed, "beta bandit"),
        step_size=turned.step_size,
        exploration=turned.exploration,
    )
    return play_bandit(episodes, bandit)


def _read_agent(trained: TrainingSettings, checkpoints: Path, checkpoint: Name) -> Agent:
    loss = make_loss(trained, "cpu")
    average = make_average(loss, trained.learner)
    for damaged in load_weights(checkpoints, checkpoint, loss=loss, average=average):
        print(f"rcdsac_trl: {damaged}", file=sys.stderr)
    return Agent(packed(average.module), packed_loss(loss))


def _trained(settings: EvaluationSettings) -> TrainingSettings:
    if settings.run is not None:
        return settings_of_run(Path(settings.run))
    # A baseline drives in training's default world; which agent would be trained there does not matter.
    return training_settings(compose("train", ["+algo=sac"]))


def _evaluation_world(settings: EvaluationSettings, trained: TrainingSettings, num_conditions: int) -> WorldSettings:
    sensor = settings.sensor or trained.sensor
    if settings.run is not None and sensor != trained.sensor:
        raise UserInputError(
            f"sensor={sensor.name} does not fit: {settings.run} was trained with sensor={trained.sensor.name}, "
            "leave it out"
        )
    return WorldSettings(
        map_settings=settings.map or trained.map,
        task=settings.task or trained.task,
        sensor=sensor.name,
        num_agents=settings.num_episodes * num_conditions,
        num_workers=0,  # a process drives whole maps
        gui=settings.gui,
    )
