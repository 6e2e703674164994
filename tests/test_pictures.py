"""The pictures of docs/images whose scene a rule chooses: that it is the rule that their captions tell."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pandas as pd
import pytest

IMAGES = Path(__file__).parents[1] / "docs" / "images"


def program(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"picture_{name}", IMAGES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # its dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


def test_ways_are_of_the_first_episode_in_which_the_averse_end_collides_less(monkeypatch: pytest.MonkeyPatch) -> None:
    ways = program("ways", monkeypatch)
    collisions = pd.DataFrame({-2.0: [1, 0, 2, 0, 0], -1.0: [9, 0, 0, 0, 0], 0.0: [1, 0, 1, 3, 1]})
    assert ways.compared(collisions) == (3, 2, 1)
    assert ways.compared(collisions.iloc[:3]) == (None, 0, 1)


def test_what_was_measured_of_scaling_is_drawn_within_its_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    scaling = program("scaling_figures", monkeypatch)
    curve = {"1": 0.02, "8": 0.04, "32": 0.19}
    figure = scaling.learner_figure(dict.fromkeys(scaling.LEARNER, curve))
    for axes in figure.axes:
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
        assert axes.get_xlabel().endswith("logarithmic")
        assert axes.lines[0].get_ydata().tolist() == pytest.approx([20.0, 40.0, 190.0])
        assert axes.lines[1].get_ydata().tolist() == pytest.approx([190 / 32, 190 / 4, 190.0])
    curve = {"0": 5.0, "100000": 12_000.0}
    curves = dict.fromkeys(("agents", "workers", "clutter_per_m2", "replay_megabytes"), curve)
    figure = scaling.world_figure({"cores": 2, "num_agents": 10, **curves})
    for axes in figure.axes:
        assert axes.get_ylim()[0] == 0.0
        assert axes.get_ylim()[1] > 12_600.0
        assert axes.xaxis.get_major_formatter()(100_000) == "100,000"


def test_the_film_of_the_office_is_of_the_first_run_that_does_not_arrive_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    film = program("office_film", monkeypatch)
    arrives = [True, True, False, True, False]

    def driven(_: object, repetition: int, *__: str) -> SimpleNamespace:
        return SimpleNamespace(trace=SimpleNamespace(finished=arrives[repetition]))

    monkeypatch.setattr(film, "driven", driven)
    repetition, alone = film.chosen(None)
    assert (repetition, alone.trace.finished) == (2, False)
    monkeypatch.setattr(film, "MOST_REPETITIONS", 2)
    with pytest.raises(SystemExit, match="all of 2 runs arrive"):
        film.chosen(None)


class Staged:
    """A drive whose robots begin to touch something in given steps."""

    def __init__(self, careful: int | None, neutral: int | None) -> None:
        self.contacts = (careful, neutral)
        self.steps = 0

    def step(self) -> None:
        self.steps += 1

    @property
    def robots(self) -> list[SimpleNamespace]:
        return [SimpleNamespace(collisions=int(at is not None and self.steps >= at)) for at in self.contacts]


@pytest.mark.parametrize(
    ("careful", "neutral", "shown"),
    [
        (None, 100, 100),
        (129, 100, 100),  # after the film
        (128, 100, None),  # in it
        (90, 100, None),
        (None, 26, None),  # the film would begin before the drive
        (None, 27, 27),
        (None, 299, 299),
        (None, 300, None),  # too late
        (None, None, None),
    ],
)
def test_the_film_of_the_page_is_of_a_contact_of_the_neutral_robot_alone(
    careful: int | None, neutral: int | None, shown: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("playwright")
    assert program("play_film", monkeypatch).first_contact(Staged(careful, neutral)) == shown
