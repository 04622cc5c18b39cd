"""What is known of the obstacles: trajectories, poses and twists that a program gives, step by step or late.

An obstacle is external from the time on at which a program gives it, or from the start if the scene says so. What is
given has a time stamp, that of the control step if it brings none. A bare pose gets a twist from the difference of two
poses over that of their stamps. An external obstacle that is not updated goes on at its last twist; after `stale_after`
its distances shrink by a margin that grows, and after `stop_after` the robot stops, unless it was given `at_rest`. Each
assumption is named in `Solution.assumptions`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import nan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from qpavoid import kernels
from qpavoid.config import PointCloud, Sensing
from qpavoid.errors import NumericalError, UnknownName, nearest
from qpavoid.geometry.cloud import Points, Voxels
from qpavoid.inputs import FARTHEST, FASTEST, FAULTS, as_time
from qpavoid.kernels.motions import FAST, NORMALISED, NOT_FINITE, POSE, REST, SAMPLE
from qpavoid.motion import Sample
from qpavoid.obstacles.courses import STATE, Courses, as_samples, move_on, put
from qpavoid.obstacles.told import MeanTwists, Told
from qpavoid.problem import Array, IntArray, as_vector
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.scene import Obstacle

_AT_REST = np.zeros(3)
_AT_REST.setflags(write=False)
_LEAST_PERIODS = 3.0
"""Control periods before which no obstacle is stale: that of one that is updated in every step, with one step missed
and one late."""
_SHORTEST = 1e-3
"""Part of a control period below which two poses count as of the same time, so that no twist follows from them."""
_LONGEST = 1e3
"""Time for which an obstacle goes on at its last twist at the most [s]: by then it is out of every scene."""
_ROUND_OFF = 1e-9
"""Difference of two times that counts as none [s]."""


class Pose(NamedTuple):
    """Where an obstacle was seen, when nothing is known of its velocity."""

    position: Array
    """(3,) world position [m]."""
    rotation: Array
    """(3, 3) body axes to world axes."""
    t: float | None = None
    """Time stamp: when it was there [s]; the time of the control step if left out."""
    at_rest: bool = False
    """Whether it stays there until another pose is given: it is never stale."""

    @classmethod
    def at(
        cls, position: ArrayLike, rotation: ArrayLike | None = None, t: float | None = None, at_rest: bool = False
    ) -> Pose:
        """Make copies of what is given, checked; along the world axes where no rotation is given.

        Raises:
            NumericalError: an entry has the wrong shape, or holds what is not a finite number.
        """
        sample = Sample.at(position, rotation)
        return cls(sample.position, sample.rotation, t, at_rest)


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


class Update(NamedTuple):
    """What a step is given of the obstacles, checked; none of it is believed yet."""

    t: float
    """Time of the step [s]."""
    shift: float
    """By how much the clock was set back [s]."""
    which: IntArray
    """(k,) numbers of those of which there is an update that can be used."""
    kind: IntArray
    """(k,) SAMPLE, POSE or REST."""
    stamps: Array
    """(k,) their time stamps [s]."""
    voxels: dict[int, Voxels]
    """Of point clouds that are updated, by number: what is in them now."""
    unusable: tuple[int, ...]
    """Numbers of those of which there is an update that cannot be used."""
    followed: tuple[tuple[int, Sample], ...]
    """Where those are that follow a trajectory of another class."""
    notes: tuple[Reason, ...]


class Obstacles:
    """Keeps track of the obstacles of a scene."""

    def __init__(self, obstacles: Sequence[Obstacle], config: Sensing, dt: float) -> None:
        self._obstacles, self._dt = obstacles, dt
        least, (stale, stop) = _LEAST_PERIODS * dt + _ROUND_OFF, (config.stale_after, config.stop_after)
        self._stale_after = np.inf if stale is None else max(stale + _ROUND_OFF, least)
        self._stop_after = np.inf if stop is None else max(stop + _ROUND_OFF, least)
        self._growth = config.margin_growth
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
        self._external = np.zeros(0, dtype=np.intp)  # the same, as an array
        self._awaited = {i for i, obstacle in enumerate(obstacles) if obstacle.external}  # external, never given
        self._stamps = np.full(count, nan)  # of what was given last, NaN where nothing was
        self._resting = np.zeros(count, dtype=bool)  # whether that was at rest
        self._means = MeanTwists(count)
        self._last, self._news = np.zeros((count, STATE)), np.zeros((count, STATE))  # as it was given then, and now
        self._views = [as_samples(states) for states in (self._seen.states, self._last, self._news)]
        self._by_pose = [Reason.of(ReasonKind.ESTIMATED, obstacle.name) for obstacle in obstacles]

    def warm_up(self) -> None:
        """Run the kernels once on nothing, so that no step waits for the compiler."""
        kernels.check_states(self._news, _NONE, _NONE, FARTHEST, FASTEST)
        times, copies = self._stamps.copy(), [self._last.copy() for _ in range(3)]
        news, last, states = copies
        kernels.take_in(_NONE, _NONE, _NO_STAMPS, news, times, last, states, self._dt, FASTEST)

    def index(self, name: str) -> int:
        """Number of an obstacle.

        Raises:
            UnknownName: there is none of that name.
        """
        if not isinstance(name, str) or name not in self._index:
            raise UnknownName(f"no obstacle {name!r:.60}{nearest(str(name), self._index)}")
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
        self._awaited.discard(index)
        (self._carried.add if carried else self._carried.discard)(index)
        self._renew()

    def reset(self) -> None:
        """Forgets what was given."""
        for index in list(self._known):
            self._forget(index)
        external = {i for i, obstacle in enumerate(self._obstacles) if obstacle.external}
        self._awaited = external - self._carried
        self._renew()

    def _forget(self, index: int) -> None:
        self._known.pop(index, None)
        self._stamps[index], self._resting[index] = nan, False
        self._means.forget(index)

    def _renew(self) -> None:
        """Lays out anew of which obstacles there is something new in every step."""
        self._told = None
        self._external = np.array(list(self._known), dtype=np.intp)
        self._seen = self._seen._replace(which=np.array(sorted({*self._moving, *self._known}), dtype=np.intp))

    def observe(self, t: float, given: Mapping[str, Sample | Pose | Points] | None) -> Observation | None:
        """`read` and `advance` in one."""
        return self.advance(self.read(t, given))

    def read(self, t: float, given: Mapping[str, Sample | Pose | Points] | None, shift: float = 0.0) -> Update | None:
        """Check what a step is given; what is known stays as it is.

        Args:
            t: time of the step [s].
            given: what the program says, by name. What cannot be true counts as not given.
            shift: by how much the clock was set back [s].

        Returns:
            None where there is nothing to know of any obstacle.

        Raises:
            UnknownName: there is no such obstacle.
            NumericalError: an entry of the wrong shape, or not made of numbers; a trajectory of another class gives
                what cannot be true.
        """
        if given is not None and not isinstance(given, Mapping):
            raise NumericalError(f"obstacles: give a mapping of names to samples, not {given!r:.60}")
        if not given:
            if not self._moving and not self._known and not self._awaited:
                return None
            return Update(t, shift, _NONE, _NONE, _NO_STAMPS, {}, (), self._follow(t), ())
        which, kind, stamps = list[int](), list[int](), list[float]()
        voxels, unusable, notes = dict[int, Voxels](), list[int](), list[Reason]()
        for name, what in given.items():
            index = self.index(name)
            if index in self._carried:
                notes.append(Reason.of(ReasonKind.IGNORED, name, detail="attached to the robot"))
                continue
            cloud = self._look_at(index, what, notes) if type(what) is Points else None
            sample = self._pose_of(index, what, t, shift) if type(what) is Points else _checked(name, what)
            stamp, rests = (t if sample.t is None else as_time(f"obstacle {name!r}: t", sample.t)), sample.at_rest
            if not isinstance(rests, bool | np.bool_):
                raise NumericalError(f"obstacle {name!r}: at_rest: {rests!r:.60}; give true or false")
            if rests and isinstance(sample, Sample) and (sample.linear.any() or sample.angular.any()):
                raise NumericalError(f"obstacle {name!r}: at_rest, but it has a velocity; leave one of them out")
            if stamp != t:
                wrong = self._wrong_stamp(index, stamp, t, shift)
                if wrong is not None:
                    notes.append(wrong)
                    if wrong.kind is not ReasonKind.IGNORED:
                        unusable.append(index)
                    continue
            if type(what) is Points and cloud is None:
                unusable.append(index)
                continue
            if cloud is not None:
                voxels[index] = cloud
            views: Any = self._views[2][index]
            for view, part in zip(views, sample[:-2]):  # noqa: B905 (a bare pose has only two)
                view[:] = part
            which.append(index)
            kind.append(REST if rests else POSE if isinstance(sample, Pose) else SAMPLE)
            stamps.append(stamp)
        numbers, kinds, times = np.array(which, dtype=np.intp), np.array(kind, dtype=np.intp), np.array(stamps)
        codes, off = kernels.check_states(self._news, numbers, kinds, FARTHEST, FASTEST)
        if codes.any():
            bad = codes > NORMALISED
            for k in np.flatnonzero(codes).tolist():
                name = self._obstacles[which[k]].name
                notes.append(_unlikely(name, FAULTS[int(codes[k])]) if bad[k] else
                             Reason.of(ReasonKind.NORMALISED, name, amount=float(off[k]), unit="-"))  # fmt: skip
                if bad[k]:
                    unusable.append(which[k])
                    voxels.pop(which[k], None)
            numbers, kinds, times = numbers[~bad], kinds[~bad], times[~bad]
        followed = self._follow(t, which)
        return Update(t, shift, numbers, kinds, times, voxels, tuple(unusable), followed, tuple(notes))

    def _wrong_stamp(self, index: int, stamp: float, t: float, shift: float) -> Reason | None:
        name = self._obstacles[index].name
        if not stamp <= t + self._dt:  # neither is NaN
            return _unlikely(name, f"stamped {stamp:g} s, later than the control step")
        if stamp <= self._stamps[index] + shift:
            return Reason.of(ReasonKind.IGNORED, name, detail=f"stamped {stamp:g} s, not later than the one before")
        return None

    def _pose_of(self, index: int, what: Points, t: float, shift: float) -> Any:
        """Sample of the frame of a cloud that is given: as given with it, or where it was."""
        if what.pose is None:
            state = self._last[index : index + 1].copy()
            if index in self._known:
                move_on(state, t - shift - self._stamps[index])
            else:
                put(as_samples(state)[0], self._obstacles[index].motion.sample(t))
            sample = as_samples(state)[0]
        else:
            sample = _checked(self._obstacles[index].name, what.pose)
        return sample._replace(t=sample.t if what.t is None else what.t, at_rest=what.at_rest or sample.at_rest)

    def _follow(self, t: float, given: Sequence[int] = ()) -> tuple[tuple[int, Sample], ...]:
        """Sample the trajectories of other classes at t [s], but for obstacles that are given.

        Raises:
            NumericalError: one gives what cannot be true; names the obstacle.
        """
        found = []
        for index, motion in self._courses.others.items():
            if index in self._moving and index not in self._known and index not in given:
                sample = motion.sample(t)
                state = np.zeros((1, STATE))
                put(as_samples(state)[0], sample)
                code = int(kernels.check_states(state, _FIRST, _SAMPLED, FARTHEST, FASTEST)[0][0])
                if code > NORMALISED:
                    fault = f"{FAULTS[code]} in its pose or twist" if code == NOT_FINITE else FAULTS[code]
                    raise NumericalError(f"obstacle {self._obstacles[index].name!r}: {fault}")
                found.append((index, as_samples(state)[0]))
        return tuple(found)

    def advance(self, update: Update | None) -> Observation | None:
        """What a step has to know of all obstacles; None where there is nothing."""
        if update is None:
            return None
        t, which = update.t, update.which
        self._now, self._told = t, None
        if update.shift:
            self._stamps += update.shift
            self._sampled.clear()
        self._courses.sample(t, self._seen.states)
        for index, sample in update.followed:
            put(self._views[0][index], sample)
        self._seen.margin.fill(0.0)
        notes, stop, voxels = list(update.notes), list[Reason](), update.voxels
        self._begin([i for i in (*update.unusable, *self._awaited) if i not in self._known], t)
        if len(which):
            notes += self._take_in(update, voxels)
        self._predict(t, notes, stop)
        return Observation(self._seen, voxels, tuple(notes), tuple(stop))

    def _take_in(self, update: Update, voxels: dict[int, Voxels]) -> list[Reason]:
        which, before = update.which, self._stamps[update.which]
        fine = kernels.take_in(
            which, update.kind, update.stamps, self._news, self._stamps, self._last, self._seen.states,
            _SHORTEST * self._dt, FASTEST,
        )  # fmt: skip
        notes = []
        if not fine.all():
            for index in which[~fine].tolist():
                notes.append(_unlikely(self._obstacles[index].name, f"its poses are too far apart: {FAULTS[FAST]}"))
                voxels.pop(index, None)
        posed = update.kind == POSE
        known = fine & (~posed | (before == before))  # of a first pose, no twist is known
        self._means.add(which[known], update.stamps[known] - before[known], self._last)
        self._resting[which[fine]] = update.kind[fine] == REST
        notes += [self._by_pose[index] for index in which[fine & posed].tolist()]
        fresh = which[fine].tolist()
        self._awaited.difference_update(fresh)
        if not self._known.keys() >= set(fresh):
            self._known |= dict.fromkeys(fresh)
            self._renew()
        return notes

    def _begin(self, which: Sequence[int], t: float) -> None:
        """Takes external obstacles of which nothing was given that can be used to be where their motion has them."""
        for index in which:
            put(self._views[1][index], self._obstacles[index].motion.sample(t))
            self._known[index], self._stamps[index] = None, t
        if which:
            self._renew()

    def _predict(self, t: float, notes: list[Reason], stop: list[Reason]) -> None:
        """Moves external obstacles on from where they were at their time stamps, and names those that are stale."""
        external = self._external
        age = t - self._stamps[external]
        late = age > 0.0
        self._seen.states[external] = self._last[external]
        if late.any():
            which = external[late]
            states = self._last[which]
            move_on(states, np.minimum(age[late], _LONGEST))
            self._seen.states[which] = states
        for index in self._awaited:
            since = float(t - self._stamps[index])
            notes.append(Reason.of(ReasonKind.NEVER_UPDATED, self._obstacles[index].name, amount=since, unit="s"))
        stale = late & (age > self._stale_after) & ~self._resting[external]
        for index, old in zip(external[stale].tolist(), age[stale].tolist(), strict=True):
            name, margin = self._obstacles[index].name, self._growth * (old - self._stale_after)
            self._seen.margin[index] = margin
            kind = ReasonKind.NEVER_UPDATED if index in self._awaited else ReasonKind.STALE
            if kind is ReasonKind.STALE:
                detail = f"margin {1e3 * margin:.0f} mm"
                notes.append(Reason.of(kind, name, amount=old, unit="s", detail=detail))
            if old > self._stop_after:
                stop.append(Reason.of(kind, name, amount=old, unit="s", severity=Severity.ALARM))

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


def _rates(states: Array) -> Array:
    """Speeds and rates of turning (..., 2) of states (..., 18) [m/s, rad/s]."""
    return np.asarray(np.linalg.norm(states[..., 12:].reshape(*states.shape[:-1], 2, 3), axis=-1))


_SHAPES = {"position": (3,), "rotation": (3, 3), "linear": (3,), "angular": (3,)}
_NONE, _NO_STAMPS = np.zeros(0, dtype=np.intp), np.zeros(0)
_FIRST, _SAMPLED = np.array([0]), np.array([SAMPLE])


def _unlikely(name: str, detail: str) -> Reason:
    """Reason why an update of an obstacle is not used."""
    return Reason.of(ReasonKind.IMPLAUSIBLE, name, severity=Severity.WARNING, detail=detail)


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
            placed = placed and what.position.dtype == what.rotation.dtype == np.float64
            moves = kind is Pose or what.linear.shape == what.angular.shape == (3,)
            if placed and moves and (kind is Pose or what.linear.dtype == what.angular.dtype == np.float64):
                return what
        except AttributeError:
            pass
    if not isinstance(what, (Sample, Pose)):
        remedy = "give Sample.at(position, rotation, linear, angular), all but the first optional"
        raise NumericalError(f"neither a Sample nor a Pose: {' '.join(repr(what).split()):.60}; {remedy}")
    parts = [as_vector(name, getattr(what, name), _SHAPES[name]) for name in what._fields[:-2]]
    kind_of: Any = type(what)
    return kind_of(*parts, what.t, what.at_rest)


def as_goal(what: Any) -> Sample:
    """`as_sample` of what a task should reach: a bare `Pose` is one at rest."""
    sample = as_sample(what)
    return sample if isinstance(sample, Sample) else Sample(sample.position, sample.rotation, _AT_REST, _AT_REST)
