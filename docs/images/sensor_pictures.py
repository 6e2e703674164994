"""Draw sensors.png, three sensors at the same moment, and remembered.png, what an agent with a memory is told.

python docs/images/sensor_pictures.py
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from rcdsac_trl.colors import CAPTIONS, LIGHT
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.rollout.planners.pursuit import pursuit_action
from rcdsac_trl.world.canvas import draw_scale_bar, font, scale_bar_m
from rcdsac_trl.world.legend import legend
from rcdsac_trl.world.render import Renderer, Scene
from rcdsac_trl.world.task.env import NavigationEnv

HERE = Path(__file__).parent
SIDE_PX, LARGE_SIDE_PX, VIEW_M, GAP_PX = 440, 640, 8.0, 12
FONT_PX = 19
WORDS = {**CAPTIONS, "way": "waypoints to the goal", "expected": "a mover it tracks"}
THINGS = ("wall", "mapped", "unmapped")
SENSORS = {"narrow": "narrow: 86° ahead", "sparse": "sparse: 18 directions", "full": "full: all around"}
# The moment that docs/world.md draws: of the validation maps' agent 1, fourth episode.
AGENT, EPISODE, STEPS = 1, 3, 41
MEMORY_S, NUM_AGENTS, MOST_STEPS = 12.0, 8, 400
# From the robot to a mover out of its sight, and points that it remembers.
APART_M, FEWEST_POINTS = 1.0, 40


def moments(**settings: object) -> Iterator[list[Scene]]:
    """Yield what is around agents that follow their waypoints, step by step."""
    env = NavigationEnv(sensor="narrow", split="validation", **settings)  # type: ignore[arg-type]
    tensordict = env.reset()
    for _ in range(MOST_STEPS):
        yield [env.agents.scene(row) for row in range(env.batch_size[0])]
        tensordict = env.step_mdp(env.step(tensordict.set("action", pursuit_action(tensordict["waypoint"]))))
    env.close()


def remembering() -> Scene:
    """Return the first moment in which an agent expects a mover within the picture and out of its sight."""
    for scenes in moments(agent_ids=range(NUM_AGENTS), memory_s=MEMORY_S):
        for scene in scenes:
            x, y, yaw = scene.pose
            places = scene.expected[:, :2] - (x, y)
            near = (np.abs(places) < 0.4 * VIEW_M).all(axis=1) & (np.hypot(*places.T) > APART_M)
            bearings = (np.arctan2(places[:, 1], places[:, 0]) - yaw) % (2.0 * np.pi)
            sectors = (bearings / (2.0 * np.pi) * len(scene.sensor_mask)).astype(int)
            if len(scene.remembered) > FEWEST_POINTS and (near & ~scene.sensor_mask[sectors]).any():
                return scene
    raise SystemExit(f"in {MOST_STEPS} steps no agent expected anything out of sight: raise NUM_AGENTS")


def trail_in_view(scene: Scene) -> list[tuple[float, float]]:
    """Return the end of the trail that has not left the picture: a piece of before would lie there loose."""
    x, y, _ = scene.pose
    inside = itertools.takewhile(
        lambda place: max(abs(place[0] - x), abs(place[1] - y)) < VIEW_M / 2, reversed(scene.trail)
    )
    return [*inside][::-1]


def sheet(panels: Sequence[tuple[str, Scene]], side_px: int, names: Sequence[str]) -> Image.Image:
    """Draw scenes side by side, each below its heading, and what the colours mean."""
    width = len(panels) * (side_px + GAP_PX) - GAP_PX
    meanings = legend({name: WORDS[name] for name in names}, width, FONT_PX)
    bar_px = round(2.5 * FONT_PX)
    head = 2 * FONT_PX if any(heading for heading, _ in panels) else 0
    picture = Image.new("RGB", (width, head + side_px + bar_px + meanings.height), LIGHT.card)
    draw = ImageDraw.Draw(picture)
    for number, (heading, scene) in enumerate(panels):
        left = number * (side_px + GAP_PX)
        draw.text((left + side_px / 2, head / 2), heading, LIGHT.ink, font=font(1.1 * FONT_PX), anchor="mm")
        shown = Renderer(side_px, VIEW_M, scale_bar=False).draw(dataclasses.replace(scene, trail=trail_in_view(scene)))
        picture.paste(Image.fromarray(shown), (left, head))
    corner = (width - FONT_PX, head + side_px + bar_px - FONT_PX / 2)
    draw_scale_bar(draw, corner, scale_bar_m(VIEW_M), side_px / VIEW_M, FONT_PX, LIGHT.card)
    picture.paste(meanings, (0, head + side_px + bar_px))
    return picture


def main() -> None:
    """Draw both."""
    shown = moments(agent_ids=(AGENT,), first_episode=EPISODE)
    (moment,) = next(itertools.islice(shown, STEPS, None))
    panels = [
        (heading, dataclasses.replace(moment, sensor_mask=sensor_mask(name))) for name, heading in SENSORS.items()
    ]
    sheet(panels, SIDE_PX, ("robot", "seen", "hit", "trail", "way", *THINGS)).save(HERE / "sensors.png", optimize=True)
    names = ("robot", "seen", "hit", "remembered", "expected", "trail", "way", "wall", "mapped", "mover")
    sheet([("", remembering())], LARGE_SIDE_PX, names).save(HERE / "remembered.png", optimize=True)


if __name__ == "__main__":
    main()
