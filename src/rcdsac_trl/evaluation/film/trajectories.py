"""Trajectories of whole episodes in one picture: the same start and goals under several conditions, side by side."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from rcdsac_trl.colors import CAPTIONS, LIGHT
from rcdsac_trl.evaluation.film.episode_film import COLUMNS, Track, counted
from rcdsac_trl.evaluation.film.recording import Moment
from rcdsac_trl.world.canvas import draw_scale_bar, font, scale_bar_m
from rcdsac_trl.world.legend import legend
from rcdsac_trl.world.render import Renderer

_SIDE_PX = 420
_LEGEND = {
    "robot": "start",
    "trail": "where it drove, pale to dark",
    "goal": "goals reached, in order",
    "contact": "a contact began",
    **{name: CAPTIONS[name] for name in ("wall", "mapped", "unmapped")},
}


def trajectories(tracks: Sequence[Track], title: str = "") -> NDArray[np.uint8]:
    """Return the picture, uint8 RGB ``[height, width, 3]``: a panel an episode, at most four in a line.

    At the top stand a title and a scale bar, above each map what drove, below it what came of it. Who walks is not
    shown.

    Args:
        tracks: whole episodes, on maps of one size.
        title: what is said of all of them.
    """
    renderer, head = Renderer(_SIDE_PX, scale_bar=False), round(0.1 * _SIDE_PX)
    columns = min(len(tracks), COLUMNS)
    lines, height = math.ceil(len(tracks) / columns), _SIDE_PX + 2 * head
    large, normal = font(0.052 * _SIDE_PX), font(0.045 * _SIDE_PX)
    meanings = legend(_LEGEND, columns * _SIDE_PX, 0.045 * _SIDE_PX)
    sheet = Image.new("RGB", (columns * _SIDE_PX, head + lines * height + meanings.height), LIGHT.card)
    sheet.paste(meanings, (0, head + lines * height))
    draw = ImageDraw.Draw(sheet)
    draw.text((head // 4, head // 2), title, LIGHT.ink, font=large, anchor="lm")
    shown_m = renderer.shown_m(tracks[0].moments[0].scene.map)
    corner = (sheet.width - head / 4, 0.8 * head)
    draw_scale_bar(draw, corner, scale_bar_m(shown_m), _SIDE_PX / shown_m, normal.size, LIGHT.card)
    for number, track in enumerate(tracks):
        left, top = number % columns * _SIDE_PX, head + number // columns * height
        sheet.paste(Image.fromarray(_panel(track.moments, renderer)), (left, top + head))
        draw.text((left + _SIDE_PX // 2, top + head // 2), track.heading, LIGHT.ink, font=large, anchor="mm")
        last = track.moments[-1]
        colour = LIGHT.touching if last.collisions else LIGHT.ink
        below = (left + _SIDE_PX // 2, top + head + _SIDE_PX + head // 2)
        draw.text(below, _outcome(track.moments), colour, font=normal, anchor="mm")
    return np.array(sheet)


def _panel(moments: Sequence[Moment], renderer: Renderer) -> NDArray[np.uint8]:
    touches = [moments[0].scene.pose[:2]] if moments[0].collisions else []
    goals = []
    for then, now in itertools.pairwise(moments):
        if now.collisions > then.collisions:
            touches.append(now.scene.pose[:2])
        if now.goals > then.goals:  # a goal that is reached is gone: the moment before still shows it
            goals.append(tuple(then.scene.waypoints[-1].tolist()))
    trajectory = [moment.scene.pose[:2] for moment in moments]
    return renderer.draw_way(moments[0].scene.map, trajectory, goals, touches)


def _outcome(moments: Sequence[Moment]) -> str:
    last, speed = moments[-1], np.mean([moment.speed_m_per_s for moment in moments])
    return f"{counted(last.collisions, 'collision')},  {counted(last.goals, 'goal')},  {speed:.2f} m/s"
