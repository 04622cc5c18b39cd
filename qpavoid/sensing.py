"""What is known of the obstacles: trajectories, poses and twists that a program gives, tick by tick or late.

An obstacle that is given as a bare pose gets a twist from the difference of its poses. One that was given and is then
left out goes on at its last twist; after `stale_after` its distances shrink by a margin that grows, and after
`stop_after` the robot stops. Whatever is assumed is said in `Solution.assumed`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from qpavoid.cloud import Points, Voxels
from qpavoid.config import PointCloud, Sensing
from qpavoid.courses import STATE, Courses, as_samples, move_on, put
from qpavoid.errors import NumericalError, UnknownName
from qpavoid.loading import nearest
from qpavoid.motion import Sample
from qpavoid.problem import Array, IntArray, as_vector
from qpavoid.scene import Obstacle

_AT_REST = np.zeros(3)
_AT_REST.setflags(write=False)


class Pose(NamedTuple):
    """Where an obstacle was seen, when nothing is known of its velocity."""

    position: Array
    """(3,) world position [m]."""
    rotation: Array
    """(3, 3) body axes to world axes."""

    @classmethod
    def at(cls, position: ArrayLike, rotation: ArrayLike | None = None) -> Pose:
        """Copies of what is given, checked; along the world axes where no rotation is given.

        Raises:
            ConfigError: an entry has the wrong shape, or holds what is not a finite number.
        """
        sample = Sample.at(position, rotation)
        return cls(sample.position, sample.rotation)


class Seen(NamedTuple):
    """What a tick has to know of where obstacles are."""

    which: IntArray
    """(k,) numbers of those of which there is news."""
    states: Array
    """(o, 18) of all obstacles, see `courses`; those of which there is none may be anything."""
    margin: Array
    """(o,) to be taken off the distances to each, likewise [m]."""


class Observation(NamedTuple):
    """What a tick has to know of all obstacles."""

    seen: Seen
    voxels: dict[int, Voxels]
    """Of point clouds with news, by number: what is in them now."""
    assumed: tuple[str, ...] = ()
    """What was not told but taken for granted."""
    stop: tuple[str, ...] = ()
    """Why the robot has to stop; empty if it has not."""


@dataclass
class _Track:
    """One obstacle that is given from outside."""

    sample: Sample
    """As it was given last, with an estimated twist where none was."""
    estimated: bool
    age: int = 0
    """Ticks since then."""


class Obstacles:
    """Keeps track of the obstacles of a scene."""

    def __init__(self, obstacles: Sequence[Obstacle], config: Sensing, dt: float) -> None:
        self._obstacles, self._config, self._dt = obstacles, config, dt
        self._index = {obstacle.name: i for i, obstacle in enumerate(obstacles)}
        self._moving = [i for i, obstacle in enumerate(obstacles) if obstacle.moves]
        self._courses = Courses({i: obstacles[i].motion for i in self._moving})
        self._tracks: dict[int, _Track] = {}
        self._now = 0.0
        self._carried: set[int] = set()
        self._seen = Seen(np.array(self._moving, np.intp), np.zeros((len(obstacles), STATE)), np.zeros(len(obstacles)))
        self._views = as_samples(self._seen.states)

    def index(self, name: str) -> int:
        """Number of an obstacle.

        Raises:
            UnknownName: there is none of that name.
        """
        if name not in self._index:
            raise UnknownName(f"no obstacle {name!r}{nearest(name, self._index)}")
        return self._index[name]

    @property
    def moving(self) -> IntArray:
        """(k,) numbers of those that move, or are given from outside; what the robot carries is none of them."""
        return self._seen.which

    @property
    def told(self) -> bool:
        """Whether any is given from outside, so that what was foreseen of it may change from tick to tick."""
        return bool(self._tracks)

    def foreseen(self, t: float) -> Seen:
        """Where they will be at t [s], on their trajectories, or as they were last seen to move."""
        states, given = self._seen.states.copy(), list(self._tracks)
        last_seen = states[given]
        move_on(last_seen, t - self._now)
        self._courses.sample(t, states)
        for index, motion in self._courses.others.items():
            put(as_samples(states)[index], motion.sample(t))
        states[given] = last_seen
        return self._seen._replace(states=states)

    def carry(self, index: int, carried: bool) -> None:
        """Takes an obstacle as carried by the robot, or as resting where it was put down, until it is given again."""
        self._moving = [i for i in self._moving if i != index]
        self._tracks.pop(index, None)
        (self._carried.add if carried else self._carried.discard)(index)
        self._renew()

    def observe(self, t: float, given: Mapping[str, Sample | Pose | Points] | None) -> Observation | None:
        """What there is to know at time t [s]; None where nothing has changed.

        Args:
            t: time at which trajectories are evaluated [s].
            given: what the program says, by name; one with NaN or infinity counts as not given.

        Raises:
            UnknownName: there is no such obstacle.
            NumericalError: an entry of the wrong shape, or not made of numbers.
        """
        if not given and not self._moving and not self._tracks:
            return None
        self._now = t
        known = len(self._tracks)
        self._follow(t)
        fresh, voxels, notes = self._read(t, given or {})
        for index, what in fresh.items():
            if isinstance(what, Pose):
                sample, view = self._with_twist(index, what), self._views[index]
                view.linear[:], view.angular[:] = sample.linear, sample.angular
                self._tracks[index] = _Track(sample, estimated=True)
            else:
                self._tracks[index] = _Track(what, estimated=False)
        if len(self._tracks) != known:
            self._renew()
        stop: list[str] = []
        self._seen.margin.fill(0.0)
        for index, track in self._tracks.items():
            if index not in fresh:
                track.age += 1
                put(self._views[index], track.sample)
                self._predict(index, track.age * self._dt, notes, stop)
            elif track.estimated:
                notes.append(f"{self._obstacles[index].name}: twist estimated from its poses")
        return Observation(self._seen, voxels, tuple(notes), tuple(stop))

    def reset(self) -> None:
        """Forgets what was given."""
        self._tracks.clear()
        self._renew()

    def _renew(self) -> None:
        """Lays out anew of which obstacles there is news in every tick."""
        self._seen = self._seen._replace(which=np.array(sorted({*self._moving, *self._tracks}), dtype=np.intp))

    def _follow(self, t: float) -> None:
        """Brings the states of those that follow a trajectory to time t [s]."""
        self._courses.sample(t, self._seen.states)
        for index, motion in self._courses.others.items():
            if index in self._moving and index not in self._tracks:
                put(self._views[index], motion.sample(t))

    def _read(
        self, t: float, given: Mapping[str, Sample | Pose | Points]
    ) -> tuple[dict[int, Sample | Pose], dict[int, Voxels], list[str]]:
        """Poses and voxels by number of the obstacle, with notes on what is not taken."""
        fresh: dict[int, Sample | Pose] = {}
        voxels: dict[int, Voxels] = {}
        notes: list[str] = []
        for name, what in given.items():
            index = self.index(name)
            if index in self._carried:
                notes.append(f"{name}: carried by the robot, what is given of it is not read")
            elif type(what) is Points:
                if not self._look_at(index, what, t, fresh, voxels, notes):
                    self._tracks.setdefault(index, self._unseen(index, t))
            else:
                fresh[index] = as_sample(f"obstacle {name!r}", what)
        for index in self._unusable(fresh):
            notes.append(f"{self._obstacles[index].name}: NaN or infinity in its pose or twist, taken as not given")
            del fresh[index]
            voxels.pop(index, None)
            self._tracks.setdefault(index, self._unseen(index, t))
        return fresh, voxels, notes

    def _unusable(self, fresh: Mapping[int, Sample | Pose]) -> list[int]:
        """Numbers of those with NaN or infinity; puts what is given into the states."""
        if not fresh:
            return []
        for index, what in fresh.items():
            put(self._views[index], what if isinstance(what, Sample) else Sample(*what, _AT_REST, _AT_REST))
        which = np.array(list(fresh))
        usable = np.isfinite(self._seen.states[which]).all(axis=1)
        return [] if usable.all() else which[~usable].tolist()

    def _look_at(
        self,
        index: int,
        what: Points,
        t: float,
        fresh: dict[int, Sample | Pose],
        voxels: dict[int, Voxels],
        notes: list[str],
    ) -> bool:
        """Takes a picture of a camera in; false where none of its points can be used."""
        name, shape = self._obstacles[index].name, self._obstacles[index].shape
        if not isinstance(shape, PointCloud):
            raise NumericalError(f"obstacle {name!r}: points of a {shape.type}; give a Sample or a Pose")
        if isinstance(what.points, Voxels):
            seen = what.points
            if seen.resolution != shape.resolution:
                raise NumericalError(
                    f"obstacle {name!r}: voxels of {seen.resolution} m, but its resolution is {shape.resolution}"
                )
        else:
            try:
                seen = Voxels.of(what.points, shape.resolution)
            except NumericalError as error:
                raise NumericalError(f"obstacle {name!r}: {error}") from None
        if seen.dropped:
            bad = f"{seen.dropped} of {seen.given} points are NaN, infinite or more than 100 m away"
            if seen.dropped == seen.given:
                notes.append(f"{name}: {bad}, taken as not given")
                return False
            notes.append(f"{name}: {bad}, dropped")
        before = self._tracks.get(index)
        last = before.sample if before else self._obstacles[index].motion.sample(t)
        fresh[index] = last if what.pose is None else as_sample(f"obstacle {name!r}", what.pose)
        voxels[index] = seen
        return True

    def _unseen(self, index: int, t: float) -> _Track:
        return _Track(self._obstacles[index].motion.sample(t), estimated=False)

    def _with_twist(self, index: int, pose: Pose) -> Sample:
        """A pose with the twist that has led to it since the last one; at rest if it is the first."""
        before = self._tracks.get(index)
        if before is None:
            return Sample(*pose, _AT_REST, _AT_REST)
        elapsed = (before.age + 1) * self._dt
        linear = (pose.position - before.sample.position) / elapsed
        return Sample(*pose, linear, pin.log3(pose.rotation @ before.sample.rotation.T) / elapsed)

    def _predict(self, index: int, age: float, notes: list[str], stop: list[str]) -> None:
        """Moves an obstacle on from where it was last seen, `age` seconds ago."""
        name, config, margin = self._obstacles[index].name, self._config, 0.0
        if config.stale_after is not None and age > config.stale_after:
            margin = config.margin_growth * (age - config.stale_after)
            notes.append(f"{name}: not seen for {age:.3f} s, margin {1e3 * margin:.0f} mm")
            if config.stop_after is not None and age > config.stop_after:
                stop.append(f"{name}: not seen for {age:.3f} s")
        move_on(self._seen.states[index : index + 1], age)
        self._seen.margin[index] = margin


_SHAPES = {"position": (3,), "rotation": (3, 3), "linear": (3,), "angular": (3,)}


def as_sample(name: str, what: Any) -> Any:
    """A sample or pose whose parts are float arrays of the right shapes, whatever their numbers are.

    Raises:
        NumericalError: wrong shapes, or not numbers; names the argument and its part.
    """
    kind = type(what)
    if kind is Sample or kind is Pose:
        try:
            placed = what.position.shape == (3,) and what.rotation.shape == (3, 3)
            if placed and (kind is Pose or what.linear.shape == what.angular.shape == (3,)):
                return what
        except AttributeError:
            pass
    if not isinstance(what, (Sample, Pose)):
        raise NumericalError(f"{name}: neither a Sample nor a Pose: {what!r:.60}")
    parts = [
        as_vector(f"{name}: {field}", part, _SHAPES[field]) for field, part in zip(what._fields, what, strict=True)
    ]
    return type(what)(*parts)


def as_goal(name: str, what: Any) -> Sample:
    """`as_sample` of what a task should reach: a bare `Pose` is one at rest."""
    sample = as_sample(name, what)
    return sample if isinstance(sample, Sample) else Sample(sample.position, sample.rotation, _AT_REST, _AT_REST)


def finite(what: Any) -> bool:
    """Whether all its numbers are finite."""
    return isfinite(sum(float(np.vdot(part, part)) for part in what))
