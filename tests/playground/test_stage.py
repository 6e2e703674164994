"""What the figures hold of the views that they are shown."""

import numpy as np
import pytest
from bokeh.models import Plot
from scenes_to_play import offers
from test_drive_clock import PATIENCE_S, newest, until

from rcdsac_trl.playground import stage
from rcdsac_trl.playground.drive_clock import DriveClock
from rcdsac_trl.playground.scene_choice import SceneChoice
from rcdsac_trl.playground.stage import Stage


def weights(plot: Plot) -> np.ndarray:
    return np.asarray(plot.renderers[0].data_source.data["weight"])


def test_while_it_pauses_the_curve_follows_every_turn_of_beta(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "_CRITICS_PERIOD_S", 1e9)  # however fast it is turned
    clock = DriveClock(SceneChoice("rcdsac_cvar-narrow"), offers(), running=False)
    clock.start()
    until(lambda: clock.newest is not None)
    clock.step_once()
    until(lambda: newest(clock).robots[0].returns is not None)
    shown = Stage("light", lambda event: None, lambda number, x, y: None)
    curve = next(plot for plot in shown.roots if plot.name == "curve0")
    for beta in (0.5, 0.25, 1.0):
        clock.tell(lambda drive, beta=beta: drive.set_beta(0, beta))
        until(lambda beta=beta: newest(clock).robots[0].dialled == beta)
        shown.show(newest(clock), zoomed=False, settled=True)
        assert weights(curve)[0] == 1.0 / beta  # CVaR's weight of the worst part
    clock.close(PATIENCE_S)
