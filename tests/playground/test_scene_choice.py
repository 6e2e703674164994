"""Links: what they say is what is opened, and what they cannot say ends in a sentence."""

from dataclasses import asdict
from urllib.parse import parse_qsl

import pytest

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground.scene_choice import SceneChoice


@pytest.mark.parametrize(
    "choice",
    [
        SceneChoice("sac-narrow"),
        SceneChoice("a b&c=d", -1.25, "office", 17, "full", "mppi", None, True),
        SceneChoice("rcdsac_cvar-narrow", 0.1, second="rcdsac_cvar-narrow", beta2=1.0),
    ],
)
def test_a_link_opens_the_scene_that_it_was_made_of(choice: SceneChoice) -> None:
    assert SceneChoice.of_query(dict(parse_qsl(choice.query))) == choice


def test_a_link_says_both_betas_and_leaves_out_what_is_usual() -> None:
    assert SceneChoice("x", -2.0, second="x", beta2=0.0).query == "agent=x&beta=-2&second=x&beta2=0"
    assert asdict(SceneChoice.of_query({}, "x")) == asdict(SceneChoice("x"))


@pytest.mark.parametrize(
    ("query", "sentence"),
    [
        ({"beta": "bold"}, "beta=bold is no number"),
        ({"beta2": "nan"}, "beta2=nan is no number"),
        ({"beta": "1e999"}, "beta=1e999 is no number"),
        ({"seed": "-1"}, "seed=-1 is no whole number"),
        ({"seed": "1.5"}, "seed=1.5 is no whole number"),
        ({"seed": "1000000001"}, "seed=1000000001 is no whole number from 0 to 1000000000"),
        ({"seed": ""}, "seed is empty, which is no whole number"),
        ({"seed": "１"}, "seed=１ is no whole number"),
        ({"seed": "9" * 4000}, r"seed=9{100}\.\. is no whole number"),
        ({"stop": "yes"}, "stop=yes is neither on nor off"),
        ({"detours": "1"}, "detours=1 is neither on nor off"),
        ({"run": "/etc"}, "the link has no key run: it may have agent, beta"),
    ],
)
def test_a_link_that_cannot_be_read_ends_in_a_sentence(query: dict[str, str], sentence: str) -> None:
    with pytest.raises(UserInputError, match=sentence):
        SceneChoice.of_query(query, "x")


@pytest.mark.parametrize("seed", [-1, 10**9 + 1, 1e300, 1.5, float("nan"), float("inf"), "1", None, [1]])
def test_a_field_takes_no_odd_seed(seed: object) -> None:
    with pytest.raises(UserInputError, match=r"^seed.* is no whole number from 0 to 1000000000: give one$"):
        SceneChoice("x").changed("seed", seed)


def test_changes_add_up_and_betas_go_with_whom_they_belong_to() -> None:
    choice = SceneChoice("x", -1.0, second="y", beta2=0.5)
    assert choice.changed("map", "hard").changed("seed", 3.0) == SceneChoice("x", -1.0, "hard", 3, "trained", "y", 0.5)
    assert choice.changed("agent", "z") == SceneChoice("z", second="y", beta2=0.5)
    assert choice.changed("second", "z") == SceneChoice("x", -1.0, second="z")


def test_after_the_largest_seed_comes_the_first() -> None:
    seeds = [choice.next_map().seed for choice in (SceneChoice("x"), SceneChoice("x", seed=10**9))]
    assert seeds == [1, 0]
