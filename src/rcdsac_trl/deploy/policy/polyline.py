"""A polyline measured along itself: where on it a point lies, and what lies so far along it."""

import numpy as np
from numpy.typing import NDArray

# Places on a polyline that are as near as this are equally near: the earliest of them counts.
_EQUALLY_NEAR_M = 0.02
# Points that are nearer to each other are one.
_SAME_POINT_M = 1e-6


class Polyline:
    """Corner points and the legs between them.

    Args:
        points: corner points, m, [n, 2], at least one; no two neighbours are equal.

    Attributes:
        points: these.
        along_m: of each point, how far along the polyline it lies, float64 [n].

    Example:
        >>> line = Polyline(np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 3.0)]))
        >>> line.at(np.array([1.0, 4.0, 9.0])).tolist()
        [[1.0, 0.0], [2.0, 2.0], [2.0, 3.0]]
        >>> line.nearest((1.0, 0.5), 0.0, line.length_m)
        (1.0, 0.5)
    """

    def __init__(self, points: NDArray[np.float64]) -> None:
        self.points = points
        self._starts, self._steps = points[:-1], np.diff(points, axis=0)
        self._lengths = np.hypot(self._steps[:, 0], self._steps[:, 1])
        self.along_m = np.concatenate([[0.0], np.cumsum(self._lengths)])

    @property
    def length_m(self) -> float:
        """From the first point to the last, along the legs."""
        return float(self.along_m[-1])

    def at(self, along_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points that lie so far along, [k, 2]; before the start is the start, beyond the end the end."""
        return np.stack([np.interp(along_m, self.along_m, self.points[:, axis]) for axis in (0, 1)], axis=1)

    def closest(
        self, point: tuple[float, float], low_m: float, high_m: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return for each leg the place of a stretch that is closest to a point.

        Args:
            point: x and y, m.
            low_m: where the stretch begins, along the polyline.
            high_m: where it ends.

        Returns:
            How far along that place lies and how far from the point, [n - 1] each; ``inf`` away where the leg is not
            part of the stretch.
        """
        begin, lengths = self.along_m[:-1], self._lengths
        low, high = np.clip(low_m - begin, 0.0, lengths), np.clip(high_m - begin, 0.0, lengths)
        apart = np.asarray(point) - self._starts
        on_leg = np.clip((apart * self._steps).sum(axis=1) / lengths, low, high)
        off = apart - (on_leg / lengths)[:, None] * self._steps
        outside = (begin > high_m) | (begin + lengths < low_m)
        return begin + on_leg, np.where(outside, np.inf, np.hypot(off[:, 0], off[:, 1]))

    def nearest(self, point: tuple[float, float], low_m: float, high_m: float) -> tuple[float, float]:
        """Return how far along the place of a stretch lies that is nearest to a point, and how far away it is.

        Of places that are equally near the earliest counts. Arguments are as in :meth:`closest`.
        """
        if len(self.points) == 1:
            return 0.0, float(np.hypot(*(np.asarray(point) - self.points[0])))
        along, off = self.closest(point, low_m, high_m)
        first = int(np.argmax(off <= off.min() + _EQUALLY_NEAR_M))
        return float(along[first]), float(off[first])


def corners(points: NDArray[np.float64], tolerance_m: float) -> NDArray[np.float64]:
    """Return the points that a polyline needs to stay within a tolerance (Douglas and Peucker, 1973), [k, 2].

    Where it goes there and back along one line, the turning points are kept as well. Points that repeat the one before
    are left out.

    Args:
        points: [n, 2], at least one, m.
        tolerance_m: from the line between two points that are kept.
    """
    kept = {0, len(points) - 1}
    pending = [(0, len(points) - 1)]
    while pending:
        first, last = pending.pop()
        if last - first < 2:
            continue
        start, chord = points[first], points[last] - points[first]
        off = points[first + 1 : last] - start
        length = float(np.hypot(*chord))
        along = np.clip(off @ chord / length, 0.0, length) if length > 0.0 else np.zeros(len(off))
        apart = np.linalg.norm(off - along[:, None] * (chord / length if length > 0.0 else chord), axis=1)
        farthest = int(apart.argmax())
        if apart[farthest] <= tolerance_m:
            ahead = np.maximum.accumulate(along)
            back = ahead - along
            if back.max() <= tolerance_m:
                continue
            farthest = int(np.argmax(along == ahead[back.argmax()]))
        middle = first + 1 + farthest
        kept.add(middle)
        pending += [(first, middle), (middle, last)]
    points = points[sorted(kept)]
    return points[np.concatenate([[True], np.hypot(*np.diff(points, axis=0).T) > _SAME_POINT_M])]
