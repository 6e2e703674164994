"""Film office_detours.gif: the same run over the office course without and with detours on the planner's map.

    python docs/images/office_film.py

Which run it is, nobody chooses: the first repetition in reverse in which the agent alone does not arrive. What this
prints belongs below the film.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from rcdsac_trl.colors import LIGHT
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.course_settings import PERIOD_S, CourseSettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.evaluation.course.course_drive import Direction, Trace, course_of, drive_course
from rcdsac_trl.evaluation.course.course_film import scenes
from rcdsac_trl.evaluation.course.course_run import conditions_of
from rcdsac_trl.evaluation.course.entries import Entry, entries_of
from rcdsac_trl.evaluation.film.episode_film import counted
from rcdsac_trl.evaluation.film.video import Frame, write_video
from rcdsac_trl.world.canvas import font
from rcdsac_trl.world.office.building import Office, make_office
from rcdsac_trl.world.render import Renderer

HERE = Path(__file__).parent
AGENT, BETA = "rcdsac_cvar-narrow", 0.25
DIRECTION: Direction = "reverse"
HELP = ("navigation.replan=true", "navigation.static_layer=true")
MOST_REPETITIONS = 20
# So many steps a frame, and frames a second: a minute in five seconds. It goes on for so long after the arrival, s.
STEPS_A_FRAME, FPS, LONGER_S = 13, 6.0, 25.0
SIDE_PX, HEAD_PX = 480, 60


@dataclass(frozen=True)
class Run:
    """A run, and who drove it."""

    entry: Entry
    trace: Trace
    heading: str


def driven(office: Office, repetition: int, heading: str, *navigation: str) -> Run:
    """Drive one run as ``course`` does."""
    overrides = [f"run={AGENT}", f"beta=[{BETA}]", *navigation]
    settings = read_config(compose("course", overrides), CourseSettings)
    (entry,) = entries_of(settings)
    conditions = conditions_of(settings)
    trace = drive_course(office, entry.pilot, entry.context, DIRECTION, repetition, conditions, lambda: None)
    return Run(entry, trace, heading)


def chosen(office: Office) -> tuple[int, Run]:
    """Return the first repetition in which the agent alone does not arrive, and this run."""
    for repetition in range(MOST_REPETITIONS):
        alone = driven(office, repetition, "stop zone alone")
        if not alone.trace.finished:
            return repetition, alone
    raise SystemExit(f"all of {MOST_REPETITIONS} runs arrive: there is nothing to show")


def panels(office: Office, run: Run) -> Iterator[Frame]:
    """Yield the frames of one run; the last one again and again."""
    renderer = Renderer(SIDE_PX)
    course, trace = course_of(office, DIRECTION), run.trace
    num_steps = len(trace.commands)
    for step, (scene, collisions) in enumerate(scenes(office, run.entry.pilot, trace, course, trail_steps=num_steps)):
        is_last = step == num_steps - 1
        if step % STEPS_A_FRAME == 0 or is_last:
            said = f"{step * PERIOD_S:.0f} s, {counted(collisions, 'collision')}"
            if is_last and trace.finished:
                said = f"arrived after {said}"
            yield (frame := headed(renderer.draw(scene), run.heading, said))
    yield from itertools.repeat(frame)


def headed(picture: Frame, heading: str, said: str) -> Frame:
    """Return a picture with two lines of text above it."""
    image = Image.new("RGB", (SIDE_PX, HEAD_PX + SIDE_PX), LIGHT.card)
    image.paste(Image.fromarray(picture), (0, HEAD_PX))
    draw = ImageDraw.Draw(image)
    draw.text((10, 0.3 * HEAD_PX), heading, LIGHT.ink, font=font(19), anchor="lm")
    draw.text((10, 0.72 * HEAD_PX), said, LIGHT.faint, font=font(16), anchor="lm")
    return np.array(image)


def main() -> None:
    """Find the run, drive it again with help, and film both."""
    office = make_office(people=True, hollow=True)
    repetition, alone = chosen(office)
    helped = driven(office, repetition, "with detours on the map", *HELP)
    steps = len(helped.trace.commands) + round(LONGER_S / PERIOD_S)
    pairs = zip(panels(office, alone), panels(office, helped), strict=False)
    frames = (np.concatenate(pair, axis=1) for pair in itertools.islice(pairs, steps // STEPS_A_FRAME))
    movie, _ = write_video(frames, HERE / "office_detours", FPS)
    movie.unlink()
    print(
        f"Repetition {repetition} in {DIRECTION}, the first in which `{AGENT}` at β = {BETA:g} does not arrive alone. "
        f"With {' '.join(HELP)}: arrived {helped.trace.finished}, {len(helped.trace.commands) * PERIOD_S:.0f} s."
    )


if __name__ == "__main__":
    main()
