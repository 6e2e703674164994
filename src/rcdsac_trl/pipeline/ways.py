"""Ways of whole episodes in one picture: the same start and goals under several conditions, side by side."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from rcdsac_trl.pipeline.film import Track
from rcdsac_trl.pipeline.recording import Moment
from rcdsac_trl.world.render import TEXT, TOUCHING, Renderer, font

_COLUMNS = 4
_SIDE_PX = 560
_PAPER = (255, 255, 255)
_FAINT = (122, 130, 143)
_SAID = "pale to dark: the way driven; numbered: goals reached;\nred: where a contact began; who walks is not shown"


def ways(tracks: Sequence[Track]) -> NDArray[np.uint8]:
    """Return the picture, uint8 RGB ``[height, width, 3]``: a panel an episode, at most four in a line.

    Above each map stands what drove, below it what came of it.

    Args:
        tracks: whole episodes.
    """
    renderer, head = Renderer(_SIDE_PX), round(0.1 * _SIDE_PX)
    columns = min(len(tracks), _COLUMNS)
    height = _SIDE_PX + 2 * head
    sheet = Image.new("RGB", (columns * _SIDE_PX, math.ceil(len(tracks) / columns) * height + head), _PAPER)
    draw = ImageDraw.Draw(sheet)
    large, normal = font(0.042 * _SIDE_PX), font(0.034 * _SIDE_PX)
    for number, track in enumerate(tracks):
        left, top = number % columns * _SIDE_PX, number // columns * height
        sheet.paste(Image.fromarray(_panel(track.moments, renderer)), (left, top + head))
        draw.text((left + _SIDE_PX // 2, top + head // 2), track.heading, TEXT, font=large, anchor="mm")
        last = track.moments[-1]
        colour = TOUCHING if last.collisions else TEXT
        below = (left + _SIDE_PX // 2, top + head + _SIDE_PX + head // 2)
        draw.text(below, _outcome(track.moments), colour, font=normal, anchor="mm")
    small = font(0.027 * _SIDE_PX)
    middle = (_SIDE_PX * columns // 2, sheet.height - head // 2)
    draw.multiline_text(middle, _SAID, _FAINT, font=small, anchor="mm", align="center")
    return np.array(sheet)


def _panel(moments: Sequence[Moment], renderer: Renderer) -> NDArray[np.uint8]:
    before = [None, *moments]
    touches = [
        now.scene.pose[:2]
        for now, then in zip(moments, before, strict=False)
        if now.collisions > (0 if then is None else then.collisions)
    ]
    # A goal that is reached is gone: the moment before still shows it.
    goals = [
        tuple(then.scene.waypoints[-1].tolist())
        for now, then in zip(moments, before, strict=False)
        if then is not None and now.goals > then.goals
    ]
    way = [moment.scene.pose[:2] for moment in moments]
    return renderer.draw_way(moments[0].scene.map, way, goals, touches)


def _outcome(moments: Sequence[Moment]) -> str:
    last, speed = moments[-1], np.mean([moment.speed_m_per_s for moment in moments])
    counted = [
        f"{number} {what}{'' if number == 1 else 's'}"
        for number, what in ((last.collisions, "collision"), (last.goals, "goal"))
    ]
    return f"{counted[0]},  {counted[1]},  {speed:.2f} m/s"
