"""Off-line trajectories of targets and obstacles: pose and velocity of a body origin as functions of time.

Three kinds cover all: `Still` (fixed pose), `Polyline` (line, waypoints, CSV) and `Orbit` (circle). All that can
be worked out beforehand is, because `sample` runs in the control loop.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from qpavoid.config import Circle, Csv, Fixed, Line, Waypoints
from qpavoid.config import Motion as MotionConfig
from qpavoid.config.base import LARGEST
from qpavoid.errors import ConfigError, NumericalError, located
from qpavoid.model.csv_poses import read_poses
from qpavoid.problem import Array, require_finite

END_TOLERANCE = 1e-9
"""Time before its end at which a piece ends [s]: k·dt may be a rounding error less than the time it stands for."""


class Sample(NamedTuple):
    """Pose of a body origin and its velocity, all in world axes."""

    position: Array
    """(3,) world position [m]."""
    rotation: Array
    """(3, 3) body axes to world axes."""
    linear: Array
    """(3,) velocity of the origin [m/s]."""
    angular: Array
    """(3,) angular velocity [rad/s]."""
    t: float | None = None
    """Time stamp: when an obstacle was there [s]; the time of the control step if left out."""
    at_rest: bool = False
    """Whether an obstacle stays there until another sample is given: it is never stale."""

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
        """Make a sample of read-only copies; what is left out is the identity, or zero.

        Raises:
            NumericalError: an entry has the wrong shape, or holds what is not a finite number.
        """
        return cls(
            _checked("position", position, (3,)),
            _checked("rotation", np.eye(3) if rotation is None else rotation, (3, 3)),
            _checked("linear", np.zeros(3) if linear is None else linear, (3,)),
            _checked("angular", np.zeros(3) if angular is None else angular, (3,)),
            t,
            at_rest,
        )


class Motion(Protocol):
    """A trajectory that is known beforehand."""

    def sample(self, t: float) -> Sample:
        """Pose and velocity at t [s], at a corner of the next piece; NumericalError if t is NaN or inf."""


@dataclass(frozen=True, slots=True)
class Still:
    """A pose that never changes."""

    pose: Sample

    def sample(self, t: float) -> Sample:
        """See `Motion.sample`."""
        return self.pose


@dataclass(frozen=True, slots=True)
class Piece:
    """Stretch from one waypoint to the next: x = x0 + s Δx, R = exp(s φ [a]) R0, s from 0 to 1."""

    time: float  # of its start [s]
    duration: float  # [s]
    start: Sample  # x0 and R0, at rest
    displacement: Array  # Δx (3,) [m]
    angle: float  # φ in [0, π] [rad]; exactly 0 where the orientation stays
    axis: Array  # unit a (3,)
    turned: tuple[Array, Array]  # [a] R0, [a]² R0: Rodrigues' formula needs only their weighted sum


@dataclass(frozen=True, slots=True)
class Polyline:
    """Straight pieces with the shortest turn in each; rest before the first waypoint and after the last."""

    times: tuple[float, ...]  # of the waypoints [s], increasing
    first: Sample
    last: Sample
    pieces: tuple[Piece, ...]  # one fewer than waypoints: a single waypoint is a pose that does not change
    smooth: bool  # s = 10 τ³ - 15 τ⁴ + 6 τ⁵, rest to rest, instead of s = τ, the share of the piece's time

    def sample(self, t: float) -> Sample:
        """See `Motion.sample`."""
        index = bisect_right(self.times, _finite(t) + END_TOLERANCE) - 1
        if index < 0:
            return self.first
        if index >= len(self.pieces):
            return self.last
        piece = self.pieces[index]
        s = max(0.0, (t - piece.time) / piece.duration)
        rate = 1.0 / piece.duration
        if self.smooth:
            rate *= 30.0 * (s * (1.0 - s)) ** 2
            s *= s * s * (10.0 + s * (6.0 * s - 15.0))
        start = piece.start
        position, linear = start.position + s * piece.displacement, rate * piece.displacement
        if piece.angle == 0.0:
            return Sample(position, start.rotation, linear, start.angular)
        angle, (first_product, second_product) = s * piece.angle, piece.turned
        rotation = start.rotation + math.sin(angle) * first_product + (1.0 - math.cos(angle)) * second_product
        return Sample(position, rotation, linear, rate * piece.angle * piece.axis)


@dataclass(frozen=True, slots=True)
class Orbit:
    """Circle at constant speed from t = 0: x = c + u cos ωt + w sin ωt; rest before 0 and after `end`."""

    center: Sample  # c, and the constant orientation; at rest
    u: Array  # (3,) from the centre to the start [m]
    w: Array  # (3,) from the centre to the place a quarter turn on [m]
    omega: float  # ω [rad/s]
    end: float  # [s]; infinite if it goes on for ever

    def sample(self, t: float) -> Sample:
        """See `Motion.sample`."""
        early = _finite(t) + END_TOLERANCE
        angle = self.omega * (max(t, 0.0) if early < self.end else self.end)
        cos, sin = math.cos(angle), math.sin(angle)
        center = self.center
        moves = 0.0 <= early < self.end
        linear = self.omega * (cos * self.w - sin * self.u) if moves else center.linear
        return Sample(center.position + cos * self.u + sin * self.w, center.rotation, linear, center.angular)


def build_motion(config: MotionConfig, start: Sample | None = None, folder: Path = Path()) -> Motion:
    """Turn a motion block into a trajectory.

    Args:
        config: the block.
        start: pose from which a task takes what the block leaves out; None for obstacles, which must give
            their position and have the identity as orientation unless they give one.
        folder: where the path of a CSV file begins.

    Raises:
        ConfigError: a position is missing, a line has no length, a circle no plane, or a CSV file is no good.
    """
    initial = np.eye(3) if start is None else start.rotation
    match config:
        case Fixed():
            position = _position(config.position, start, "position")
            return Still(Sample.at(position, _rotation(config.rpy, initial)))
        case Line():
            return _line(config, start, _rotation(config.rpy, initial))
        case Waypoints():
            same = [initial] * len(config.times)
            rotations = same if config.rpys is None else [rpy_to_matrix(rpy) for rpy in config.rpys]
            return _polyline(config.times, config.positions, rotations, config.profile == "smooth")
        case Circle():
            return _orbit(config, start, _rotation(config.rpy, initial))
        case Csv():
            poses = read_poses(folder / config.path, initial)
            with located(str(folder / config.path)):
                return _polyline(*poses)


def rpy_to_matrix(rpy: ArrayLike) -> Array:
    """Return R (3, 3) = Rz(yaw) Ry(pitch) Rx(roll).

    Roll, pitch and yaw [rad] turn about the fixed axes x, y, z.
    """
    matrix: Array = pin.rpy.rpyToMatrix(np.asarray(rpy, dtype=float))
    return matrix


# --- one builder a kind -------------------------------------------------------------------------------------


def _polyline(
    times: Sequence[float], positions: Sequence[ArrayLike], rotations: Sequence[Array], smooth: bool = False
) -> Polyline:
    samples = [Sample.at(p, r) for p, r in zip(positions, rotations, strict=True)]
    pieces = []
    for (t0, a), (t1, b) in pairwise(zip(times, samples, strict=True)):
        if not np.linalg.norm(b.position - a.position) <= LARGEST * (t1 - t0):
            raise ConfigError(f"motion: from t = {t0:g} to {t1:g} it moves faster than {LARGEST:g} m/s; give it time")
        turn = pin.AngleAxis(b.rotation @ a.rotation.T)
        # Two roundings of the same orientation are no turn.
        angle = turn.angle if turn.angle > 1e-12 else 0.0
        axis = np.array(turn.axis)
        first_product = pin.skew(axis) @ a.rotation
        turned = (first_product, pin.skew(axis) @ first_product)
        pieces.append(Piece(t0, t1 - t0, a, b.position - a.position, angle, axis, turned))
    return Polyline(tuple(times), samples[0], samples[-1], tuple(pieces), smooth)


def _line(config: Line, start: Sample | None, rotation: Array) -> Polyline:
    begin = _position(config.start, start, "start")
    field = "displacement" if config.end is None else "end"
    end = begin + np.array(config.displacement) if config.end is None else np.array(config.end)
    length = float(np.linalg.norm(end - begin))
    if length < 1e-9:
        raise ConfigError(f"motion.{field}: the line has no length; end it elsewhere, or use `type: fixed`")
    times = [config.start_time, config.start_time + length / config.speed]
    return _polyline(times, [begin, end], [rotation, rotation], config.profile == "smooth")


def _orbit(config: Circle, start: Sample | None, rotation: Array) -> Orbit:
    normal = _direction(config.normal, "normal")
    direction = _direction(config.start_direction, "start_direction")
    in_plane = direction - (direction @ normal) * normal
    if np.linalg.norm(in_plane) < 1e-6:
        raise ConfigError("motion.start_direction is parallel to motion.normal; give one across it")
    u = config.radius * in_plane / np.linalg.norm(in_plane)
    center = _position(None, start, "center") - u if config.center is None else np.array(config.center)
    omega = 2.0 * math.pi / config.period
    if omega * max(1.0, config.radius) > LARGEST:
        raise ConfigError(f"motion.period = {config.period:g}: faster than {LARGEST:g} m/s or rad/s; give it time")
    end = math.inf if config.turns is None else config.turns * config.period
    return Orbit(Sample.at(center, rotation), u, np.asarray(np.cross(normal, u), dtype=np.float64), omega, end)


# --- small checks and conversions ---------------------------------------------------------------------------


def _position(value: tuple[float, float, float] | None, start: Sample | None, field: str) -> Array:
    if value is not None:
        return np.array(value)
    if start is None:
        raise ConfigError(f"motion.{field} is missing; only a task can take it from its frame")
    return start.position


def _rotation(rpy: tuple[float, float, float] | None, initial: Array) -> Array:
    return initial if rpy is None else rpy_to_matrix(rpy)


def _direction(vector: tuple[float, float, float], field: str) -> Array:
    """Return the unit vector (3,) along `vector`."""
    norm = math.hypot(*vector)
    if norm < 1e-9:
        raise ConfigError(f"motion.{field} has no length; give a direction such as [0, 0, 1]")
    return np.array(vector) / norm


def _checked(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.array(require_finite(name, value, shape))
    array.setflags(write=False)  # samples of one motion share it
    return array


def _finite(t: float) -> float:
    if not math.isfinite(t):
        raise NumericalError(f"the time at which a motion is sampled is {t}")
    return t
