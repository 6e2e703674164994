"""PyBullet's clients: nobody shares one, and none outlives its owner."""

import copy
import gc
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import pybullet
import pytest
from torchrl.envs import InitTracker, SerialEnv, StepCounter, TransformedEnv

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.sim.simulation import Simulation
from rcdsac_trl.world.task.env import NavigationEnv
from rcdsac_trl.world.task.gymnasium_env import NavigationGymEnv

EMPTY = MapSettings(size_m=10.0, layouts=("clutter",), clutter_per_m2=0.0, num_movers=0)
MOST_CLIENTS = 1024

navigation_env = partial(NavigationEnv, map_settings=EMPTY, agent_ids=(0, 1))


def transformed_env() -> TransformedEnv:
    env = TransformedEnv(navigation_env())
    env.append_transform(InitTracker())
    env.append_transform(StepCounter(max_steps=5))
    return env


MAKERS: dict[str, Callable[[], Any]] = {
    "torchrl": navigation_env,
    "transformed": transformed_env,
    "serial": lambda: SerialEnv(2, navigation_env),
    "gymnasium": partial(NavigationGymEnv, map_settings=EMPTY),
}


def connected() -> int:
    return sum(pybullet.getConnectionInfo(number)["isConnected"] for number in range(MOST_CLIENTS))


@pytest.fixture(autouse=True)
def _nothing_is_left() -> None:
    gc.collect()


@pytest.mark.parametrize("begun", [False, True])
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
@pytest.mark.parametrize("name", ["torchrl", "gymnasium"])
def test_an_environment_refuses_to_be_copied_whether_it_has_begun_or_not(
    name: str, copied: Callable[[Any], Any], begun: bool
) -> None:
    env = MAKERS[name]()
    if begun:
        env.reset()
    with pytest.raises(UserInputError, match="make another with the same arguments"):
        copied(env)
    env.close()


@pytest.mark.parametrize("copied", [copy.deepcopy, pickle.dumps])
def test_what_holds_an_environment_refuses_too(copied: Callable[[Any], Any]) -> None:
    env = transformed_env()
    for holder in (env, env.base_env.agents, [env]):
        with pytest.raises(UserInputError, match="cannot be copied or pickled"):
            copied(holder)
    env.close()
    with pytest.raises(UserInputError, match="cannot be copied or pickled"):
        copied(Simulation())


@pytest.mark.parametrize("name", MAKERS)
def test_an_environment_that_is_dropped_frees_its_clients(name: str) -> None:
    before = connected()
    env = MAKERS[name]()
    env.reset()
    assert connected() > before
    del env
    gc.collect()
    assert connected() == before


def test_a_simulation_that_was_closed_frees_no_client_of_another() -> None:
    closed = Simulation()
    number = closed._client
    closed.close()
    other = Simulation()
    assert other._client == number  # PyBullet gives numbers out again
    closed.close()
    del closed
    gc.collect()
    assert pybullet.getConnectionInfo(number)["isConnected"]
    other.close()
    assert not pybullet.getConnectionInfo(number)["isConnected"]


def test_a_forked_child_leaves_the_connection_to_its_parent() -> None:
    env = navigation_env()
    env.reset()
    number = env.agents._agents[0]._simulation._client
    child = os.fork()
    if child == 0:
        try:
            env.close()
            os._exit(0 if pybullet.getConnectionInfo(number)["isConnected"] else 1)
        finally:
            os.kill(os.getpid(), signal.SIGKILL)  # whatever went wrong, this child runs no tests
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    env.rand_step(env.reset())
    env.close()


def test_a_program_that_ends_without_closing_says_nothing() -> None:
    code = (
        "from rcdsac_trl.world.task.env import NavigationEnv\n"
        "from rcdsac_trl.world.task.gymnasium_env import NavigationGymEnv\n"
        "kept = [NavigationEnv(agent_ids=(0,)), NavigationGymEnv()]\n"
        "[env.reset() for env in kept]\n"
    )
    ended = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
