"""What is foreseen of one action, against the actions it is interpolated over."""

import numpy as np
import pytest

from rcdsac_trl.robot.foreseen_clearance import MIRRORED_COMMANDS, ForeseenClearance
from rcdsac_trl.robot.look_ahead import FORESEEN_ACTIONS, FORESEEN_SIZE, look_ahead, nearer

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


def test_nearer_by_a_margin_is_what_is_foreseen_of_things_that_much_nearer() -> None:
    """A wall across the way, and the same wall 5 cm nearer; what is too far to count, and the memory, stay."""
    rows = [
        ForeseenClearance().nearness(np.array([[x, 0.0]]), np.empty((0, 6)), np.zeros(3), 0.0, 0.0)
        for x in (0.99, 0.94)
    ]
    still = 17  # standing, so that the gap is the wall's distance less 0.2 m
    told = nearer(np.concatenate((np.full((3, 7), 0.3, np.float32), np.tile(rows[0], (3, 1))), axis=1), 0.05)
    assert told.shape == (3, 7 + FORESEEN_SIZE)
    assert told.dtype == np.float32
    assert (told[:, :7] == np.float32(0.3)).all()
    np.testing.assert_allclose(told[:, 7 + still], rows[1][still], atol=1e-6)
    assert (told[1, 7:][rows[0] == 0.0] == 0.0).all()
    assert (rows[0] == 0.0).any()
    # 1 cm less than the least gap that counts is no nearer than that.
    least = np.full(FORESEEN_SIZE, np.log10(0.8 / 0.06), np.float32)
    np.testing.assert_allclose(nearer(least, 0.05), np.log10(0.8 / 0.02), atol=1e-6)
