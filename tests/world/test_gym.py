"""The Gymnasium adapter: Gymnasium's own check, and the same numbers as the TorchRL environment."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import rcdsac_trl
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.task.env import NavigationEnv
from rcdsac_trl.world.task.gymnasium_env import ENV_ID, NavigationGymEnv
from rcdsac_trl.world.task.rules import TaskSettings

SMALL = MapSettings(size_m=12.0, layouts=("clutter",), clutter_per_m2=0.08, num_movers=1)


@pytest.mark.parametrize("sensor", ["narrow", "sparse", "full"])
def test_gymnasiums_own_check_passes(sensor: str) -> None:
    env = gymnasium.make(ENV_ID, map_settings=SMALL, sensor=sensor, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def test_the_id_is_registered_on_request_and_not_before() -> None:
    code = (
        "import sys, rcdsac_trl\n"
        "assert not {'torch', 'gymnasium', 'pybullet'} & set(sys.modules)\n"
        "rcdsac_trl.register_gym()\n"
        "rcdsac_trl.register_gym()\n"
        "import gymnasium\n"
        f"assert gymnasium.spec({ENV_ID!r}).entry_point == 'rcdsac_trl.world.task.gymnasium_env:NavigationGymEnv'\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    rcdsac_trl.register_gym()


def test_gymnasium_imports_the_module_that_an_id_names() -> None:
    env = gymnasium.make(f"rcdsac_trl.world.task.gymnasium_env:{ENV_ID}", map_settings=SMALL)
    assert isinstance(env.unwrapped, NavigationGymEnv)
    env.close()


def test_both_adapters_give_the_same_numbers() -> None:
    gym_env = NavigationGymEnv(SMALL, seed=4, agent_id=2, first_episode=1)
    torch_env = NavigationEnv(SMALL, seed=4, agent_ids=(2,), first_episode=1)
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
    env = NavigationGymEnv(SMALL, TaskSettings(episode_steps=3))
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
    env = NavigationGymEnv(SMALL, render_mode="rgb_array")
    env.reset()
    frame = env.render()
    assert frame is not None
    assert frame.dtype == np.uint8
    assert frame.ndim == 3
    env.close()
    silent = NavigationGymEnv(SMALL)
    silent.reset()
    assert silent.render() is None
    silent.close()


def test_wrong_input_is_refused() -> None:
    with pytest.raises(UserInputError, match="render_mode"):
        NavigationGymEnv(SMALL, render_mode="human")
    env = NavigationGymEnv(SMALL)
    env.reset()
    with pytest.raises(UserInputError, match=r"in \[-1, 1\]"):
        env.step(np.array([0.0, 2.0], np.float32))
    env.close()
