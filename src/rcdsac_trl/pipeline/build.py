"""From the config to objects: the only module that reads ``cfg``."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, InitTracker, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.objectives import LossModule, SoftUpdate

from rcdsac_trl.agent.actor import OBSERVATIONS, build_actor, build_critic, build_policy, recurrent_state_primer
from rcdsac_trl.agent.losses import DistributionalSACLoss
from rcdsac_trl.agent.networks import Widths
from rcdsac_trl.agent.transforms import EpisodeSampler, Relabel
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.pipeline import logs, runtime
from rcdsac_trl.pipeline.checkpoint import Checkpoints, load_manifest, load_weights
from rcdsac_trl.pipeline.cli import choices, compose
from rcdsac_trl.pipeline.evaluation import EvaluationRun, evaluate
from rcdsac_trl.pipeline.metrics import Condition
from rcdsac_trl.pipeline.policies import CollectionPolicy, OnDevice, PursuitPolicy
from rcdsac_trl.pipeline.replay import SequenceReplay
from rcdsac_trl.pipeline.settings import AlgoSettings, DistortionSettings, LearnerSettings, Schedule
from rcdsac_trl.pipeline.trainer import Learner, Trainer
from rcdsac_trl.seeding import torch_seed, torch_stream
from rcdsac_trl.world.env import make_env, resolve_num_workers
from rcdsac_trl.world.lidar import SENSORS, sensor_mask
from rcdsac_trl.world.maps import MapSettings, Split
from rcdsac_trl.world.task import TaskSettings

# Validation and the default evaluation look at the same maps whatever seed a run was trained with.
VALIDATION_SEED = 0


def run_folder() -> Path:
    """Return the folder Hydra made for this job."""
    return Path(HydraConfig.get().runtime.output_dir)


# ---------------------------------------------------------------- settings


def plain(node: DictConfig) -> dict[str, Any]:
    """Turn a section of the config into keyword arguments."""
    return OmegaConf.to_container(node, resolve=True)  # type: ignore[return-value]


def algo_settings(cfg: DictConfig) -> AlgoSettings:
    """Read the row; a config without one gets the sentence that lists the choices."""
    if cfg.get("algo") is None:
        raise UserInputError(f"no algorithm chosen: add +algo=<name>, one of {', '.join(choices('algo'))}")
    values = plain(cfg.algo)
    return AlgoSettings(**values | {"distortion": DistortionSettings(**values["distortion"])})


@dataclass(frozen=True)
class WorldSettings:
    """What an environment is made of."""

    map_settings: MapSettings
    task: TaskSettings
    sensor: str
    num_agents: int
    num_workers: int | str

    def __post_init__(self) -> None:
        """Refuse an unknown sensor and agents that the workers cannot share."""
        if self.sensor not in SENSORS:
            raise UserInputError(f"sensor.name={self.sensor} is unknown: choose one of {', '.join(SENSORS)}")
        if self.num_agents < 1:
            raise UserInputError(f"world.num_agents={self.num_agents} is below 1: raise it")
        resolve_num_workers(self.num_workers, self.num_agents)


def world_settings(cfg: DictConfig) -> WorldSettings:
    """Read what the training environment is made of."""
    return WorldSettings(
        map_settings=MapSettings(**plain(cfg.map)),
        task=TaskSettings(**plain(cfg.task)),
        sensor=cfg.sensor.name,
        num_agents=cfg.world.num_agents,
        num_workers=cfg.world.num_workers,
    )


def check_training(cfg: DictConfig) -> None:
    """Build everything that is cheap, so that what cannot work is refused before anything is written."""
    algo = algo_settings(cfg)
    schedule = Schedule(**plain(cfg.schedule))
    if min(schedule.range_fraction(0), 1.0) < 1 and algo.conditioning == "per_episode":
        algo.distortion.measure.widen(0.0, 0.0)
    if not isinstance(cfg.seed, int) or cfg.seed < 0:
        raise UserInputError(f"seed={cfg.seed} is not a whole number of at least 0: use one")
    for section, key in (
        ("validation", "every_iterations"),
        ("validation", "num_maps"),
        ("checkpoint", "every_iterations"),
    ):
        if not isinstance(cfg[section][key], int) or cfg[section][key] < 1:
            raise UserInputError(f"{section}.{key}={cfg[section][key]} is not a whole number of at least 1: raise it")
    runtime.resolve_device(cfg.device)
    logs.check_backends(cfg.logger.backends)
    world = world_settings(cfg)
    Widths(**plain(cfg.network))
    learner = LearnerSettings(**plain(cfg.learner))
    make_replay(cfg, world, learner, algo, "cpu")


# ---------------------------------------------------------------- world


def environment(
    world: WorldSettings,
    algo: AlgoSettings | None,
    *,
    split: Split,
    seed: int,
    agent_ids: Sequence[int],
    memory: int,
    conditions: Sequence[Condition] | None = None,
    range_fraction: Callable[[int], float] | None = None,
) -> EnvBase:
    """Make an environment with everything a policy reads.

    Args:
        world: what it is made of.
        algo: what the agents are told; None for a baseline, which is told nothing.
        split: training, validation or evaluation maps.
        seed: root seed of maps, starts, goals, movers and of what the agents are told.
        agent_ids: numbers of the agents; equal numbers meet the same starts and goals.
        memory: size of the policy's recurrent state.
        conditions: tell agent i ``conditions[i]``; None draws what they are told an episode.
        range_fraction: how much of beta's range is open in an episode.
    """
    weighted = algo is not None and algo.collision_weight is not None
    base = make_env(
        world.map_settings,
        world.task,
        sensor=world.sensor,
        split=split,
        seed=seed,
        agent_ids=agent_ids,
        num_workers=world.num_workers,
        weighted_collisions=weighted,
    )
    env = TransformedEnv(base)
    env.append_transform(InitTracker())
    env.append_transform(StepCounter(max_steps=world.task.episode_steps))
    env.append_transform(recurrent_state_primer(memory))
    if algo is not None and algo.context_key is not None:
        env.append_transform(_told(algo, seed, agent_ids, conditions, range_fraction))
    return env


def _told(
    algo: AlgoSettings,
    seed: int,
    agent_ids: Sequence[int],
    conditions: Sequence[Condition] | None,
    range_fraction: Callable[[int], float] | None,
) -> EpisodeSampler:
    key = algo.context_key
    assert key is not None
    fixed = None
    if conditions is not None:
        fixed = [c.beta if key == "risk" else c.collision_weight for c in conditions]
    if key == "risk":
        measure = algo.distortion.measure
        fraction = range_fraction or (lambda episode: 1.0)
        draw = lambda u, episode: measure.widen(measure.from_uniform(u), fraction(episode))
    else:
        low, high = algo.collision_weight
        draw = lambda u, episode: low + (high - low) * u
    return EpisodeSampler(key, draw, seed=seed, agent_ids=agent_ids, fixed=fixed)


# ---------------------------------------------------------------- agent


def make_loss(cfg: DictConfig, algo: AlgoSettings, device: str) -> LossModule:
    """Make actor, critics and their loss, with weights from the stream ``"weights"``."""
    widths = Widths(**plain(cfg.network))
    learner = LearnerSettings(**plain(cfg.learner))
    vectors = dict(OBSERVATIONS)
    if algo.collision_weight is not None:
        vectors["collision_weight"] = 1
    # Layers draw their first weights from torch's global generator: lend it our stream, and give it back.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(torch_seed(cfg.seed, "weights"))
        actor = build_actor(2, vectors, algo.network_measure, widths)
        critics = [
            build_critic(2, vectors, algo.critic, algo.network_measure, widths) for _ in range(learner.num_critics)
        ]
    loss = DistributionalSACLoss(
        actor.to(device),
        [critic.to(device) for critic in critics],
        measure=algo.distortion.measure,
        num_quantiles=learner.num_quantiles,
        num_target_quantiles=learner.num_target_quantiles,
        num_risk_samples=learner.num_risk_samples,
        fractions_per=learner.fractions_per,
        kappa=learner.kappa,
        alpha_init=learner.alpha_init,
        target_entropy=learner.target_entropy,
        burn_in=learner.burn_in,
        generator=torch_stream(cfg.seed, "loss", device=device),
    ).to(device)
    loss.make_value_estimator(gamma=learner.gamma)
    return loss


def make_policy(loss: LossModule, env: EnvBase, generator: torch.Generator, device: str) -> TensorDictModuleBase:
    """Make the acting policy; it shares the weights of the loss's actor."""
    policy = build_policy(loss.actor_network, env.action_spec_unbatched, generator=generator)
    return policy if device == "cpu" else OnDevice(policy, device)


def make_optimizer(loss: LossModule, learner: LearnerSettings) -> torch.optim.Optimizer:
    """Make one Adam with a learning rate for each of the three losses."""
    groups = [
        {"params": parameters(loss.actor_network_params), "lr": learner.actor_lr},
        {"params": parameters(loss.critic_network_params), "lr": learner.critic_lr},
        {"params": [loss.log_alpha], "lr": learner.alpha_lr},
    ]
    return torch.optim.Adam(groups, fused=True)


def parameters(params: TensorDictParams) -> list[torch.nn.Parameter]:
    """List the parameters of one network of a loss."""
    return [p for p in params.values(True, True) if isinstance(p, torch.nn.Parameter)]


def make_relabel(cfg: DictConfig, learner: LearnerSettings, algo: AlgoSettings, device: str) -> Relabel | None:
    """Make what sets the beta of a batch; None where losses read no beta."""
    if algo.critic == "scalar":
        return None
    fixed = None
    if algo.conditioning != "per_episode":
        fixed = algo.beta if algo.beta is not None else algo.distortion.measure.neutral_beta
    return Relabel(
        algo.distortion.measure,
        mode="fixed" if fixed is not None else algo.relabel,
        per=learner.resample_per,
        beta=fixed,
        generator=torch_stream(cfg.seed, "relabel", device=device),
    )


# ---------------------------------------------------------------- training


def make_replay(
    cfg: DictConfig, world: WorldSettings, learner: LearnerSettings, algo: AlgoSettings, device: str
) -> SequenceReplay:
    """Make the replay, no larger than the run can fill."""
    steps = cfg.schedule.iterations * world.num_agents * world.task.episode_steps
    return SequenceReplay(
        capacity_steps=min(cfg.replay.capacity_steps, steps),
        episode_steps=world.task.episode_steps,
        sequence_length=learner.sequence_length,
        batch_size=learner.batch_size,
        sensor_mask=torch.from_numpy(sensor_mask(world.sensor)),
        context_keys=(algo.context_key,) if algo.context_key is not None else (),
        seed=cfg.seed,
        device=device,
    )


def trainer(cfg: DictConfig, folder: Path) -> Trainer:
    """Make a training run that writes into a folder."""
    algo, world = algo_settings(cfg), world_settings(cfg)
    learner_settings, schedule = LearnerSettings(**plain(cfg.learner)), Schedule(**plain(cfg.schedule))
    device, threads = runtime.resolve_device(cfg.device), runtime.set_threads(cfg.threads)
    facts = {"device": device, "threads": threads, "allocator": runtime.allocator()}
    logs.start_run_folder(folder, cfg, facts)

    loss = make_loss(cfg, algo, device)
    optimizer = make_optimizer(loss, learner_settings)
    env = environment(
        world,
        algo,
        split="train",
        seed=cfg.seed,
        agent_ids=range(world.num_agents),
        memory=cfg.network.memory,
        range_fraction=schedule.range_fraction,
    )
    exploration = torch.Generator(device=device)
    policy = CollectionPolicy(
        make_policy(loss, env, exploration, device),
        generator=exploration,
        seed=cfg.seed,
        pursuit_iterations=schedule.pursuit_iterations,
        pursuit_noise=schedule.pursuit_noise,
    )
    collector = Collector(
        env,
        policy,
        frames_per_batch=world.num_agents * world.task.episode_steps,
        total_frames=schedule.iterations * world.num_agents * world.task.episode_steps,
        exploration_type=ExplorationType.RANDOM,
        trust_policy=True,
        use_buffers=False,
    )
    clipped = [parameters(loss.actor_network_params), parameters(loss.critic_network_params)]
    learner = Learner(
        replay=make_replay(cfg, world, learner_settings, algo, device),
        loss=loss,
        relabel=make_relabel(cfg, learner_settings, algo, device),
        optimizer=optimizer,
        targets=SoftUpdate(loss, tau=learner_settings.target_coefficient),
        clipped=clipped,
        max_grad_norm=learner_settings.max_grad_norm,
    )
    log = logs.RunLog(folder, cfg.logger.backends)
    log.message(f"device {device}, {threads} threads, allocator: {runtime.allocator()}")
    return Trainer(
        schedule=schedule,
        collector=collector,
        set_iteration=policy.set_iteration,
        learner=learner,
        validate=_validation(cfg, world, algo, loss, device),
        validate_every=cfg.validation.every_iterations,
        checkpoints=Checkpoints(folder / "checkpoints", loss, optimizer),
        checkpoint_every=cfg.checkpoint.every_iterations,
        log=log,
        context_key=algo.context_key,
    )


def _validation(
    cfg: DictConfig, world: WorldSettings, algo: AlgoSettings, loss: LossModule, device: str
) -> Callable[[], pd.DataFrame]:
    conditions = algo.default_conditions
    env = evaluation_environment(
        world, algo, conditions, "validation", VALIDATION_SEED, world.num_agents, cfg.network.memory
    )
    policy = make_policy(loss, env, torch.Generator(device=device), device)

    def validate() -> pd.DataFrame:
        env.set_seed(VALIDATION_SEED)
        return evaluate(
            env,
            policy,
            conditions=conditions,
            num_agents=world.num_agents,
            num_maps=cfg.validation.num_maps,
            steps=world.task.episode_steps,
        )

    return validate


# ---------------------------------------------------------------- evaluation


def evaluation_environment(
    world: WorldSettings,
    algo: AlgoSettings | None,
    conditions: Sequence[Condition],
    split: Split,
    seed: int,
    num_agents: int,
    memory: int,
) -> EnvBase:
    """Make an environment in which a block of agents drives under each condition, side by side on the same map."""
    return environment(
        world,
        algo,
        split=split,
        seed=seed,
        agent_ids=list(range(num_agents)) * len(conditions),
        memory=memory,
        conditions=[condition for condition in conditions for _ in range(num_agents)],
    )


def evaluation(cfg: DictConfig) -> EvaluationRun:
    """Make an evaluation of a run or a baseline; refuses before anything is written.

    Raises:
        UserInputError: for a missing run, a beta that is missing or outside its domain, a sensor that does not fit.
    """
    if (cfg.run is None) == (cfg.baseline is None):
        raise UserInputError("name what to evaluate: either run=<folder> or baseline=pursuit")
    _check_evaluation(cfg)
    trained = load_run_config(Path(cfg.run)) if cfg.run is not None else compose("train", [])
    algo = algo_settings(trained) if cfg.run is not None else None
    if algo is None and (cfg.beta is not None or cfg.collision_weight is not None):
        raise UserInputError(f"baseline={cfg.baseline} has neither beta nor collision weight: leave them out")
    conditions = [Condition()] if algo is None else algo.conditions(cfg.beta, cfg.collision_weight)
    world = _evaluation_world(cfg, trained, len(conditions))
    device = runtime.resolve_device(cfg.device)
    name = f"{cfg.split}-seed{cfg.seed}-{cfg.num_maps}x{cfg.num_episodes}"
    if cfg.run is not None:
        load_manifest(Path(cfg.run) / "checkpoints", cfg.checkpoint)
        default_out = Path(cfg.run) / "evaluation" / f"{cfg.checkpoint}-{name}"
    else:
        default_out = Path("evaluation") / f"{cfg.baseline}-{world.sensor}-{name}"

    def rows(on_map: Callable[[int], None]) -> pd.DataFrame:
        runtime.set_threads(cfg.threads)
        env = evaluation_environment(
            world, algo, conditions, cfg.split, cfg.seed, cfg.num_episodes, trained.network.memory
        )
        if algo is None:
            policy: TensorDictModuleBase = PursuitPolicy()
        else:
            loss = make_loss(trained, algo, device)
            load_weights(Path(cfg.run) / "checkpoints", cfg.checkpoint, loss)
            generator = torch_stream(cfg.seed, "evaluation actions", device=device)
            policy = make_policy(loss, env, generator, device)
        try:
            return evaluate(
                env,
                policy,
                conditions=conditions,
                num_agents=cfg.num_episodes,
                num_maps=cfg.num_maps,
                steps=world.task.episode_steps,
                sampled=cfg.sampled,
                on_map=on_map,
            )
        finally:
            env.close()

    described = {
        "agent": cfg.baseline if algo is None else algo.name,
        "measure": None if algo is None else algo.distortion.name,
        "sensor": world.sensor,
        "checkpoint": None if algo is None else cfg.checkpoint,
        "split": cfg.split,
        "seed": cfg.seed,
        "num_maps": cfg.num_maps,
        "num_episodes": cfg.num_episodes,
        "sampled": cfg.sampled,
        "conditions": [str(condition) for condition in conditions],
        "map": asdict(world.map_settings),
        "task": asdict(world.task),
        "commit": logs.commit(),
    }
    return EvaluationRun(
        out=Path(cfg.out) if cfg.out is not None else default_out,
        described=described,
        num_maps=cfg.num_maps,
        rows=rows,
    )


def load_run_config(folder: Path) -> DictConfig:
    """Read the resolved config of a run.

    Raises:
        UserInputError: if the folder holds no run.
    """
    path = folder / logs.CONFIG_NAME
    if not path.is_file():
        raise UserInputError(f"run={folder} holds no {logs.CONFIG_NAME}: name a folder that training wrote")
    return OmegaConf.load(path)  # type: ignore[return-value]


def _check_evaluation(cfg: DictConfig) -> None:
    if cfg.baseline not in (None, "pursuit"):
        raise UserInputError(f"baseline={cfg.baseline} is unknown: the only one is pursuit")
    if cfg.checkpoint not in ("best", "last"):
        raise UserInputError(f"checkpoint={cfg.checkpoint} is unknown: choose best or last")
    if cfg.split not in ("evaluation", "validation"):
        raise UserInputError(f"split={cfg.split} is not for measuring: choose evaluation or validation")
    for key, lowest in (("num_maps", 1), ("num_episodes", 1), ("seed", 0)):
        if not isinstance(cfg[key], int) or cfg[key] < lowest:
            raise UserInputError(f"{key}={cfg[key]} is not a whole number of at least {lowest}: use one")
    for key in ("beta", "collision_weight"):
        values = cfg[key]
        if values is not None and (
            not isinstance(values, ListConfig) or not all(isinstance(v, int | float) for v in values)
        ):
            raise UserInputError(f"{key}={values} is not a list of numbers: write it as {key}=[-2,-1]")


def _evaluation_world(cfg: DictConfig, trained: DictConfig, num_conditions: int) -> WorldSettings:
    sensor = trained.sensor.name if cfg.get("sensor") is None else cfg.sensor.name
    if cfg.run is not None and sensor != trained.sensor.name:
        raise UserInputError(
            f"sensor={sensor} does not fit: {cfg.run} was trained with sensor={trained.sensor.name}, leave it out"
        )
    return WorldSettings(
        map_settings=MapSettings(**plain(trained.map if cfg.get("map") is None else cfg.map)),
        task=TaskSettings(**plain(trained.task if cfg.get("task") is None else cfg.task)),
        sensor=sensor,
        num_agents=cfg.num_episodes * num_conditions,
        num_workers=cfg.num_workers,
    )
