"""What is foreseen of one action, against the actions it is interpolated over."""

import numpy as np
import pytest

from rcdsac_trl.robot.foreseen_clearance import MIRRORED_COMMANDS, ForeseenClearance
from rcdsac_trl.robot.look_ahead import FORESEEN_ACTIONS, FORESEEN_SIZE, look_ahead

ACTIONS = np.array([(speed, turn) for speed, turns in FORESEEN_ACTIONS for turn in turns], np.float32)
FORESEEN = np.random.default_rng(0).uniform(0.0, 1.6, FORESEEN_SIZE).astype(np.float32)


def test_at_an_action_that_was_foreseen_it_is_what_was_foreseen() -> None:
    found = [look_ahead(FORESEEN, action) for action in ACTIONS]
    np.testing.assert_allclose(found, FORESEEN.reshape(2, 22).T, atol=1e-6)


def test_it_is_linear_between_them() -> None:
    """Three quarters of full speed lie half way between both rows, and 1/6 of the turn half way in the slower one."""
    ahead, beside, slower_ahead, slower_beside = 4, 5, 12, 13
    assert ACTIONS[[ahead, beside, slower_ahead, slower_beside], 1] == pytest.approx([0.0, 1 / 4, 0.0, 1 / 3])
    faster = (2 / 3 * FORESEEN[beside] + 1 / 3 * FORESEEN[ahead]) / 2
    slower = (FORESEEN[slower_ahead] + FORESEEN[slower_beside]) / 4
    found = look_ahead(FORESEEN, np.array([0.625, 1 / 6], np.float32))
    assert found[0] == pytest.approx(faster + slower, abs=1e-6)


def test_what_is_everywhere_the_same_is_so_everywhere() -> None:
    """The weights of the actions add up to 1, outside of a row's turns as well."""
    for action in np.random.default_rng(1).uniform(-1.0, 1.0, (200, 2)).astype(np.float32):
        assert look_ahead(np.ones(FORESEEN_SIZE, np.float32), action) == pytest.approx([1.0, 1.0], abs=1e-6)
    backwards = look_ahead(FORESEEN, np.array([-1.0, 0.9], np.float32))
    np.testing.assert_allclose(backwards, FORESEEN.reshape(2, 22)[:, 21], atol=1e-6)


def test_the_mirrored_action_in_the_mirrored_world_leads_as_near() -> None:
    mirrored = FORESEEN.reshape(2, 22)[:, MIRRORED_COMMANDS].ravel()
    for action in np.random.default_rng(2).uniform(-1.0, 1.0, (20, 2)).astype(np.float32):
        other = action * np.array([1.0, -1.0], np.float32)
        np.testing.assert_allclose(look_ahead(mirrored, other), look_ahead(FORESEEN, action), atol=1e-6)


def test_turning_away_from_a_thing_leads_less_near() -> None:
    ahead_left = np.array([[0.5, 0.2]])
    foreseen = ForeseenClearance().nearness(ahead_left, np.empty((0, 6)), np.zeros(3), v=0.5, omega=0.0)
    turns = [look_ahead(foreseen, np.array([0.8, turn], np.float32))[1] for turn in (-0.9, -0.5, -0.1)]
    assert turns == sorted(turns)
    assert turns[0] < turns[-1]
