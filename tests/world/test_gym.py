"""The Gymnasium adapter: Gymnasium's own check, and the same numbers as the TorchRL environment."""

import subprocess
import sys
from collections.abc import Callable
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from rcdsac_trl.config.gymnasium_id import ENV_ID
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.task.env import NavigationEnv
from rcdsac_trl.world.task.gymnasium_env import NavigationGymEnv
from rcdsac_trl.world.task.rules import TaskSettings

SMALL = MapSettings(size_m=12.0, layouts=("clutter",), clutter_per_m2=0.08, num_movers=1)


def test_what_is_no_setting_and_no_option_is_refused() -> None:
    for odd in ("9", True, None):
        with pytest.raises(UserInputError, match=r"sensor\.memory_s=.* is no number: give seconds"):
            NavigationGymEnv(memory_s=odd)
    with pytest.raises(UserInputError, match="robot='jackal' is no robot: give a RobotSettings"):
        NavigationGymEnv(robot="jackal")
    with pytest.raises(
        UserInputError,
        match=r"map_settings='room\.json' are none: give a MapSettings, a MapMixture",
    ):
        NavigationGymEnv(map_settings="room.json")
    env = NavigationGymEnv(map_settings=SMALL, memory_s=np.float32(9.0))
    for options in ("x", 5, ["episode"]):
        with pytest.raises(UserInputError, match="are no dictionary"):
            env.reset(options=options)  # type: ignore[arg-type]
    with pytest.raises(UserInputError, match=r"^a reset has no option 'episod': give {'episode': <number>}, or none$"):
        env.reset(options={"episod": 3})
    env.close()


@pytest.mark.parametrize("sensor", ["narrow", "sparse", "full"])
def test_gymnasiums_own_check_passes(sensor: str) -> None:
    env = gymnasium.make(ENV_ID, map_settings=SMALL, sensor=sensor, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def run(code: str) -> None:
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_id_is_registered_when_gymnasium_comes_later_and_costs_nothing_before() -> None:
    code = (
        "import sys, rcdsac_trl\n"
        "finders = len(sys.meta_path)\n"
        "assert not {'torch', 'gymnasium', 'pybullet'} & set(sys.modules)\n"
        "import importlib; importlib.reload(rcdsac_trl)\n"
        "assert len(sys.meta_path) == finders\n"
        "import importlib.util; assert importlib.util.find_spec('gymnasium')\n"  # as TorchRL asks
        "import gymnasium\n"
        f"assert gymnasium.spec({ENV_ID!r}).entry_point == 'rcdsac_trl.config.named_world:gymnasium_env'\n"
        "assert len(sys.meta_path) == finders - 1\n"
        "importlib.reload(rcdsac_trl)\n"
    )
    run(code)


@pytest.mark.parametrize(
    "made",
    [
        f"gymnasium.make('rcdsac_trl:{ENV_ID}')",
        f"gymnasium.make('rcdsac_trl.world.task.gymnasium_env:{ENV_ID}')",
        f"(importlib.import_module('rcdsac_trl').world_settings(), gymnasium.make('{ENV_ID}'))[1]",
        f"(importlib.import_module('rcdsac_trl'), gymnasium.make('{ENV_ID}'))[1]",
    ],
)
def test_gymnasium_finds_the_id_in_the_package_that_it_names(made: str) -> None:
    run(f"import gymnasium, importlib\nassert type({made}.unwrapped).__name__ == 'NavigationGymEnv'")


# Seeds


@pytest.mark.parametrize("kind", [SyncVectorEnv, partial(AsyncVectorEnv, context="fork")])
def test_without_seeds_the_worlds_of_a_vector_differ_and_can_be_met_again(kind: Callable) -> None:
    envs = kind([partial(NavigationGymEnv, map_settings=SMALL)] * 3)
    _, infos = envs.reset()
    assert len({tuple(pose) for pose in infos["pose"].tolist()}) == 3
    # The seed that an environment drew is told, and gives its world again.
    again, told = envs.reset(seed=infos["seed"].tolist())
    assert np.array_equal(told["pose"], infos["pose"])
    _, from_one = envs.reset(seed=5)
    assert from_one["seed"].tolist() == [5, 6, 7]
    envs.close()
    other = kind([partial(NavigationGymEnv, map_settings=SMALL)] * 3)
    assert not np.array_equal(other.reset()[1]["pose"], infos["pose"])
    assert np.array_equal(other.reset(seed=infos["seed"].tolist())[0]["range"], again["range"])
    other.close()


def test_a_reset_without_a_seed_goes_on_under_the_seed_that_there_is() -> None:
    env, other = NavigationGymEnv(map_settings=SMALL), NavigationGymEnv(map_settings=SMALL, seed=3)
    _, first = env.reset()
    assert first["seed"] == env.np_random_seed
    _, second = env.reset()
    assert (second["seed"], first["episode"], second["episode"]) == (first["seed"], 0, 1)
    assert not np.array_equal(first["pose"], second["pose"])
    _, named = other.reset(seed=first["seed"], options={"episode": 1})
    assert np.array_equal(named["pose"], second["pose"])
    assert env.step(np.zeros(2, np.float32))[4]["episode"] == 1
    env.close()
    other.close()
    given = NavigationGymEnv(map_settings=SMALL, seed=3)
    assert given.reset()[1]["seed"] == given.np_random_seed == 3
    given.close()


def test_a_generator_that_a_user_has_brought_decides_and_stays() -> None:
    seeds = []
    for _ in range(2):
        env = NavigationGymEnv(map_settings=SMALL)
        env.np_random = np.random.default_rng(8)
        seeds.append(env.reset()[1]["seed"])
        assert env.np_random_seed == -1  # Gymnasium's sign of a generator that was brought
        env.close()
    assert seeds[0] == seeds[1]


def test_actions_are_drawn_by_their_own_seed() -> None:
    env = NavigationGymEnv(map_settings=SMALL)
    drawn = []
    for _ in range(2):
        env.action_space.seed(2)
        drawn.append(env.action_space.sample())
    assert np.array_equal(*drawn)
    env.close()


def test_both_adapters_give_the_same_numbers() -> None:
    gym_env = NavigationGymEnv(map_settings=SMALL, seed=4, agent_id=2, first_episode=1)
    torch_env = NavigationEnv(map_settings=SMALL, seed=4, agent_ids=(2,), first_episode=1)
    observation, _ = gym_env.reset()
    tensordict = torch_env.reset()
    rng = stream(0, "test actions")
    for _ in range(60):
        for key, value in observation.items():
            assert np.array_equal(value, tensordict[key][0].numpy())
        action = rng.uniform(-1.0, 1.0, 2).astype(np.float32)
        observation, reward, terminated, truncated, info = gym_env.step(action)
        after = torch_env.step(tensordict.set("action", torch.from_numpy(action)[None]))["next"]
        assert reward == after["reward"].item()
        assert info["contact"] == after["contact"].item()
        assert np.array_equal(info["reward_components"], after["reward_components"][0].numpy())
        assert not terminated
        assert not truncated
        tensordict = after.exclude("reward")
    gym_env.close()
    torch_env.close()


def test_an_episode_is_truncated_after_its_steps_and_the_next_one_differs() -> None:
    env = NavigationGymEnv(map_settings=SMALL, task=TaskSettings(episode_steps=3))
    _, first = env.reset(seed=1)
    ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    _, second = env.reset()
    assert not np.array_equal(first["pose"], second["pose"])
    assert not env.step(np.zeros(2, np.float32))[3]
    _, again = env.reset(seed=1)
    assert np.array_equal(first["pose"], again["pose"])
    _, named = env.reset(options={"episode": 1})
    assert np.array_equal(second["pose"], named["pose"])
    env.close()


def test_frames_are_drawn_in_their_mode_only() -> None:
    env = NavigationGymEnv(map_settings=SMALL, render_mode="rgb_array")
    env.reset()
    frame = env.render()
    assert frame is not None
    assert frame.dtype == np.uint8
    assert frame.ndim == 3
    env.close()
    silent = NavigationGymEnv(map_settings=SMALL)
    silent.reset()
    assert silent.render() is None
    silent.close()


def test_wrong_input_is_refused() -> None:
    with pytest.raises(UserInputError, match="render_mode"):
        NavigationGymEnv(map_settings=SMALL, render_mode="human")
    env = NavigationGymEnv(map_settings=SMALL)
    env.reset()
    with pytest.raises(UserInputError, match=r"in \[-1, 1\]"):
        env.step(np.array([0.0, 2.0], np.float32))
    env.close()
