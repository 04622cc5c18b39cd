"""Trajectories of targets and obstacles that are known beforehand: pose and velocity as functions of time.

The formulas are those of `kernels.sample_pieces`, which a program's loop calls for all moving obstacles at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from qpavoid import kernels
from qpavoid.config import Circle, Csv, Fixed, Line, Waypoints
from qpavoid.config import Motion as MotionConfig
from qpavoid.config.base import LARGEST
from qpavoid.errors import ConfigError, NumericalError, located
from qpavoid.kernels import Pieces
from qpavoid.model.csv_poses import read_poses
from qpavoid.model.sample import POSE, STATE, Sample
from qpavoid.problem import Array


class Motion(Protocol):
    """A trajectory that is known beforehand."""

    def sample(self, t: float) -> Sample:
        """Pose and velocity at t [s], at a corner of the next piece; NumericalError if t is NaN or inf."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A motion in pieces: rest, straight lines with the shortest rotation in each, circles."""

    pieces: Pieces
    """Those of one body."""
    initial: Sample
    """Pose at which it rests before anything begins."""

    @property
    def is_still(self) -> bool:
        """True if the pose never changes."""
        return len(self.pieces.starts) == 1

    @property
    def end_time(self) -> float:
        """Time from which on the pose does not change [s]; -∞ where it never does, ∞ where it does forever."""
        return float(self.pieces.starts[-1]) if math.isinf(self.pieces.clock[-1, 1]) else math.inf

    def sample(self, t: float) -> Sample:
        """See `Motion.sample`."""
        if self.is_still:
            return self.initial
        if not math.isfinite(t):
            raise NumericalError(f"the time at which a motion is sampled is {t}")
        states = np.empty((1, STATE))
        kernels.sample_pieces(self.pieces, t, states)
        return Sample.of_row(states[0])


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
            return still(Sample.at(position, _rotation(config.rpy, initial)))
        case Line():
            return _line(config, start, _rotation(config.rpy, initial))
        case Waypoints():
            same = [initial] * len(config.times)
            rotations = same if config.rpys is None else [rpy_to_matrix(rpy) for rpy in config.rpys]
            return _polyline(config.times, config.positions, rotations, config.profile == "smooth")
        case Circle():
            return _circle(config, start, _rotation(config.rpy, initial))
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


def still(pose: Sample) -> Trajectory:
    """Make the motion of a body that stays at a pose."""
    return _resting([pose], [])


def _resting(poses: Sequence[Sample], starts: Sequence[float]) -> Trajectory:
    """Make a motion of one more pieces than `starts`, in each of which it rests at a pose."""
    count = len(poses)
    clock, terms = np.zeros((count, 4)), np.zeros((count, 7, STATE))
    clock[:, 1] = math.inf
    for pose, term in zip(poses, terms[:, 0], strict=True):
        term[:POSE] = pose.row[:POSE]
    bodies, first = np.zeros(1, dtype=np.intp), np.array([0, count], dtype=np.intp)
    return Trajectory(Pieces(bodies, first, np.array([-math.inf, *starts]), clock, terms), poses[0])


def _polyline(
    times: Sequence[float], positions: Sequence[ArrayLike], rotations: Sequence[Array], smooth: bool = False
) -> Trajectory:
    """Make straight lines with R = exp(s φ [a]) R0 = R0 + [a]² R0 + sin(sφ) [a] R0 - cos(sφ) [a]² R0 (Rodrigues).

    It rests before the first waypoint and after the last.
    """
    samples = [Sample.at(p, r) for p, r in zip(positions, rotations, strict=True)]
    result = _resting([samples[0], *samples], times)
    clock, terms = result.pieces.clock[1:-1], result.pieces.terms[1:-1]
    for k, ((t0, a), (t1, b)) in enumerate(pairwise(zip(times, samples, strict=True))):
        displacement = b.position - a.position
        if not np.linalg.norm(displacement) <= LARGEST * (t1 - t0):
            raise ConfigError(f"motion: from t = {t0:g} to {t1:g} it moves faster than {LARGEST:g} m/s; give it time")
        turn = pin.AngleAxis(b.rotation @ a.rotation.T)
        angle = turn.angle if turn.angle > 1e-12 else 0.0  # two roundings of the same orientation are no turn
        clock[k] = t0, t1 - t0, angle, smooth
        terms[k, 1, 9:12] = terms[k, 4, 12:15] = displacement
        if angle > 0.0:
            once = pin.skew(turn.axis) @ a.rotation
            twice = pin.skew(turn.axis) @ once
            terms[k, 0, :9] += twice.T.ravel()
            terms[k, 2, :9], terms[k, 3, :9] = once.T.ravel(), -twice.T.ravel()
            terms[k, 4, 15:] = angle * turn.axis
    return result


def _line(config: Line, start: Sample | None, rotation: Array) -> Trajectory:
    begin = _position(config.start, start, "start")
    field = "displacement" if config.end is None else "end"
    end = begin + np.array(config.displacement) if config.end is None else np.array(config.end)
    length = float(np.linalg.norm(end - begin))
    if length < 1e-9:
        raise ConfigError(f"motion.{field}: the line has no length; end it elsewhere, or use `type: fixed`")
    times = [config.start_time, config.start_time + length / config.speed]
    return _polyline(times, [begin, end], [rotation, rotation], config.profile == "smooth")


def _circle(config: Circle, start: Sample | None, rotation: Array) -> Trajectory:
    """Make a circle at constant speed from t = 0: x = c + u cos ωt + w sin ωt; rest before 0 and after its turns."""
    normal = _direction(config.normal, "normal")
    direction = _direction(config.start_direction, "start_direction")
    in_plane = direction - (direction @ normal) * normal
    if np.linalg.norm(in_plane) < 1e-6:
        raise ConfigError("motion.start_direction is parallel to motion.normal; give one across it")
    u = config.radius * in_plane / np.linalg.norm(in_plane)
    w = np.cross(normal, u)
    center = _position(None, start, "center") - u if config.center is None else np.array(config.center)
    omega = 2.0 * math.pi / config.period
    if omega * max(1.0, config.radius) > LARGEST:
        raise ConfigError(f"motion.period = {config.period:g}: faster than {LARGEST:g} m/s or rad/s; give it time")
    poses, starts = [Sample.at(center + u, rotation), Sample.at(center, rotation)], [0.0]
    if config.turns is not None:
        angle = 2.0 * math.pi * config.turns
        poses.append(Sample.at(center + math.cos(angle) * u + math.sin(angle) * w, rotation))
        starts.append(config.turns * config.period)
    result = _resting(poses, starts)
    result.pieces.clock[1] = 0.0, 1.0, omega, 0.0
    terms = result.pieces.terms[1]
    terms[2, 9:12] = terms[6, 12:15] = w
    terms[3, 9:12], terms[5, 12:15] = u, -u
    return result


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
