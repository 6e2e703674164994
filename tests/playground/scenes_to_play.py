"""What the tests of the page drive: the shipped agents on the usual maps."""

from functools import cache

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.play_settings import PlaySettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.playground.offers import Offers
from rcdsac_trl.playground.play_drive import Drive
from rcdsac_trl.playground.play_session import offers_of
from rcdsac_trl.playground.scene_choice import SceneChoice


@cache
def offers() -> Offers:
    return offers_of(read_config(compose("play", []), PlaySettings))


def drive(**query: str) -> Drive:
    return Drive(SceneChoice.of_query(query, "rcdsac_pow-narrow"), offers())
