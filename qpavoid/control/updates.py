"""Updates of obstacles that a step is given, checked before anything is changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.config import PointCloud
from qpavoid.control.estimates import MeasuredStates
from qpavoid.control.inputs import FARTHEST, FASTEST, FAULTS, as_time
from qpavoid.control.trajectories import extrapolate
from qpavoid.errors import NumericalError, UnknownName, nearest
from qpavoid.kernels.obstacles import FINE, NORMALISED, POSE, REST, SAMPLE
from qpavoid.model.cloud import Points, Voxels
from qpavoid.model.sample import Pose, Sample, as_sample
from qpavoid.model.scene import Obstacle
from qpavoid.problem import Array, IntArray
from qpavoid.reason import Reason, ReasonKind, Severity

_FLAGS = {bool, np.bool_}
_KNOWN = {Sample, Pose, Points}


class Update(NamedTuple):
    """Usable updates of a step, of k obstacles; none of them is taken over yet."""

    which: IntArray
    """(k,) numbers of the obstacles."""
    kind: IntArray
    """(k,) SAMPLE, POSE or REST."""
    stamps: Array
    """(k,) their time stamps [s]."""
    voxels: dict[int, Voxels]
    """Of point clouds that are updated, by number: what is in them now."""
    unusable: tuple[int, ...]
    """Numbers of those of which there is an update that cannot be used."""
    notes: tuple[Reason, ...]
    estimated: tuple[Reason, ...]
    """Of bare poses: that their twists are estimated."""


NO_UPDATE = Update(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp), np.zeros(0), {}, (), (), ())


class _Selection(NamedTuple):
    """Arrays for updates of the same k obstacles, all samples or all bare poses."""

    names: list[str]
    type: type
    which: IntArray
    kind: IntArray
    estimated: tuple[Reason, ...]
    codes: IntArray
    off: Array


class _Batch(NamedTuple):
    """Samples, or bare poses, of k obstacles, as a step is given them."""

    names: Sequence[str]
    samples: Sequence[Any]
    which: IntArray
    kind: IntArray


class UpdateReader:
    """Reads what a program gives of obstacles; keeps arrays for the obstacles that were given last."""

    def __init__(self, obstacles: Sequence[Obstacle], measured: MeasuredStates, dt: float) -> None:
        """Read updates into `measured.updates`; dt is the control period [s]."""
        self._obstacles, self._measured, self._dt = obstacles, measured, dt
        self._index = {obstacle.name: i for i, obstacle in enumerate(obstacles) if obstacle.name}
        self.attached: set[int] = set()
        """Numbers of the obstacles that the robot carries, whose updates are ignored."""
        self._estimated = [Reason.of(ReasonKind.ESTIMATED, obstacle.name) for obstacle in obstacles]
        self._selection: _Selection | None = None

    def index(self, name: str) -> int:
        """Return the number of an obstacle.

        Raises:
            UnknownName: there is none of that name.
        """
        if not isinstance(name, str) or name not in self._index:
            raise UnknownName(f"no obstacle {name!r:.60}{nearest(str(name), self._index)}")
        return self._index[name]

    def rename(self, index: int, name: str, new_name: str) -> None:
        """Know obstacle number `index` by another name, or by none where that is empty."""
        self._index.pop(name, None)
        if new_name:
            self._index[new_name] = index
        self._estimated[index] = Reason.of(ReasonKind.ESTIMATED, new_name)
        self._selection = None

    def attach(self, index: int, attached: bool) -> None:
        """Ignore updates of obstacle number `index`, or read them again."""
        (self.attached.add if attached else self.attached.discard)(index)
        self._selection = None

    def read(self, t: float, updates: Mapping[str, Any], shift: float) -> Update:
        """Check the updates of a step.

        Args:
            t: time of the step [s].
            updates: what the program gives, by name; at least one.
            shift: by how much the clock was set back [s].

        Raises:
            UnknownName: there is no such obstacle.
            NumericalError: an entry of the wrong shape, or not made of numbers.
        """
        names, samples = list(updates), list(updates.values())
        selection = self._selection
        types = set(map(type, samples))
        if not types <= _KNOWN:
            samples = [self._placed(name, value, t) for name, value in updates.items()]
            types, updates = set(map(type, samples)), dict(zip(names, samples, strict=True))
        if selection is None or selection.names != names or types != {selection.type}:
            numbers = [self.index(name) for name in names]
            plain = len(types) == 1 and types <= {Sample, Pose} and self.attached.isdisjoint(numbers)
            self._selection = selection = self._select(names, next(iter(types)), numbers) if plain else None
        if selection is not None:
            return self._check(t, shift, _Batch(names, samples, selection.which, selection.kind), selection)
        return self._read_each(t, shift, updates)

    def _placed(self, name: str, value: Any, t: float) -> Any:
        """Return points, a sample or a pose as it is, else the pose that it stands for.

        A position alone leaves the orientation as it was given last, or as the scene has it.
        """
        if isinstance(value, Points):
            return value
        index = self.index(name)
        known, motion = index in self._measured.known, self._obstacles[index].motion
        last = Sample.of_row(self._measured.states[index]) if known else motion.sample(t)
        try:
            return as_sample(value, last.rotation)
        except NumericalError as error:
            raise NumericalError(f"obstacle {name!r}: {error}") from None

    def _select(self, names: list[str], kind: type, numbers: list[int]) -> _Selection:
        count, which = len(names), np.array(numbers, dtype=np.intp)
        estimated = tuple([self._estimated[i] for i in numbers]) if kind is Pose else ()
        kinds = np.full(count, POSE if kind is Pose else SAMPLE)
        return _Selection(names, kind, which, kinds, estimated, np.zeros(count, dtype=np.intp), np.zeros(count))

    def _read_each(self, t: float, shift: float, updates: Mapping[str, Any]) -> Update:
        """Check updates of several kinds one by one: point clouds, bare poses among samples, attached obstacles."""
        names, samples, kinds = list[str](), list[Sample](), list[int]()
        voxels, unusable, notes = dict[int, Voxels](), list[int](), list[Reason]()
        for name, value in updates.items():
            index = self.index(name)
            if index in self.attached:
                notes.append(Reason.of(ReasonKind.IGNORED, name, detail="attached to the robot"))
                continue
            if isinstance(value, Points):
                cloud, sample = self._cloud(index, value, notes), self._pose_of(index, value, t, shift)
            else:
                cloud, sample = None, value
            bare = isinstance(sample, Pose)
            sample = sample.as_sample() if bare else sample
            if isinstance(value, Points) and cloud is None:
                _flags([name], [sample])
                wrong = self._wrong_stamp(index, _stamp(name, sample, t), t, shift)
                notes += [wrong] if wrong else []
                if wrong is None or wrong.kind is not ReasonKind.IGNORED:
                    unusable.append(index)
                continue
            if cloud is not None:
                voxels[index] = cloud
            names.append(name)
            samples.append(sample)
            kinds.append(POSE if bare else SAMPLE)
        which = np.array([self._index[name] for name in names], dtype=np.intp)
        batch = _Batch(names, samples, which, np.array(kinds, dtype=np.intp))
        update = self._check(t, shift, batch, self._select(names, Sample, which.tolist()))
        fit = set(update.which.tolist())
        return update._replace(
            voxels={index: cloud for index, cloud in voxels.items() if index in fit},
            unusable=(*unusable, *update.unusable),
            notes=(*notes, *update.notes),
            estimated=tuple([self._estimated[i] for i in update.which[update.kind == POSE].tolist()]),
        )

    def _check(self, t: float, shift: float, batch: _Batch, selection: _Selection) -> Update:
        """Check samples or bare poses, all at once; `kept` has arrays for them."""
        names, samples, which, kind = batch
        if not samples:
            return NO_UPDATE
        rows, times = np.array([sample.row for sample in samples]), [sample.t for sample in samples]
        rests = [sample.at_rest for sample in samples]
        unusable, notes = list[int](), list[Reason]()
        flags = set(map(type, rests))
        if flags != {bool} or True in rests:
            kind = np.where(_flags(names, samples), REST, kind)
        if all(time is None for time in times):
            stamps = np.full(len(times), t)
        else:
            stamps = np.array([_stamp(name, sample, t) for name, sample in zip(names, samples, strict=True)])
            late = ~((stamps <= t + self._dt) & ~(stamps <= self._measured.stamps[which] + shift)) & (stamps != t)
            if late.any():
                for k in np.flatnonzero(late).tolist():
                    wrong = self._wrong_stamp(int(which[k]), float(stamps[k]), t, shift)
                    assert wrong is not None
                    notes.append(wrong)
                    if wrong.kind is not ReasonKind.IGNORED:
                        unusable.append(int(which[k]))
                which, kind, stamps = which[~late], kind[~late], stamps[~late]
                rows = rows[~late]
                selection = self._select(
                    [names[k] for k in np.flatnonzero(~late).tolist()], selection.type, which.tolist()
                )
        states = self._measured.updates
        if kernels.write_rows(states, which, rows, kind, FARTHEST, FASTEST, selection.codes, selection.off):
            bad = selection.codes > NORMALISED
            for k in np.flatnonzero(selection.codes != FINE).tolist():
                name, code = self._obstacles[which[k]].name, int(selection.codes[k])
                if bad[k]:
                    notes.append(unlikely(name, FAULTS[code]))
                    unusable.append(int(which[k]))
                else:
                    off = float(selection.off[k])
                    notes.append(Reason.of(ReasonKind.NORMALISED, name, amount=off, unit="-"))
            which, kind, stamps = which[~bad], kind[~bad], stamps[~bad]
        estimated = selection.estimated
        if estimated and (kind is not selection.kind or len(which) < len(estimated)):
            estimated = tuple([self._estimated[i] for i in which[kind == POSE].tolist()])
        return Update(which, kind, stamps, {}, tuple(unusable), tuple(notes), estimated)

    def _wrong_stamp(self, index: int, stamp: float, t: float, shift: float) -> Reason | None:
        """Return why an update with that time stamp [s] is not used; None where it is."""
        name = self._obstacles[index].name
        if stamp == t:
            return None
        if not stamp <= t + self._dt:  # neither is NaN
            return unlikely(name, f"stamped {stamp:g} s, later than the control step")
        if stamp <= self._measured.stamps[index] + shift:
            return Reason.of(ReasonKind.IGNORED, name, detail=f"stamped {stamp:g} s, not later than the one before")
        return None

    def _pose_of(self, index: int, cloud: Points, t: float, shift: float) -> Any:
        """Return the sample of a cloud's frame: as given with it, or where it is by what is known."""
        if cloud.pose is None:
            state = self._measured.states[index : index + 1].copy()
            if index in self._measured.known:
                extrapolate(state, t - shift - self._measured.stamps[index])
            else:
                state[0] = self._obstacles[index].motion.sample(t).row
            sample = Sample.of_row(state[0])
        else:
            sample = self._placed(self._obstacles[index].name, cloud.pose, t)
        return sample.stamped(sample.t if cloud.t is None else cloud.t, cloud.at_rest or sample.at_rest)

    def _cloud(self, index: int, cloud: Points, notes: list[Reason]) -> Voxels | None:
        """Return the voxels of a point cloud; None where none of its points can be used."""
        name, shape = self._obstacles[index].name, self._obstacles[index].shape
        if not isinstance(shape, PointCloud):
            raise NumericalError(f"obstacle {name!r}: points of a {shape.type}; give a Sample or a Pose")
        if isinstance(cloud.points, Voxels):
            voxels = cloud.points
            if voxels.resolution != shape.resolution:
                raise NumericalError(
                    f"obstacle {name!r}: voxels of {voxels.resolution} m, but its resolution is {shape.resolution}"
                )
        else:
            try:
                voxels = Voxels.of(cloud.points, shape.resolution)
            except NumericalError as error:
                raise NumericalError(f"obstacle {name!r}: {error}") from None
        if voxels.dropped:
            everything = voxels.dropped == voxels.given
            notes.append(
                Reason.of(
                    ReasonKind.POINTS_DROPPED,
                    name,
                    amount=voxels.dropped,
                    unit="-",
                    severity=Severity.WARNING if everything else None,
                    detail=f"of {voxels.given}: NaN, infinite or more than 100 m away",
                )
            )
            if everything:
                return None
        return voxels


def unlikely(name: str, detail: str) -> Reason:
    """Return the reason why an update of an obstacle is not used."""
    return Reason.of(ReasonKind.IMPLAUSIBLE, name, severity=Severity.WARNING, detail=detail)


def _flags(names: Sequence[str], samples: Sequence[Any]) -> list[bool]:
    """Return which of some samples or bare poses are at rest.

    Raises:
        NumericalError: that is neither true nor false, or one at rest has a velocity; names the obstacle.
    """
    for name, sample in zip(names, samples, strict=True):
        if type(sample.at_rest) not in _FLAGS:
            raise NumericalError(f"obstacle {name!r}: at_rest: {sample.at_rest!r:.60}; give true or false")
        if sample.at_rest and isinstance(sample, Sample) and (np.any(sample.linear) or np.any(sample.angular)):
            raise NumericalError(f"obstacle {name!r}: at_rest, but it has a velocity; leave one of them out")
    return [bool(sample.at_rest) for sample in samples]


def _stamp(name: str, sample: Any, t: float) -> float:
    return t if sample.t is None else as_time(f"obstacle {name!r}: t", sample.t)
