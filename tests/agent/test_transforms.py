"""What agents are told for an episode, and what an update relabels."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from rcdsac_trl.agent.actor import recurrent_state_primer
from rcdsac_trl.agent.risk import PowerLaw
from rcdsac_trl.agent.transforms import EpisodeSampler, Mirror, Relabel
from rcdsac_trl.robot.observation import range_observation, waypoint_observation
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.sim.lidar import sector_distances

AGENTS = 4


class Countdown(EnvBase):
    """Agents that count steps; agent i's episodes last 2 + i steps."""

    def __init__(self, ids: tuple[int, ...] = tuple(range(AGENTS))) -> None:
        super().__init__(batch_size=[len(ids)])
        self.lengths = torch.tensor(ids).unsqueeze(-1) + 2
        shape = (len(ids), 1)
        self.observation_spec = Composite(count=Unbounded(shape), shape=self.batch_size)
        self.action_spec = Bounded(-1.0, 1.0, (len(ids), 2))
        self.reward_spec = Unbounded(shape)
        self.done_spec = Composite(
            {key: Binary(1, shape, dtype=torch.bool) for key in ("done", "truncated", "terminated")},
            shape=self.batch_size,
        )
        self.count = torch.zeros(shape)

    def _reset(self, tensordict: TensorDictBase | None, **_: object) -> TensorDictBase:
        marked = None if tensordict is None else tensordict.get("_reset", None)
        self.count = torch.zeros_like(self.count) if marked is None else self.count.masked_fill(marked, 0.0)
        return TensorDict({"count": self.count.clone()}, batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.count = self.count + 1
        over = self.count >= self.lengths
        outcome = {"count": self.count.clone(), "reward": self.count.clone(), "done": over, "truncated": over.clone()}
        outcome["terminated"] = torch.zeros_like(over)
        return TensorDict(outcome, batch_size=self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        del seed


def make_env(base: EnvBase | None = None, **settings: object) -> TransformedEnv:
    base = base or Countdown()
    env = TransformedEnv(base)
    env.append_transform(InitTracker())
    env.append_transform(recurrent_state_primer(3))
    arguments = {"draw": PowerLaw().from_uniform, "seed": 7, "agent_ids": range(AGENTS)} | settings
    env.append_transform(EpisodeSampler("risk", **arguments))
    return env


def expected(agent: int, episode: int) -> float:
    return PowerLaw().from_uniform(stream(7, "risk", episode, agent).random())


def test_specs() -> None:
    env = make_env(first_episode=4)
    check_env_specs(env)
    assert env.observation_spec["risk"].shape == (AGENTS, 1)
    assert env.reset()["recurrent_state"].shape == (AGENTS, 3)


def test_each_agent_keeps_its_value_until_its_episode_ends() -> None:
    rollout = make_env().rollout(12, break_when_any_done=False)
    for agent in range(AGENTS):
        for t in range(12):
            episode = t // (2 + agent)
            assert rollout["risk"][agent, t].item() == pytest.approx(expected(agent, episode))
            assert rollout["next", "risk"][agent, t].item() == pytest.approx(expected(agent, episode))
    assert rollout["is_init"].sum(1).flatten().tolist() == [6, 4, 3, 3]


@pytest.mark.filterwarnings("ignore:.*WeightUpdaterBase is deprecated:DeprecationWarning")  # TorchRL's own import
def test_collector_carries_the_values() -> None:
    from torchrl.collectors import Collector

    env = make_env(first_episode=4)
    collector = Collector(env, frames_per_batch=AGENTS * 10, total_frames=AGENTS * 20)
    batches = torch.cat(list(collector), dim=1)
    collector.shutdown()
    for agent in range(AGENTS):
        # Making a collector and its first reset may both begin an episode; after that each end begins one.
        values = batches["risk"][agent].flatten()
        starts = batches["is_init"][agent].flatten().nonzero().flatten().tolist()
        first = next(k for k in range(4, 8) if values[0].item() == pytest.approx(expected(agent, k)))
        for index, start in enumerate(starts):
            assert values[start : start + 2 + agent].tolist() == pytest.approx(
                [expected(agent, first + index)] * len(values[start : start + 2 + agent])
            )


def test_values_do_not_depend_on_how_agents_are_grouped() -> None:
    together = make_env(first_episode=3).rollout(8, break_when_any_done=False)["risk"]
    pairs = SerialEnv(2, [lambda: Countdown((0, 1)), lambda: Countdown((2, 3))])
    split = make_env(pairs, first_episode=3).rollout(8, break_when_any_done=False)["risk"]
    assert split.shape == (2, 2, 8, 1)
    assert torch.equal(split.flatten(0, 1), together)
    alone = make_env(Countdown((2,)), first_episode=3, agent_ids=[2]).rollout(8, break_when_any_done=False)["risk"]
    assert torch.equal(alone[0], together[2])


def test_a_value_passed_to_reset_is_told() -> None:
    env = make_env()
    wanted = torch.tensor([[-0.1], [-0.2], [-0.3], [-0.4]])
    first = env.reset(TensorDict({"risk": wanted}, batch_size=[AGENTS]))
    assert torch.equal(first["risk"], wanted)
    rollout = env.rollout(3, auto_reset=False, tensordict=first, break_when_any_done=False)
    assert torch.equal(rollout["risk"][:, 1], wanted)
    # The next episodes draw again: agent 0's first ended after two steps.
    assert rollout["risk"][0, 2].item() == pytest.approx(expected(0, 1))
    assert torch.equal(rollout["risk"][1:, 2], wanted[1:])


def test_a_value_passed_to_the_reset_of_some_agents_is_told_to_them() -> None:
    env = make_env()
    env.reset()
    marked = torch.tensor([[True], [False], [True], [False]])
    # As always in TorchRL, the others keep what the input holds.
    given = torch.tensor([[-1.5], [-0.3], [-1.0], [-0.4]])
    told = env.reset(TensorDict({"_reset": marked, "risk": given}, batch_size=[AGENTS]))
    assert torch.equal(told["risk"], given)
    later = env.rollout(2, auto_reset=False, tensordict=told, break_when_any_done=False)
    assert torch.equal(later["risk"][:, 1], given)


def test_fixed_values() -> None:
    rollout = make_env(fixed=[-1.0, -0.5, 0.0, -2.0]).rollout(9, break_when_any_done=False)
    assert (rollout["risk"][..., 0] == torch.tensor([[-1.0], [-0.5], [0.0], [-2.0]])).all()
    with pytest.raises(ValueError, match="2 fixed values for 4 agents"):
        make_env(fixed=[-1.0, 0.0])


def test_it_serves_collision_weights_too() -> None:
    env = TransformedEnv(Countdown())
    env.append_transform(EpisodeSampler("collision_weight", lambda u: 0.1 + 1.9 * u, seed=0, agent_ids=range(AGENTS)))
    check_env_specs(env)
    weights = env.rollout(40, break_when_any_done=False)["collision_weight"]
    assert weights.min() >= 0.1
    assert weights.max() <= 2.0
    assert len(weights.unique()) > 30


# ------------------------------------------------------------------------------------------------ relabel
def batch() -> TensorDict:
    return TensorDict({"risk": torch.full((50, 9, 1), -0.25)}, batch_size=[50, 9])


@pytest.mark.parametrize("per", ["sequence", "transition"])
def test_resample(per: str) -> None:
    drawn = []
    for _ in range(2):
        relabel = Relabel(PowerLaw(), mode="resample", per=per, generator=torch.Generator().manual_seed(0))  # type: ignore[arg-type]
        drawn.append(relabel(batch())["risk"])
    risk = drawn[0]
    assert torch.equal(*drawn)
    assert risk.shape == (50, 9, 1)
    assert len(risk.unique()) == (50 if per == "sequence" else 450)
    assert (risk == risk[:, :1]).all() == (per == "sequence")
    assert -2.0 <= risk.min() < -1.8
    assert -0.2 < risk.max() <= 0.0


def test_stored_and_fixed() -> None:
    assert (Relabel(PowerLaw(), mode="stored")(batch())["risk"] == -0.25).all()
    assert (Relabel(PowerLaw(), mode="fixed", beta=-1.5)(batch())["risk"] == -1.5).all()
    with pytest.raises(ValueError, match="needs a beta"):
        Relabel(PowerLaw(), mode="fixed")
    with pytest.raises(ValueError, match="needs a generator"):
        Relabel(PowerLaw(), mode="resample")


# ------------------------------------------------------------------------------------------------ left and right
@pytest.mark.parametrize("sensor", ["full", "narrow", "sparse"])
def test_the_mirrored_world_is_told_mirrored(sensor: str) -> None:
    """What the functions of the observation say of a mirrored scene is the mirrored observation."""
    rng = np.random.default_rng(0)
    mask = sensor_mask(sensor)
    circles = np.column_stack([rng.uniform(-2.5, 2.5, (12, 2)), rng.uniform(0.05, 0.2, 12)])
    circles = circles[np.hypot(circles[:, 0], circles[:, 1]) > 0.5]
    waypoints = rng.uniform(-3.0, 3.0, (2, 2))
    told = []
    for side in (1.0, -1.0):
        scene = circles * [1.0, side, 1.0]
        seen = range_observation(sector_distances(0.0, 0.0, 0.0, np.empty((0, 4)), scene), mask)
        places = [(x, side * y) for x, y in waypoints.tolist()]
        waypoint = waypoint_observation((0.0, 0.0, 0.0), places[0], places[1])
        sided = {"velocity": [0.3, 0.5 * side, 0.4, 0.6 * side], "action": [0.1, 0.7 * side]}
        arrays = {"range": seen, "waypoint": waypoint, **sided}
        rows = {key: torch.tensor(np.asarray(value, np.float32)).expand(2, 3, -1) for key, value in arrays.items()}
        told.append(TensorDict(rows, [2, 3]).clone())
    batch = Mirror(torch.from_numpy(mask))(told[0].clone())
    assert (batch[1] == told[0][1]).all()  # the second half stays
    for key in ("waypoint", "velocity", "action"):
        torch.testing.assert_close(batch[key][0], told[1][key][0])
    equal = (batch["range"][0, 0] - told[1]["range"][0, 0]).abs().numpy() < 1e-5
    off = {"full": 0, "narrow": 1, "sparse": 18}[sensor]  # bins that are read 2 degrees off
    assert (~equal).sum() <= off
    assert (batch["range"][0, 0].numpy() > 0).sum() > 0
    assert not batch["range"][0, 0].numpy()[~mask].any()


def test_mirroring_twice_changes_nothing() -> None:
    keys = {"range": 180, "waypoint": 6, "velocity": 4, "remembered": 90, "action": 2}
    batch = TensorDict({key: torch.randn(2, 3, size) for key, size in keys.items()}, [2, 3])
    mirror = Mirror(torch.ones(180, dtype=torch.bool))
    once = mirror(batch.clone())
    assert not any((once[key][0] == batch[key][0]).all() for key in keys)
    assert (mirror(once) == batch).all()
