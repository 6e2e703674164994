"""Map sets that take turns, furniture on thin legs, and movers that do not yield."""

from dataclasses import replace

import numpy as np
import pytest

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.run_config import training_settings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import MapSettings, generate_map
from rcdsac_trl.world.maps.map_mixture import MapMixture
from rcdsac_trl.world.maps.map_source import make_map, sources_of
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.maps.shapes import Map, Mover
from rcdsac_trl.world.sim.movers import Movers
from rcdsac_trl.world.task.world_settings import WorldSettings

VARIED = training_settings(compose("train", ["+algo=sac", "map=varied"])).map


def test_every_family_takes_its_turn_on_maps_of_its_own() -> None:
    assert isinstance(VARIED, MapMixture)
    number = len(VARIED.families)
    for turn in range(3):
        names = [VARIED.family_of("train", 0, turn * number + place) for place in range(number)]
        assert sorted(names) == sorted(VARIED.families)
    orders = {tuple(VARIED.family_of("train", seed, place) for place in range(number)) for seed in range(9)}
    assert len(orders) > 3
    name = VARIED.family_of("validation", 3, 7)
    assert make_map(VARIED, "validation", 3, 7) == make_map(VARIED.families[name], "validation", 3, 7)


def test_a_single_key_of_a_family_can_be_changed() -> None:
    changed = training_settings(compose("train", ["+algo=sac", "map=varied", "map.families.hard.num_movers=3"])).map
    assert isinstance(changed, MapMixture)
    assert changed.families["hard"] == replace(VARIED.families["hard"], num_movers=3)
    assert hash(changed) != hash(VARIED)
    assert {changed: 1}[MapMixture(dict(changed.families))]


def test_mixtures_that_give_other_maps_are_not_equal() -> None:
    assert isinstance(VARIED, MapMixture)
    turned = MapMixture(dict(reversed(VARIED.families.items())))
    assert [VARIED.family_of("train", 0, index) for index in range(5)] != [
        turned.family_of("train", 0, index) for index in range(5)
    ]
    assert turned != VARIED
    assert MapMixture(dict(VARIED.families)) == VARIED
    assert MapSettings() != VARIED


def test_a_robot_must_fit_into_every_family() -> None:
    wide = replace(PAPER, name="wide", radius_m=0.3)
    with pytest.raises(UserInputError, match=r"robot=wide .* map\.door_width_m begins at 0\.75 m"):
        WorldSettings(MapMixture({"mixed": MapSettings(), "tight": MapSettings(door_width_m=(0.75, 1.0))}), robot=wide)
    with pytest.raises(UserInputError, match=r"map\.families is empty"):
        MapMixture({})
    assert len(sources_of(VARIED)) == len(VARIED.families)


def test_furniture_stands_on_four_thin_legs_that_no_planner_knows() -> None:
    settings = MapSettings(clutter_per_m2=0.0, furniture_per_m2=0.05, num_movers=0)
    legs = generate_map(settings, "train", 0, 1).cylinders
    assert len(legs) % 4 == 0
    assert len(legs) >= 40
    for piece in np.array([(leg.x, leg.y, leg.radius) for leg in legs]).reshape(-1, 4, 3):
        sides = np.hypot(*np.diff(np.vstack([piece, piece[:1]])[:, :2], axis=0).T)
        np.testing.assert_allclose(sides[:2], sides[2:], atol=1e-9)
        assert 0.3 < sides.min() <= sides.max() < 1.6
        assert 0.015 <= piece[:, 2].min() <= piece[:, 2].max() <= 0.03
    assert not any(leg.mapped for leg in legs)
    without = generate_map(replace(settings, furniture_per_m2=0.0), "train", 0, 1)
    assert generate_map(settings, "train", 0, 1).boxes == without.boxes


@pytest.mark.parametrize("family", sorted(VARIED.families))
def test_every_place_stays_reachable(family: str) -> None:
    map_ = generate_map(VARIED.families[family], "train", 1, 0)
    planner = Planner(map_, PAPER.circumradius_m)
    rng = stream(0, "test")
    for _ in range(5):
        start, goal = planner.sample_free(rng), planner.sample_free(rng)
        assert len(planner.waypoints(start, goal)) >= 1


class _Straight:
    """Walks lead along a line, there and back."""

    def sample_mover_point(self, rng: np.random.Generator) -> np.ndarray:
        return np.array([rng.uniform(1.0, 9.0), 2.0])

    def mover_path(self, start_xy: np.ndarray, goal_xy: np.ndarray) -> np.ndarray:
        return np.array([goal_xy])


@pytest.mark.parametrize("yields", [True, False])
def test_who_does_not_yield_stops_as_they_touch(yields: bool) -> None:
    map_ = Map("clutter", 10.0, (), (), (Mover(0.3, 0.5, yields),))
    movers = Movers(map_, _Straight(), (50.0, 50.0), stream(0, "movers"), 0.02)
    gaps = [movers.step(5.0, 2.0) for _ in range(3000)]
    assert min(gaps) == pytest.approx(0.15 if yields else 0.0, abs=0.02)


def test_who_yields_is_drawn_where_not_all_do() -> None:
    settings = MapSettings(num_movers=50, yielding_fraction=0.7)
    maps = [generate_map(settings, "train", 0, index) for index in range(6)]
    share = np.mean([mover.yields for map_ in maps for mover in map_.movers])
    assert share == pytest.approx(0.7, abs=0.1)
    for map_ in maps[:1]:
        assert Map.from_json(map_.to_json()) == map_
    all_do = generate_map(replace(settings, yielding_fraction=1.0), "train", 0, 0)
    assert "yields" not in all_do.to_json()
