"""Poses and velocities of bodies at one time, each as one row of numbers: what loops copy, and kernels read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from qpavoid.errors import NumericalError
from qpavoid.problem import Array, as_numbers, as_vector, require_finite

STATE = 18
"""Numbers in the state of a body: rotation by columns, position, linear and angular velocity, in world axes."""
POSE = 12
"""Numbers in a pose: rotation by columns, position."""


class _Placed:
    """Pose of a body origin with a time stamp."""

    __slots__ = ("at_rest", "row", "t")

    row: Array
    """Rotation by columns, position, then velocities if there are any: [-, m, m/s, rad/s]."""
    t: float | None
    """Time stamp: when an obstacle was there [s]; the time of the control step if left out."""
    at_rest: bool
    """Whether an obstacle stays there until another one is given: it is never stale."""

    @property
    def position(self) -> Array:
        """(3,) world position [m]."""
        return self.row[9:12]

    @property
    def rotation(self) -> Array:
        """(3, 3) body axes to world axes."""
        return np.asarray(self.row[:9].reshape(3, 3).T)

    def stamped(self, t: float | None, at_rest: bool) -> Any:
        """Return the same with another time stamp [s]."""
        placed = type(self).__new__(type(self))
        placed.row, placed.t, placed.at_rest = self.row, t, at_rest
        return placed

    def _write_pose(self, position: Any, rotation: Any, t: float | None, at_rest: bool) -> None:
        self.row[:9] = as_vector("rotation", rotation, (3, 3)).T.ravel()
        self.row[9:12] = as_vector("position", position, (3,))
        self.t, self.at_rest = t, at_rest

    def __repr__(self) -> str:
        numbers = np.array2string(self.row[9:], precision=4, separator=", ")
        return f"{type(self).__name__}({numbers}, t={self.t}, at_rest={self.at_rest})"


class Sample(_Placed):
    """Pose of a body origin and its velocity, all in world axes."""

    __slots__ = ()

    def __init__(
        self,
        position: ArrayLike,
        rotation: ArrayLike,
        linear: ArrayLike,
        angular: ArrayLike,
        t: float | None = None,
        at_rest: bool = False,
    ) -> None:
        """Copy the parts into one row; numbers that cannot be true are refused where they are used.

        Raises:
            NumericalError: a part of the wrong shape, or not made of numbers.
        """
        self.row = np.empty(STATE)
        self._write_pose(position, rotation, t, at_rest)
        self.row[12:15] = as_vector("linear", linear, (3,))
        self.row[15:] = as_vector("angular", angular, (3,))
        self.row.flags.writeable = False

    @property
    def linear(self) -> Array:
        """(3,) velocity of the origin [m/s]."""
        return self.row[12:15]

    @property
    def angular(self) -> Array:
        """(3,) angular velocity [rad/s]."""
        return self.row[15:]

    @classmethod
    def at(
        cls,
        position: ArrayLike,
        rotation: ArrayLike | None = None,
        linear: ArrayLike | None = None,
        angular: ArrayLike | None = None,
        t: float | None = None,
        at_rest: bool = False,
    ) -> Sample:
        """Make a sample of finite numbers; what is left out is the identity, or zero.

        Raises:
            NumericalError: an entry has the wrong shape, or holds what is not a finite number.
        """
        rotation = np.eye(3) if rotation is None else rotation
        linear, angular = (np.zeros(3) if part is None else part for part in (linear, angular))
        sample = cls(position, rotation, linear, angular, t, at_rest)
        _require_finite_parts(sample, "position", "rotation", "linear", "angular")
        return sample

    @classmethod
    def of_row(cls, row: Array, t: float | None = None, at_rest: bool = False) -> Sample:
        """View a state (18,) as a sample; both look into the same memory."""
        sample = cls.__new__(cls)
        sample.row, sample.t, sample.at_rest = row, t, at_rest
        return sample

    def _replace(self, **parts: Any) -> Sample:
        """Return the sample with other parts, as a named tuple does."""
        names = "position", "rotation", "linear", "angular", "t", "at_rest"
        return Sample(**{name: parts.pop(name, getattr(self, name)) for name in names}, **parts)


class Pose(_Placed):
    """Pose of an obstacle that was seen, when nothing is known of its velocity; or one to reach, and rest at."""

    __slots__ = ()

    def __init__(self, position: ArrayLike, rotation: ArrayLike, t: float | None = None, at_rest: bool = False) -> None:
        """Copy the parts into one row; numbers that cannot be true are refused where they are used.

        Raises:
            NumericalError: a part of the wrong shape, or not made of numbers.
        """
        self.row = np.empty(POSE)
        self._write_pose(position, rotation, t, at_rest)
        self.row.flags.writeable = False

    @classmethod
    def at(
        cls, position: ArrayLike, rotation: ArrayLike | None = None, t: float | None = None, at_rest: bool = False
    ) -> Pose:
        """Make a pose of finite numbers; along the world axes where no rotation is given.

        Raises:
            NumericalError: an entry has the wrong shape, or holds what is not a finite number.
        """
        pose = cls(position, np.eye(3) if rotation is None else rotation, t, at_rest)
        _require_finite_parts(pose, "position", "rotation")
        return pose

    def as_sample(self) -> Sample:
        """Return the sample at rest at this pose."""
        return Sample.of_row(np.concatenate((self.row, np.zeros(STATE - POSE))), self.t, self.at_rest)


def _require_finite_parts(placed: _Placed, *names: str) -> None:
    if not np.isfinite(placed.row).all():
        for name in names:
            require_finite(name, getattr(placed, name), getattr(placed, name).shape)


_REMEDY = "give a Sample, a Pose, a pin.SE3, a 4x4 matrix or a position"
_LAST, _NEARLY = [0.0, 0.0, 0.0, 1.0], 1e-3
"""Last row of a 4×4 matrix, and by how much an entry may differ from it for rounding [-]."""


def as_sample(what: Any, rotation: Array | None = None) -> Any:
    """Return a sample or pose as it is, and the pose that a `pin.SE3`, a 4×4 matrix or a position stands for.

    Args:
        what: that is given.
        rotation: (3, 3) orientation where a position is given; without it, a position alone is refused.

    Raises:
        NumericalError: it is none of these.
    """
    if type(what) is Sample or isinstance(what, Sample | Pose):
        return what
    if isinstance(what, pin.SE3):
        return Pose(what.translation, what.rotation)
    try:
        array = as_numbers("pose", what)
    except NumericalError:
        array = np.zeros(0)
    if array.shape == (4, 4):
        last = array[3].tolist()
        if last != _LAST and np.abs(np.subtract(last, _LAST)).max() > _NEARLY:
            raise NumericalError(f"a 4x4 matrix whose last row is {array[3]}, not [0 0 0 1]: is it transposed?")
        known = np.nan if sum(last) != sum(last) else 1.0
        return Pose(known * array[:3, 3], array[:3, :3])
    if array.shape == (3,):
        if rotation is None:
            raise NumericalError("a position, but only the orientation counts; give a Pose, a pin.SE3 or a 4x4 matrix")
        return Pose(array, rotation)
    given = " ".join(repr(what).split())
    shape = f" of shape {array.shape}" if array.size else ""
    raise NumericalError(f"neither a Sample nor a Pose{shape}: {given:.60}; {_REMEDY}")


def as_goal(what: Any) -> Sample:
    """Return the sample that a task should reach: a bare `Pose` is one at rest; see `as_sample`.

    Raises:
        NumericalError: no sample, and nothing that stands for a pose.
    """
    sample = as_sample(what)
    return sample if isinstance(sample, Sample) else sample.as_sample()
