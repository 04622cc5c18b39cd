"""Updates of obstacles that a step is given, checked before anything is changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from qpavoid.control.estimates import MeasuredStates
from qpavoid.control.inputs import FAULTS
from qpavoid.control.trajectories import extrapolate
from qpavoid.control.update_parts import ignored, read_voxels, rest_flags, time_stamp, unlikely
from qpavoid.errors import NumericalError, UnknownName, nearest
from qpavoid.kernels.estimates import QUATERNION
from qpavoid.kernels.obstacles import FINE, NORMALISED, POSE, REST, SAMPLE
from qpavoid.model.cloud import Points, Voxels
from qpavoid.model.sample import POSE as POSE_SIZE
from qpavoid.model.sample import STATE, Pose, Sample, as_sample
from qpavoid.model.scene import Obstacle
from qpavoid.problem import Array, IntArray, as_numbers
from qpavoid.reason import Reason, ReasonKind


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
    """What is the same in updates of the same k obstacles, all samples, all bare poses or all rows of an array."""

    names: Sequence[str]
    form: type | int
    """Class of the samples, or number of columns of the array."""
    shape: tuple[int, int]
    """Of an array."""
    rows: IntArray | None
    """Rows of the array that count: an attached obstacle has none; None where all do."""
    update: Update
    """If all can be used, and are of the time of the step; its stamps are overwritten."""


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
        self._names: tuple[str, ...] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the obstacles, in the order of the scene: one for each row of an array."""
        if self._names is None:
            self._names = tuple([obstacle.name for obstacle in self._obstacles if obstacle.name])
        return self._names

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
        self._selection = self._names = None

    def attach(self, index: int, attached: bool) -> None:
        """Ignore updates of obstacle number `index`, or read them again."""
        (self.attached.add if attached else self.attached.discard)(index)
        self._selection = None

    def read(self, t: float, updates: Mapping[Any, Any], shift: float) -> Update:
        """Check the updates of a step.

        Args:
            t: time of the step [s].
            updates: what the program gives, by name; at least one.
            shift: by how much the clock was set back [s].

        Raises:
            UnknownName: there is no such obstacle.
            NumericalError: an entry of the wrong shape, or not made of numbers.
        """
        names = list(updates)
        if len(names) == 1 and type(names[0]) is tuple:
            return self.read_array(t, names[0], updates[names[0]])
        if self._selection is not None and self._selection.names == names:
            update = self._read_selected(t, shift, self._selection, list(updates.values()))
            if update is not None:
                return update
        if any(type(name) is tuple for name in names):
            raise NumericalError("obstacles: an array among others; give all in one array, or one by one")
        numbers = [self.index(name) for name in names]
        placed = {name: self._placed(name, value, t) for name, value in updates.items()}
        forms = set(map(type, placed.values()))
        if len(forms) == 1 and forms <= {Sample, Pose} and self.attached.isdisjoint(numbers):
            self._selection = self._select(names, forms.pop(), numbers)
            update = self._read_selected(t, shift, self._selection, list(placed.values()))
            if update is not None:
                return update
        self._selection = None
        return self._read_each(t, shift, placed)

    def _read_selected(self, t: float, shift: float, selection: _Selection, samples: Sequence[Any]) -> Update | None:
        """Check samples or bare poses of the same obstacles as last time; None where these are of another form."""
        try:  # in one piece, which takes half the time of np.array
            current = [sample.row for sample in samples if sample.t is None and sample.at_rest is False]
            are_current = len(current) == len(samples)
            rows = np.frombuffer(b"".join(current if are_current else [sample.row for sample in samples]))
        except (AttributeError, TypeError, ValueError, BufferError):
            return None
        columns = STATE if selection.form is Sample else POSE_SIZE
        if len(rows) != columns * len(samples):
            return None
        rows, update = rows.reshape(-1, columns), selection.update
        if are_current:
            update.stamps.fill(t)
            return self._check(rows, update)
        return self._check(*self._timely(t, shift, selection.names, samples, rows, update))

    def read_array(self, t: float, names: Sequence[str], value: Any) -> Update:
        """Check an array with a row for each of some obstacles, of the time t of the step [s].

        Raises:
            UnknownName: there is no such obstacle.
            NumericalError: the array has the wrong shape, or is not made of numbers; an obstacle is named twice.
        """
        selection = self._selection
        is_plain = type(value) is np.ndarray and value.dtype == np.float64 and value.flags.c_contiguous
        if is_plain and selection is not None and selection.names is names and selection.shape == value.shape:
            selection.update.stamps.fill(t)
            return self._check(value if selection.rows is None else value[selection.rows], selection.update)
        try:
            rows = value if is_plain else np.ascontiguousarray(as_numbers("obstacles", value))
        except NumericalError:
            message = f"obstacles: give a mapping of names to samples, or an array of numbers, not {value!r:.60}"
            raise NumericalError(message) from None
        if rows.ndim != 2 or len(rows) != len(names) or rows.shape[1] not in (STATE, QUATERNION):
            raise NumericalError(
                f"obstacles: an array of shape {rows.shape}; give a row of {STATE} numbers, as `Sample.row`, or of "
                f"{QUATERNION}, position and quaternion x y z w, for each of these {len(names)}: {', '.join(names):.60}"
            )
        columns = rows.shape[1]
        if selection is None or selection.form != columns or selection.names != names:
            numbers = [self.index(name) for name in names]
            if len(set(numbers)) < len(numbers):
                raise NumericalError("obstacles: an obstacle is named twice; give one row for each")
            self._selection = selection = self._select(names, columns, numbers)
        if selection.rows is not None:
            rows = rows[selection.rows]
        selection.update.stamps.fill(t)
        return self._check(rows, selection.update)

    def _placed(self, name: str, value: Any, t: float) -> Any:
        """Return points, a sample or a pose as it is, else the pose that it stands for.

        A position alone leaves the orientation as it was given last, or as the scene has it.
        """
        if isinstance(value, Points | Sample | Pose):
            return value
        index = self.index(name)
        known, motion = index in self._measured.known, self._obstacles[index].motion
        last = Sample.of_row(self._measured.arrays.last[index]) if known else motion.sample(t)
        try:
            return as_sample(value, last.rotation)
        except NumericalError as error:
            raise NumericalError(f"obstacle {name!r}: {error}") from None

    def _select(self, names: Sequence[str], form: type | int, numbers: list[int]) -> _Selection:
        """Lay out what is the same in all updates of these obstacles in that form."""
        rows = [k for k, i in enumerate(numbers) if i not in self.attached]
        which, is_bare = np.array([numbers[k] for k in rows], dtype=np.intp), form in (Pose, QUATERNION)
        notes = [ignored(name) for name, i in zip(names, numbers, strict=True) if i in self.attached]
        update = Update(
            which, np.full(len(rows), POSE if is_bare else SAMPLE), np.zeros(len(rows)), {}, (), tuple(notes),
            self._twists_estimated(which) if is_bare else (),
        )  # fmt: skip
        shape = len(names), form if isinstance(form, int) else 0
        return _Selection(names, form, shape, np.array(rows, dtype=np.intp) if notes else None, update)

    def _twists_estimated(self, which: IntArray) -> tuple[Reason, ...]:
        """Return the reasons why twists are estimated, of bare poses of some obstacles (k,)."""
        return tuple([self._estimated[i] for i in which.tolist()])

    def _read_each(self, t: float, shift: float, updates: Mapping[str, Any]) -> Update:
        """Check updates of several kinds one by one: point clouds, bare poses among samples, attached obstacles."""
        names, samples, kinds = list[str](), list[Sample](), list[int]()
        voxels, unusable, notes = dict[int, Voxels](), list[int](), list[Reason]()
        for name, value in updates.items():
            index = self.index(name)
            if index in self.attached:
                notes.append(ignored(name))
                continue
            if isinstance(value, Points):
                cloud, sample = (
                    read_voxels(name, self._obstacles[index].shape, value, notes),
                    self._pose_of(index, value, t, shift),
                )
            else:
                cloud, sample = None, value
            bare = isinstance(sample, Pose)
            sample = sample.as_sample() if bare else sample
            if isinstance(value, Points) and cloud is None:
                rest_flags([name], [sample])
                wrong = self._wrong_stamp(index, time_stamp(name, sample, t), t, shift)
                notes += [wrong] if wrong else []
                if wrong is None or wrong.kind is not ReasonKind.IGNORED:
                    unusable.append(index)
                continue
            if cloud is not None:
                voxels[index] = cloud
            names.append(name)
            samples.append(sample)
            kinds.append(POSE if bare else SAMPLE)
        if samples:
            which = np.array([self._index[name] for name in names], dtype=np.intp)
            update = NO_UPDATE._replace(which=which, kind=np.array(kinds, dtype=np.intp), stamps=np.zeros(len(names)))
            rows = np.array([sample.row for sample in samples])
            update = self._check(*self._timely(t, shift, names, samples, rows, update))
        else:
            update = NO_UPDATE
        fit = set(update.which.tolist())
        return update._replace(
            voxels={index: cloud for index, cloud in voxels.items() if index in fit},
            unusable=(*unusable, *update.unusable),
            notes=(*notes, *update.notes),
        )

    def _timely(
        self, t: float, shift: float, names: Sequence[str], samples: Sequence[Any], rows: Array, update: Update
    ) -> tuple[Array, Update]:
        """Return the rows and the update without the samples whose time stamps cannot be; and which of them rest."""
        kind = np.where(rest_flags(names, samples), REST, update.kind)
        stamps = np.array([time_stamp(name, sample, t) for name, sample in zip(names, samples, strict=True)])
        unusable, notes = list[int](), list[Reason]()
        timely = np.ones(len(stamps), dtype=bool)
        for k, (index, stamp) in enumerate(zip(update.which.tolist(), stamps.tolist(), strict=True)):
            if wrong := self._wrong_stamp(index, stamp, t, shift):
                timely[k] = False
                notes.append(wrong)
                if wrong.kind is not ReasonKind.IGNORED:
                    unusable.append(index)
        which, kind = update.which[timely], kind[timely]
        estimated = self._twists_estimated(which[kind == POSE])
        update = Update(which, kind, stamps[timely], {}, tuple(unusable), tuple(notes), estimated)
        return np.ascontiguousarray(rows[timely]), update

    def _check(self, rows: Array, update: Update) -> Update:
        """Check the rows (k, 18), (k, 12) or (k, 7) of an update; return it without those that cannot be true."""
        if not self._measured.check(update.which, rows, update.kind):
            return update
        x, which, unusable, notes = self._measured.arrays, update.which, list(update.unusable), list(update.notes)
        codes = x.codes[: len(which)]
        for k in np.flatnonzero(codes != FINE).tolist():
            name, code = self._obstacles[which[k]].name, int(codes[k])
            if code > NORMALISED:
                notes.append(unlikely(name, FAULTS[code]))
                unusable.append(int(which[k]))
            else:
                notes.append(Reason.of(ReasonKind.NORMALISED, name, amount=float(x.deviation[k]), unit="-"))
        usable = codes <= NORMALISED
        which, kind = which[usable], update.kind[usable]
        estimated = self._twists_estimated(which[kind == POSE])
        return Update(which, kind, update.stamps[usable], {}, tuple(unusable), tuple(notes), estimated)

    def _wrong_stamp(self, index: int, stamp: float, t: float, shift: float) -> Reason | None:
        """Return why an update with that time stamp [s] is not used; None where it is."""
        name = self._obstacles[index].name
        if stamp == t:
            return None
        if not stamp <= t + self._dt:  # neither is NaN
            return unlikely(name, f"stamped {stamp:g} s, later than the control step")
        if stamp <= self._measured.arrays.stamps[index] + shift:
            return Reason.of(ReasonKind.IGNORED, name, detail=f"stamped {stamp:g} s, not later than the one before")
        return None

    def _pose_of(self, index: int, cloud: Points, t: float, shift: float) -> Any:
        """Return the sample of a cloud's frame: as given with it, or where it is by what is known."""
        if cloud.pose is None:
            state = self._measured.arrays.last[index : index + 1].copy()
            if index in self._measured.known:
                extrapolate(state, t - shift - self._measured.arrays.stamps[index])
            else:
                state[0] = self._obstacles[index].motion.sample(t).row
            sample = Sample.of_row(state[0])
        else:
            sample = self._placed(self._obstacles[index].name, cloud.pose, t)
        return sample.stamped(sample.t if cloud.t is None else cloud.t, cloud.at_rest or sample.at_rest)
