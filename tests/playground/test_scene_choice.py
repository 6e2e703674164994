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
        ({"seed": "1000000001"}, "seed=1000000001 is outside"),
        ({"seed": "9" * 4000}, r"seed=9{100}\.\. is no whole number"),
        ({"stop": "yes"}, "stop=yes is neither on nor off"),
        ({"run": "/etc"}, "the link has no key run: it may have agent, beta"),
    ],
)
def test_a_link_that_cannot_be_read_ends_in_a_sentence(query: dict[str, str], sentence: str) -> None:
    with pytest.raises(UserInputError, match=sentence):
        SceneChoice.of_query(query, "x")
