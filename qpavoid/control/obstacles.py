"""Tracks the obstacles: on their trajectories, or by the poses and twists that a program gives, step by step or late.

An obstacle is external from the time on at which a program gives it, or from the start if the scene says so. What is
given has a time stamp, that of the control step if it brings none. A bare pose gets a twist from a line through the
poses of late, over their stamps. An external obstacle that is not updated keeps its last twist; after `stale_after`
its distances shrink by a margin that grows, and after `stop_after` the robot stops, unless it was given `at_rest`. Each
assumption is named in `Solution.assumptions`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from qpavoid import kernels
from qpavoid.config import Sensing
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.estimates import MeasuredStates
from qpavoid.control.inputs import FAULTS
from qpavoid.control.obstacle_states import NOTHING, Observation, ObstacleStates, StepUpdate
from qpavoid.control.trajectories import TrajectoryBatch, extrapolate
from qpavoid.control.update_parts import unlikely
from qpavoid.control.updates import NO_UPDATE, Update, UpdateReader
from qpavoid.errors import NumericalError
from qpavoid.kernels import Prediction
from qpavoid.kernels.obstacles import FARTHEST, FAST, FASTEST, NORMALISED, NOT_FINITE, SAMPLE
from qpavoid.model.sample import Sample
from qpavoid.model.scene import Obstacle
from qpavoid.model.trajectory import Motion
from qpavoid.problem import Array, IntArray
from qpavoid.reason import Reason, ReasonKind, Severity

_LEAST_PERIODS = 3.0
"""Control periods before which no obstacle is stale: that of one that is updated in every step, with one step missed
and one late."""
_ROUND_OFF = 1e-9
"""Difference of two times that counts as none [s]."""
_FIRST, _SAMPLED = np.array([0]), np.array([SAMPLE])


class ObstacleTracker:
    """Keeps the states of the obstacles of a scene."""

    def __init__(self, obstacles: Sequence[Obstacle], config: Sensing, dt: float, latency: float = 0.0) -> None:
        """Lay out memory; dt is the control period, a step needs the states of `latency` after its time [s]."""
        self._obstacles, self._latency = obstacles, latency
        least, (stale, stop) = _LEAST_PERIODS * dt + _ROUND_OFF, (config.stale_after, config.stop_after)
        self._stale_after = np.inf if stale is None else max(stale + _ROUND_OFF, least)
        self._stop_after = np.inf if stop is None else max(stop + _ROUND_OFF, least)
        self._moving = [i for i, obstacle in enumerate(obstacles) if obstacle.moves]
        self._trajectories = TrajectoryBatch({i: obstacles[i].motion for i in self._moving})
        self._now, pieces = 0.0, self._trajectories.pieces
        self._measured = MeasuredStates(pieces, len(obstacles), dt, self._stale_after + latency)
        x = self._measured.arrays
        self.current = ObstacleStates(np.array(self._moving, np.intp), x.states, x.margin, {})
        """States in the last step, `latency` after it; the next one overwrites them."""
        self._uncertainty = x.uncertainty
        self._uncertainty[:] = x.margin[:] = [obstacle.uncertainty for obstacle in obstacles]
        for state, obstacle in zip(self.current.states, obstacles, strict=True):
            state[:] = obstacle.motion.sample(0.0).row
        self._placed: set[int] = set()  # numbers of those that are, or were, attached to the robot
        self.moving: IntArray = self.current.which
        """(k,) numbers of those on a trajectory or external; no attached object is among them."""
        self.on_trajectories: IntArray = self.current.which
        """(k,) numbers of those on a trajectory that are not external."""
        self._reader = UpdateReader(obstacles, self._measured, dt)
        self._prediction: Prediction | None = None
        self.external: IntArray = np.zeros(0, dtype=np.intp)
        """(k,) numbers of those that a program gives."""
        self._awaited = {i for i, obstacle in enumerate(obstacles) if obstacle.external}  # external, never given
        self._known: IntArray | None = None  # the last `which` of an update, all of which are known
        self.index = self._reader.index
        """Number of an obstacle by name; raises UnknownName."""

    def warm_up(self) -> None:
        """Load the kernels that few steps need."""
        none = NO_UPDATE.which
        kernels.check_states(self.current.states, none, none, FARTHEST, FASTEST)
        extrapolate(self.current.states[:0], 0.0)
        self._trajectories.sample(self._now, self.current.states.copy())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the obstacles, in the order of the scene."""
        return self._reader.names

    @property
    def now(self) -> float:
        """Time of the states in the last step [s]."""
        return self._now

    @property
    def custom_trajectories(self) -> Mapping[int, Motion]:
        """Trajectories of other classes, which kernels cannot sample, by number of the obstacle."""
        return self._trajectories.others

    @property
    def is_foreseen(self) -> bool:
        """Whether every obstacle rests, or is on a trajectory that kernels sample."""
        return not (self._measured.known or self._awaited or self._trajectories.others)

    @property
    def packed(self) -> Any:
        """Memory of the states, in the form that kernels take."""
        return self._measured.packed

    @property
    def prediction(self) -> Prediction:
        """What is known of the obstacles in the last step, as far as the future follows from it; nothing changes it."""
        if self._prediction is None:
            now, external = self.current, self.external
            twists, turns = self.twists, self.turns
            if len(external):
                twists, turns = twists.copy(), turns.copy()
            states, margin = now.states.copy(), now.margin.copy()
            self._prediction = Prediction(
                self._trajectories.pieces, now.which, states, margin, external, twists, turns, self._now
            )
        return self._prediction

    @property
    def twists(self) -> Array:
        """(o, 6) twists with which external obstacles are predicted; zero of all others."""
        return self._measured.arrays.twists

    @property
    def turns(self) -> Array:
        """(o, 3) rates at which their linear velocities turn [rad/s]."""
        return self._measured.arrays.turns

    def at(self, t: float, prediction: Prediction | None = None) -> ObstacleStates:
        """Return the states at t [s]: on trajectories, or on lines and arcs; of the last step, as observed.

        Those of the last step are overwritten by the next one.

        Args:
            t: time [s].
            prediction: of an earlier step; of the last one if left out.
        """
        if prediction is None and (t == self._now or not len(self.moving)):
            return self.current
        known = prediction or self.prediction
        states = np.empty_like(known.states)
        kernels.predict(known, t, states)
        for index, motion in self._trajectories.others.items():
            if index not in known.external:
                states[index] = motion.sample(t).row
        return ObstacleStates(known.which, states, known.margin, self.current.voxels)

    def after(self, duration: float) -> ObstacleStates:
        """Return the states some time after the last step [s], at the twists that obstacles have in it."""
        states = self.current.states.copy()
        extrapolate(states, duration)
        return self.current._replace(states=states)

    def widen(self, which: Sequence[int], margin: float) -> None:
        """Take some obstacles for farther from where they are seen from the next step on, by a margin more [m]."""
        for index in which:
            self._uncertainty[index] = self._obstacles[index].uncertainty + margin

    def put(self, index: int, name: str, present: bool) -> None:
        """Take over what the scene has in a spare slot now.

        Args:
            index: number of the slot.
            name: of what was there before, if anything was.
            present: whether there is an obstacle now.
        """
        obstacle = self._obstacles[index]
        self._reader.rename(index, name, obstacle.name)
        self._measured.forget(index)
        self._measured.arrays.last[index] = self.current.states[index] = obstacle.motion.sample(self._now).row
        self._uncertainty[index] = self.current.margin[index] = obstacle.uncertainty
        for numbers, member in ((self._placed, present), (self._awaited, obstacle.external)):
            (numbers.add if member else numbers.discard)(index)
        self._follow([i for i in self._moving if i != index] + [index] * obstacle.moves)
        self._renew()

    def _follow(self, numbers: list[int]) -> None:
        """Let some obstacles follow their trajectories, and no others."""
        if numbers != self._moving:
            self._moving = numbers
            self._trajectories = TrajectoryBatch({i: self._obstacles[i].motion for i in numbers})
            self._measured.follow(self._trajectories.pieces)

    def attach(self, index: int) -> None:
        """Take an obstacle as attached to the robot: updates of it are ignored."""
        self._follow([i for i in self._moving if i != index])  # it leaves its trajectory for good
        self._measured.forget(index)
        self._awaited.discard(index)
        self._placed.add(index)
        self._reader.attach(index, True)
        self.current.states[index, 12:], self.current.margin[index] = 0.0, self._uncertainty[index]
        self._renew()

    def release(self, index: int, sample: Sample) -> None:
        """Take an attached obstacle as at rest at a sample, until it is given again."""
        self._reader.attach(index, False)
        self.current.states[index] = sample.row
        self._renew()

    def pose(self, index: int) -> Sample:
        """Return the world pose of an obstacle in the last step; of an attached one, where it was attached."""
        sample = Sample.of_row(self.current.states[index])
        return Sample.at(sample.position, sample.rotation)

    def reset(self) -> None:
        """Forget what was given."""
        for index in list(self._measured.known):
            self._measured.forget(index)
        external = {i for i, obstacle in enumerate(self._obstacles) if obstacle.external}
        self._awaited = external - self._reader.attached
        self._renew()

    def _renew(self) -> None:
        """Lay out the numbers of the obstacles that move."""
        self._prediction, self._known = None, None
        self.external = np.array(list(self._measured.known), dtype=np.intp)
        self.on_trajectories = np.array([i for i in self._moving if i not in self._measured.known], dtype=np.intp)
        moving = {*self._moving, *self._measured.known}
        self.moving = np.array(sorted(moving), dtype=np.intp)
        self.current = self.current._replace(which=np.array(sorted(moving | self._placed), dtype=np.intp))

    def read(self, t: float, updates: Any, shift: float = 0.0) -> StepUpdate | None:
        """Check what a step is given; estimates stay as they are.

        Args:
            t: time of the step [s].
            updates: what the program gives, by name, or as one array. What cannot be true counts as not given.
            shift: by how much the clock was set back [s].

        Returns:
            None where there is nothing to know of any obstacle.

        Raises:
            UnknownName: there is no such obstacle.
            NumericalError: an entry of the wrong shape, or not made of numbers; a trajectory of another class gives
                what cannot be true.
        """
        if updates is not None and type(updates) is not dict and not isinstance(updates, Mapping):
            given = self._reader.read_array(t, self.names, updates)
        elif updates:
            given = self._reader.read(t, updates, shift)
        elif self._moving or self._measured.known or self._awaited:
            given = NO_UPDATE
        else:
            return None
        sampled = self._sample_custom(t, given.which.tolist()) if self._trajectories.others else ()
        return StepUpdate(t, shift, given, sampled)

    @property
    def follows_trajectories(self) -> bool:
        """Whether obstacles move, and all of them by trajectories that kernels sample."""
        return bool(self._moving) and self.is_foreseen

    def load(self, query: DistanceQuery) -> None:
        """Load the code of `follow`: no control step waits for it."""
        self._measured.load(query.packed)

    def follow(self, t: float, query: DistanceQuery) -> None:
        """Bring obstacles that follow their trajectories to a step at t [s], and place them, in one compiled call."""
        self._now, self._prediction = t, None
        query.is_moving = self._measured.follow_trajectories(t, self.current.which, query.packed)

    def _sample_custom(self, t: float, given: Sequence[int]) -> list[tuple[int, Sample]]:
        """Sample the trajectories of other classes at t [s], but for obstacles that are given.

        Raises:
            NumericalError: one gives what cannot be true; names the obstacle.
        """
        sampled = []
        for index, motion in self._trajectories.others.items():
            if index in self._moving and index not in self._measured.known and index not in given:
                sample = motion.sample(t + self._latency)
                state = sample.row[None].copy()
                code = int(kernels.check_states(state, _FIRST, _SAMPLED, FARTHEST, FASTEST)[0][0])
                if code > NORMALISED:
                    fault = f"{FAULTS[code]} in its pose or twist" if code == NOT_FINITE else FAULTS[code]
                    raise NumericalError(f"obstacle {self._obstacles[index].name!r}: {fault}")
                sampled.append((index, Sample.of_row(state[0])))
        return sampled

    def advance(self, update: StepUpdate | None) -> Observation:
        """Take over what a step is given; return what there is to say of all obstacles."""
        if update is None:
            return NOTHING
        t, shift, given, sampled = update
        self._now, self._prediction, measured, which = t + self._latency, None, self._measured, given.which
        if shift:
            measured.arrays.stamps[:] += shift
        for index, sample in sampled:
            self.current.states[index] = sample.row
        if given.unusable or self._awaited:
            self._begin([i for i in (*given.unusable, *self._awaited) if i not in measured.known], t)
        if which is not self._known and len(which):
            self._awaited.difference_update(which.tolist())
            if not measured.known.keys() >= set(which.tolist()):
                measured.known |= dict.fromkeys(which.tolist())
                self._renew()
            self._known = which
        rejected, stale = measured.observe(self._now, which, given.kind, given.stamps, self.external)
        notes, stop = given.notes + given.estimated, tuple[Reason, ...]()
        if rejected:
            notes = given.notes + self._reject(given)
        if given.voxels:
            self.current.voxels.update(given.voxels)
        if stale or self._awaited:
            assumptions, stop = self._overdue(t)
            notes += assumptions
        return Observation(notes, stop) if notes or stop else NOTHING

    def _reject(self, update: Update) -> tuple[Reason, ...]:
        """Say which updates were not taken over; return what there is to say of all."""
        notes, names = [], set()
        for index in update.which[self._measured.arrays.stamps[update.which] != update.stamps].tolist():
            names.add(self._obstacles[index].name)
            notes.append(unlikely(self._obstacles[index].name, f"its poses are too far apart: {FAULTS[FAST]}"))
            update.voxels.pop(index, None)
        return (*notes, *[reason for reason in update.estimated if reason.subject[0] not in names])

    def _begin(self, which: Sequence[int], t: float) -> None:
        """Take external obstacles without any usable update to be where their motion has them."""
        for index in which:
            self._measured.begin(index, t, self._obstacles[index].motion.sample(t))
        if which:
            self._renew()

    def _overdue(self, t: float) -> tuple[tuple[Reason, ...], tuple[Reason, ...]]:
        """Return assumptions of obstacles that are not updated, and why the robot has to stop for them."""
        assumptions, stop = [], []
        for index in self._awaited:
            since = float(t - self._measured.arrays.stamps[index])
            assumptions.append(Reason.of(ReasonKind.NEVER_UPDATED, self._obstacles[index].name, amount=since, unit="s"))
        age = t - self._measured.arrays.stamps[self.external]
        stale = (age > self._stale_after) & ~self._measured.arrays.at_rest[self.external]
        for index, old in zip(self.external[stale].tolist(), age[stale].tolist(), strict=True):
            name, margin = self._obstacles[index].name, self.current.margin[index]
            kind = ReasonKind.NEVER_UPDATED if index in self._awaited else ReasonKind.STALE
            if kind is ReasonKind.STALE:
                detail = f"margin {1e3 * margin:.0f} mm"
                assumptions.append(Reason.of(kind, name, amount=old, unit="s", detail=detail))
            if old > self._stop_after:
                stop.append(Reason.of(kind, name, amount=old, unit="s", severity=Severity.ALARM))
        return tuple(assumptions), tuple(stop)
