"""A tree of frames whose transforms change with time, as ROS's ``/tf`` and ``/tf_static`` tell it; without ROS.

What tf2 does, in what a robot that drives needs of it: interpolation at a stamp, static transforms for ever, a bounded
history, and errors that name the link that is missing, or how old it is.
"""

import bisect
import math
from dataclasses import dataclass, field

from rcdsac_trl.deploy.frames.rigid_transform import RigidTransform
from rcdsac_trl.errors import UserInputError

ALWAYS_S = math.inf
"""Stamp of what does not change: it is never old."""
SET_BACK_S = 1.0
"""Publishers of one link are late by less; who goes back by more was started again, with another clock."""

# Frames that are named in a sentence.
_MOST_NAMED = 8
# No tree of a robot has a branch so long; a longer one is a loop.
_LONGEST_BRANCH = 100


class TransformError(UserInputError):
    """A transform that is needed and missing, or not known at its stamp."""


@dataclass
class _Link:
    """Where a frame lies in its parent, over time."""

    parent: str
    static: bool
    stamps_s: list[float] = field(default_factory=list)
    transforms: list[RigidTransform] = field(default_factory=list)

    def newest_s(self) -> float:
        return ALWAYS_S if self.static else self.stamps_s[-1]


class TransformBuffer:
    """Keeps the transforms of the last seconds, and says where any frame lies in any other.

    A frame that is told another parent begins anew there, and so does one whose stamps go back by more than 1 s: a
    simulation, or a recording, was started again. A leading slash in a name, as in ROS 1, means nothing.

    Args:
        history_s: how far back a transform that changes can be asked for, from the newest of its own.

    Example:
        >>> buffer = TransformBuffer()
        >>> buffer.set("odom", "base_link", 10.0, RigidTransform.planar(0.0, 0.0, 0.0))
        >>> buffer.set("odom", "base_link", 10.2, RigidTransform.planar(0.1, 0.0, 0.0))
        >>> round(buffer.lookup("odom", "base_link", 10.1).pose[0], 6)
        0.05
        >>> try:
        ...     buffer.lookup("map", "base_link", 10.1)
        ... except TransformError as error:
        ...     print(error)
        no transform names frame 'map': there are base_link, odom
    """

    def __init__(self, history_s: float = 10.0) -> None:
        if not 0.0 < history_s < math.inf:
            raise UserInputError(f"history_s={history_s} must be a positive number of seconds")
        self._history_s = history_s
        self._links: dict[str, _Link] = {}

    def set(self, parent: str, child: str, stamp_s: float, transform: RigidTransform, *, static: bool = False) -> None:
        """Take note of where a frame lies in its parent.

        Args:
            parent: the target of the transform, ``header.frame_id``.
            child: its source, ``child_frame_id``.
            stamp_s: when; means nothing where it is static.
            transform: the pose of the child in the parent.
            static: it holds from now on, and did before.

        Raises:
            UserInputError: if a name is empty, a frame would lie in itself, or the stamp is no number.
        """
        parent, child = named(parent), named(child)
        if not parent or not child or parent == child:
            raise UserInputError(f"a transform from {parent!r} to {child!r} is none: name two frames")
        if not static and not math.isfinite(stamp_s):
            raise UserInputError(f"stamp {stamp_s} of the transform {parent} -> {child} is not finite: give seconds")
        link = self._links.get(child)
        if static:
            self._links[child] = _Link(parent, True, [stamp_s], [transform])
            return
        again = link is not None and not link.static and stamp_s < link.stamps_s[-1] - SET_BACK_S
        if link is None or link.static or link.parent != parent or again:
            link = self._links[child] = _Link(parent, False)
        place = bisect.bisect_left(link.stamps_s, stamp_s)
        if place < len(link.stamps_s) and link.stamps_s[place] == stamp_s:
            link.transforms[place] = transform
            return
        link.stamps_s.insert(place, stamp_s)
        link.transforms.insert(place, transform)
        old = bisect.bisect_left(link.stamps_s, link.stamps_s[-1] - self._history_s)
        del link.stamps_s[:old], link.transforms[:old]

    @property
    def frames(self) -> list[str]:
        """Every frame that a transform names, sorted."""
        return sorted(set(self._links) | {link.parent for link in self._links.values()})

    def connects(self, target: str, source: str) -> bool:
        """Return whether transforms lead from one frame to the other, whatever their stamps."""
        target, source = named(target), named(source)
        return target == source or self._branch(target)[-1] == self._branch(source)[-1]

    def hangs_below(self, frame: str, other: str) -> bool:
        """Return whether a frame is another one, or moves with it."""
        return named(other) in self._branch(named(frame))

    def lookup(self, target: str, source: str, stamp_s: float, *, hold_s: float = 0.0) -> RigidTransform:
        """Return what takes coordinates of the source frame to the target frame at a time.

        Between two stamps it interpolates.

        Args:
            target: frame to go to.
            source: frame to come from.
            stamp_s: when.
            hold_s: so far before its oldest and beyond its newest stamp a link is taken as it was there.

        Raises:
            TransformError: naming the link that is missing, or not known at that time.
        """
        down, up = self._way(target, source)
        there = self._along(down, stamp_s, hold_s)
        return there.inverse() @ self._along(up, stamp_s, hold_s)

    def latest(self, target: str, source: str) -> tuple[RigidTransform, float]:
        """Return what takes coordinates of the source frame to the target frame by the newest of every link.

        Returns:
            The transform, and the stamp of the link whose newest is oldest; :data:`ALWAYS_S` if all are static.

        Raises:
            TransformError: naming what is missing.
        """
        down, up = self._way(target, source)
        stamps = [self._links[frame].newest_s() for frame in (*down, *up)]
        there = self._along(down, ALWAYS_S, ALWAYS_S)
        return there.inverse() @ self._along(up, ALWAYS_S, ALWAYS_S), min(stamps, default=ALWAYS_S)

    def oldest_link(self, target: str, source: str) -> str:
        """Return which link of the way is the one whose newest is oldest, as ``"map -> odom"``.

        Raises:
            TransformError: naming what is missing.
        """
        way = [frame for part in self._way(target, source) for frame in part]
        if not way:
            return f"{target} -> {source}"
        return self._named_link(min(way, key=lambda frame: self._links[frame].newest_s()))

    def _along(self, branch: list[str], stamp_s: float, hold_s: float) -> RigidTransform:
        """Return what takes the first frame of a branch to the parent of its last."""
        found = RigidTransform()
        for frame in branch:
            found = self._at(frame, stamp_s, hold_s) @ found
        return found

    def _at(self, child: str, stamp_s: float, hold_s: float) -> RigidTransform:
        link = self._links[child]
        if link.static:
            return link.transforms[0]
        stamps = link.stamps_s
        if stamp_s >= stamps[-1]:
            if stamp_s > stamps[-1] + hold_s:
                raise TransformError(
                    f"the newest transform {self._named_link(child)} is {stamp_s - stamps[-1]:.2f} s older than what "
                    "it is needed for: see who publishes it"
                )
            return link.transforms[-1]
        place = bisect.bisect_right(stamps, stamp_s)
        if place == 0:
            if stamp_s < stamps[0] - hold_s:
                raise TransformError(
                    f"the transform {self._named_link(child)} is known from {stamps[0] - stamp_s:.2f} s later on than "
                    "it is needed for"
                )
            return link.transforms[0]
        before, after = stamps[place - 1], stamps[place]
        return link.transforms[place - 1].toward(link.transforms[place], (stamp_s - before) / (after - before))

    def _way(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Return the frames below the nearest common one on the branch of the target, and on that of the source."""
        target, source = named(target), named(source)
        if target == source:
            return [], []
        known = self.frames
        for frame in (target, source):
            if frame not in known:
                there = ", ".join(known[:_MOST_NAMED]) + (", .." if len(known) > _MOST_NAMED else "")
                raise TransformError(f"no transform names frame {frame!r}: there are {there or 'none'}")
        down, up = self._branch(target), self._branch(source)
        common = next((frame for frame in down if frame in up), None)
        if common is None:
            raise TransformError(
                f"no transform connects {target!r} and {source!r}: the one hangs below {down[-1]!r}, the other below "
                f"{up[-1]!r}"
            )
        return down[: down.index(common)], up[: up.index(common)]

    def _branch(self, frame: str) -> list[str]:
        """Return a frame and all those it lies in, the root last."""
        branch = [frame]
        while (link := self._links.get(branch[-1])) is not None:
            branch.append(link.parent)
            if len(branch) > _LONGEST_BRANCH:
                raise TransformError(f"the frames above {frame!r} form a loop: see who publishes {branch[-1]!r}")
        return branch

    def _named_link(self, child: str) -> str:
        return f"{self._links[child].parent} -> {child}"


def named(frame: str) -> str:
    """Return a frame's name without the slash that ROS 1 puts before it."""
    return frame.removeprefix("/")
