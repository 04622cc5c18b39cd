"""What is known of the obstacles: trajectories, poses and twists that a program gives, tick by tick or late.

An obstacle that is given as a bare pose gets a twist from the difference of its poses. One that was given and is then
left out goes on at its last twist; after `stale_after` its distances shrink by a margin that grows, and after
`stop_after` the robot stops. Each assumption is named in `Solution.assumptions`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from qpavoid import kernels
from qpavoid.config import PointCloud, Sensing
from qpavoid.errors import NumericalError, UnknownName, nearest
from qpavoid.geometry.cloud import Points, Voxels
from qpavoid.motion import Sample
from qpavoid.obstacles.courses import STATE, Courses, as_samples, move_on, put
from qpavoid.obstacles.told import MeanTwists, Told
from qpavoid.problem import Array, IntArray, as_vector
from qpavoid.reason import Reason, ReasonKind, Severity
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
    assumptions: tuple[Reason, ...] = ()
    """What was not measured but taken for granted."""
    stop: tuple[Reason, ...] = ()
    """Why the robot has to stop; empty if it has not."""


class Obstacles:
    """Keeps track of the obstacles of a scene."""

    def __init__(self, obstacles: Sequence[Obstacle], config: Sensing, dt: float) -> None:
        self._obstacles, self._config, self._dt = obstacles, config, dt
        self._index = {obstacle.name: i for i, obstacle in enumerate(obstacles)}
        self._moving = [i for i, obstacle in enumerate(obstacles) if obstacle.moves]
        self._courses = Courses({i: obstacles[i].motion for i in self._moving})
        self._now = 0.0
        self._carried: set[int] = set()
        count = len(obstacles)
        self._seen = Seen(np.array(self._moving, np.intp), np.zeros((count, STATE)), np.zeros(count))
        self._told: Told | None = None
        self._sampled: dict[float, tuple[Array, Array]] = {}  # of those on trajectories, by time: see `paths`
        self._known: dict[int, None] = {}  # those that are given from outside, in the order in which they were first
        self._age = np.full(count, -1)  # ticks since each was given last, negative if it never was
        self._means = MeanTwists(count, dt)
        self._last, self._news = np.zeros((count, STATE)), np.zeros((count, STATE))  # as it was given then, and now
        self._views = [as_samples(states) for states in (self._seen.states, self._last, self._news)]
        self._by_pose = [Reason.of(ReasonKind.ESTIMATED, obstacle.name) for obstacle in obstacles]

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
    def told(self) -> Told | None:
        """What is known at the last tick of those that are given from outside; None where none is.

        Their twists are means of what was told lately: those of a sensor are no base for what will be in a second.
        """
        if self._told is None and self._known:
            which = list(self._known)
            states = self._seen.states[which]
            states[:, 12:] = self._means.twists[which]
            self._told = Told(tuple(which), states, self._now)
        return self._told

    @property
    def restless(self) -> bool:
        """Whether any is on a trajectory, or told to move, so that it may be elsewhere later."""
        told = self.told
        if told is None or len(told.which) < len(self.moving):
            return len(self.moving) > 0
        return bool(told.states[:, 12:].any())

    def paths(self, times: Array) -> tuple[Array, Array]:
        """Places (t, k, 3) of those that move at some times [s], and their largest speeds and rates of turning at these
        (k, 2) [m/s, rad/s].
        """
        places, rates = np.empty((len(times), len(self.moving), 3)), np.empty((len(self.moving), 2))
        told = self.told
        if told is None or len(told.which) < len(self.moving):
            self._sampled = {t: self._sampled.get(t) or self._sample(t) for t in times.tolist()}
            sampled = [np.array(parts) for parts in zip(*self._sampled.values(), strict=True)]
            places[:], rates[:] = sampled[0][:, self.moving], sampled[1][:, self.moving].max(axis=0)
        if told is not None:
            columns = np.searchsorted(self.moving, told.which)
            ahead = (times - told.t)[:, None, None] * told.states[:, 12:15]
            places[:, columns], rates[columns] = told.states[:, 9:12] + ahead, _rates(told.states)
        return places, rates

    def _sample(self, t: float) -> tuple[Array, Array]:
        """Places (o, 3) and rates (o, 2) of those that follow a trajectory."""
        states = np.zeros_like(self._seen.states)
        self._at(t, states)
        return states[:, 9:12], _rates(states)

    def foreseen(self, t: float) -> Seen:
        """Where they will be at t [s], on their trajectories, or as they were last seen to move."""
        states, told = self._seen.states.copy(), self.told
        self._at(t, states)
        if told is not None:
            later = told.states.copy()
            move_on(later, t - told.t)
            states[list(told.which)] = later
        return self._seen._replace(states=states)

    def _at(self, t: float, states: Array) -> None:
        """Brings the states (o, 18) of those that follow a trajectory to time t [s]."""
        self._courses.sample(t, states)
        for index, motion in self._courses.others.items():
            put(as_samples(states)[index], motion.sample(t))

    def carry(self, index: int, carried: bool) -> None:
        """Takes an obstacle as carried by the robot, or as resting where it was put down, until it is given again."""
        self._moving = [i for i in self._moving if i != index]
        self._forget(index)
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
        if not given and not self._moving and not self._known:
            return None
        self._now, self._told = t, None
        self._follow(t)
        self._seen.margin.fill(0.0)
        notes: list[Reason] = []
        stop: list[Reason] = []
        fresh, voxels = self._read(t, given, notes) if given else (set(), {})
        for index in self._known:
            if index not in fresh:
                self._predict(index, notes, stop)
        return Observation(self._seen, voxels, tuple(notes), tuple(stop))

    def reset(self) -> None:
        """Forgets what was given."""
        for index in list(self._known):
            self._forget(index)
        self._renew()

    def _forget(self, index: int) -> None:
        self._known.pop(index, None)
        self._age[index] = -1
        self._means.forget(index)

    def _renew(self) -> None:
        """Lays out anew of which obstacles there is news in every tick."""
        self._told = None
        self._seen = self._seen._replace(which=np.array(sorted({*self._moving, *self._known}), dtype=np.intp))

    def _follow(self, t: float) -> None:
        """Brings the states of those that follow a trajectory to time t [s]."""
        self._courses.sample(t, self._seen.states)
        for index, motion in self._courses.others.items():
            if index in self._moving and index not in self._known:
                put(self._views[0][index], motion.sample(t))

    def _read(
        self, t: float, given: Mapping[str, Sample | Pose | Points], notes: list[Reason]
    ) -> tuple[set[int], dict[int, Voxels]]:
        """Takes in what is given: numbers of those of which something is known now, and the voxels of clouds."""
        which, posed = [], []
        voxels: dict[int, Voxels] = {}
        for name, what in given.items():
            index = self.index(name)
            if index in self._carried:
                notes.append(Reason.of(ReasonKind.IGNORED, name, detail="attached to the robot"))
                continue
            if type(what) is Points:
                seen = self._look_at(index, what, notes)
                if seen is None or what.pose is None:
                    self._begin(index, t)
                if seen is None:
                    continue
                voxels[index], what = seen, self._views[1][index] if what.pose is None else what.pose
            sample = _checked(name, what)
            for view, part in zip(self._views[2][index], sample):  # noqa: B905 (a bare pose has only the first two)
                view[:] = part
            which.append(index)
            posed.append(len(sample) == 2)
        if not which:
            return set(), voxels
        numbers, bare = np.array(which), np.array(posed)
        known = ~bare | (self._age[numbers] >= 0)  # of a first pose, no twist is known
        fine = kernels.take_in(numbers, bare, self._news, self._age, self._last, self._seen.states, self._dt)
        self._means.hear(numbers[fine & known], self._last)
        for index in numbers[~fine].tolist():
            name = self._obstacles[index].name
            notes.append(Reason.of(ReasonKind.IMPLAUSIBLE, name, severity=Severity.WARNING, detail="NaN or infinity"))
            voxels.pop(index, None)
            self._begin(index, t)
        notes += [self._by_pose[index] for index in numbers[fine & bare].tolist()]
        fresh = set(numbers[fine].tolist())
        if not fresh <= self._known.keys():
            self._known |= dict.fromkeys(numbers[fine].tolist())
            self._renew()
        return fresh, voxels

    def _begin(self, index: int, t: float) -> None:
        """Takes an obstacle of which nothing was given that can be used to be where its motion has it."""
        if index not in self._known:
            put(self._views[1][index], self._obstacles[index].motion.sample(t))
            self._known[index], self._age[index] = None, 0
            self._means.hear(np.array([index]), self._last)
            self._renew()

    def _look_at(self, index: int, what: Points, notes: list[Reason]) -> Voxels | None:
        """What a picture of a camera shows; None where none of its points can be used."""
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
            everything = seen.dropped == seen.given
            notes.append(
                Reason.of(
                    ReasonKind.POINTS_DROPPED,
                    name,
                    amount=seen.dropped,
                    unit="-",
                    severity=Severity.WARNING if everything else None,
                    detail=f"of {seen.given}: NaN, infinite or more than 100 m away",
                )
            )
            if everything:
                return None
        return seen

    def _predict(self, index: int, notes: list[Reason], stop: list[Reason]) -> None:
        """Moves an obstacle of which there is no news on from where it was last seen."""
        self._age[index] += 1
        name, config, margin = self._obstacles[index].name, self._config, 0.0
        age = float(self._age[index]) * self._dt
        if config.stale_after is not None and age > config.stale_after:
            margin = config.margin_growth * (age - config.stale_after)
            notes.append(
                Reason.of(ReasonKind.STALE, name, amount=age, unit="s", detail=f"margin {1e3 * margin:.0f} mm")
            )
            if config.stop_after is not None and age > config.stop_after:
                stop.append(Reason.of(ReasonKind.STALE, name, amount=age, unit="s", severity=Severity.ALARM))
        self._seen.states[index] = self._last[index]
        move_on(self._seen.states[index : index + 1], age)
        self._seen.margin[index] = margin


def _rates(states: Array) -> Array:
    """Speeds and rates of turning (..., 2) of states (..., 18) [m/s, rad/s]."""
    return np.asarray(np.linalg.norm(states[..., 12:].reshape(*states.shape[:-1], 2, 3), axis=-1))


_SHAPES = {"position": (3,), "rotation": (3, 3), "linear": (3,), "angular": (3,)}


def _checked(obstacle: str, what: Any) -> Any:
    try:
        return as_sample(what)
    except NumericalError as error:
        raise NumericalError(f"obstacle {obstacle!r}: {error}") from None


def as_sample(what: Any) -> Any:
    """A sample or pose whose parts are float arrays of the right shapes, whatever their numbers are.

    Raises:
        NumericalError: wrong shapes, or not numbers; names the part.
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
        remedy = "give Sample.at(position, rotation, linear, angular), all but the first optional"
        raise NumericalError(f"neither a Sample nor a Pose: {' '.join(repr(what).split()):.60}; {remedy}")
    return type(what)(*[as_vector(name, part, _SHAPES[name]) for name, part in zip(what._fields, what, strict=True)])


def as_goal(what: Any) -> Sample:
    """`as_sample` of what a task should reach: a bare `Pose` is one at rest."""
    sample = as_sample(what)
    return sample if isinstance(sample, Sample) else Sample(sample.position, sample.rotation, _AT_REST, _AT_REST)


def finite(what: Any) -> bool:
    """Whether all its numbers are finite."""
    return isfinite(sum(float(np.vdot(part, part)) for part in what))
