"""Where one frame lies in another, in three dimensions: translation and rotation, as in ``geometry_msgs/Transform``."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError

Quaternion = tuple[float, float, float, float]

# A rotation whose length is farther from 1 was not meant as one: all zeros is what nobody filled in.
_LENGTH_SLACK = 0.1
# Rotations that are this near to each other are interpolated along the chord, where the arc's formula divides by 0.
_SAME_ROTATION = 1.0 - 1e-9


@dataclass(frozen=True)
class RigidTransform:
    """Takes coordinates of a source frame to those of a target frame: the pose of the source in the target.

    Attributes:
        translation_m: of the source's origin, (x, y, z).
        rotation: unit quaternion (x, y, z, w); one that is nearly of length 1 is brought to it.

    Raises:
        UserInputError: if a number is not finite, or the quaternion is no rotation.

    Example:
        >>> map_to_odom = RigidTransform.planar(2.0, 0.0, math.pi / 2)
        >>> x, y, yaw = (map_to_odom @ RigidTransform.planar(1.0, 0.0, 0.0)).pose
        >>> round(x, 6), round(y, 6), round(yaw, 6)
        (2.0, 1.0, 1.570796)
    """

    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: Quaternion = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Refuse what is none, and bring the quaternion to length 1."""
        length = math.hypot(*self.rotation)
        if not all(math.isfinite(value) for value in self.translation_m):
            raise UserInputError(f"translation {self.translation_m} of a transform is not finite: give metres")
        if not abs(length - 1.0) < _LENGTH_SLACK:  # also false for NaN
            raise UserInputError(f"rotation {self.rotation} of a transform is none: its length must be 1")
        x, y, z, w = self.rotation
        object.__setattr__(self, "rotation", (x / length, y / length, z / length, w / length))

    @classmethod
    def planar(cls, x_m: float, y_m: float, yaw_rad: float) -> "RigidTransform":
        """Return the pose of something on the floor; yaw is counter-clockwise."""
        return cls((x_m, y_m, 0.0), (0.0, 0.0, math.sin(yaw_rad / 2.0), math.cos(yaw_rad / 2.0)))

    def __matmul__(self, other: "RigidTransform") -> "RigidTransform":
        """Return the transform that does the other first, and then this one."""
        x, y, z = _rotated(self.rotation, other.translation_m)
        a, b, c = self.translation_m
        return RigidTransform((a + x, b + y, c + z), _product(self.rotation, other.rotation))

    def inverse(self) -> "RigidTransform":
        """Return the pose of the target in the source."""
        x, y, z, w = self.rotation
        back = (-x, -y, -z, w)
        a, b, c = _rotated(back, self.translation_m)
        return RigidTransform((-a, -b, -c), back)

    def toward(self, other: "RigidTransform", share: float) -> "RigidTransform":
        """Return what lies between: a straight line, and the shortest turn at a constant rate (slerp).

        Args:
            other: the end.
            share: of the way there, from 0 to 1.
        """
        a, b, c = (p + share * (q - p) for p, q in zip(self.translation_m, other.translation_m, strict=True))
        return RigidTransform((a, b, c), _slerp(self.rotation, other.rotation, share))

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The rotation, [3, 3]: its columns are the source's axes in the target."""
        return np.stack([_rotated(self.rotation, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))], axis=1)

    @property
    def pose(self) -> tuple[float, float, float]:
        """x and y in m, and in rad the direction of the source's x axis seen from above, counter-clockwise."""
        ahead = _rotated(self.rotation, (1.0, 0.0, 0.0))
        return self.translation_m[0], self.translation_m[1], math.atan2(ahead[1], ahead[0])


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return Hamilton's product."""
    x, y, z, w = a
    i, j, k, r = b
    return (
        w * i + x * r + y * k - z * j,
        w * j - x * k + y * r + z * i,
        w * k + x * j - y * i + z * r,
        w * r - x * i - y * j - z * k,
    )


def _rotated(rotation: Quaternion, point: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z, w = rotation
    back = (-x, -y, -z, w)
    turned = _product(_product(rotation, (*point, 0.0)), back)
    return turned[:3]


def _slerp(a: Quaternion, b: Quaternion, share: float) -> Quaternion:
    """Return the rotation between two (Shoemake, 1985, *Animating Rotation with Quaternion Curves*)."""
    cos = sum(p * q for p, q in zip(a, b, strict=True))
    sign = -1.0 if cos < 0.0 else 1.0  # b and -b are one rotation; the nearer is the shorter turn
    if abs(cos) > _SAME_ROTATION:
        weights = (1.0 - share, share)
    else:
        angle = math.acos(abs(cos))
        weights = (math.sin((1.0 - share) * angle) / math.sin(angle), math.sin(share * angle) / math.sin(angle))
    x, y, z, w = (weights[0] * p + sign * weights[1] * q for p, q in zip(a, b, strict=True))
    return x, y, z, w
