"""What a link opens, and what is shown where it says nothing."""

import pytest
from scenes_to_play import offers

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground.offers import Offers
from rcdsac_trl.playground.page_link import PageLink, read_link, usual_scene
from rcdsac_trl.playground.scene_choice import NOBODY, SceneChoice


@pytest.mark.parametrize(
    ("agent", "scene"),
    [
        (
            "rcdsac_pow-narrow",
            SceneChoice("rcdsac_pow-narrow", -1.5, "hard", seed=28, second="rcdsac_pow-narrow", beta2=0.0),
        ),
        ("rcwr-narrow", SceneChoice("rcwr-narrow", map="hard")),
        ("sac-narrow", SceneChoice("sac-narrow", map="hard")),
    ],
)
def test_the_usual_scene_shows_what_beta_does_where_there_is_one(agent: str, scene: SceneChoice) -> None:
    only = Offers({agent: agent}, offers().maps)
    assert usual_scene(only) == scene
    zoomed = scene.second != NOBODY
    assert read_link({"theme": "dark", "paused": "on"}, only) == PageLink(scene, "dark", running=False, zoomed=zoomed)
    assert not read_link({"zoom": "off"}, only).zoomed


def test_a_link_that_says_something_opens_that() -> None:
    said = SceneChoice(next(iter(offers().agents)), seed=2)
    assert read_link({"seed": "2", "paused": "off"}, offers()) == PageLink(said, None, running=True, zoomed=False)


def test_a_scene_that_is_not_offered_is_refused() -> None:
    for name, told in (("moon", "moon"), ("", "''"), ("../hard", "../hard"), ("hard\n", r"hard\?")):
        with pytest.raises(UserInputError, match=rf"^no map {told} is offered"):
            read_link({"map": name}, offers())
