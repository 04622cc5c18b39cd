"""Targets of the tasks in a step: as a program gives them, checked, or from the motions of the tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from qpavoid import kernels
from qpavoid.control.inputs import FARTHEST, FASTEST, FAULTS
from qpavoid.control.poses import is_sample_of_arrays
from qpavoid.control.tasks import RowTask
from qpavoid.control.trajectories import STATE, as_samples, put
from qpavoid.errors import ConfigError, NumericalError, UnknownName, nearest
from qpavoid.kernels.obstacles import FINE, NORMALISED, SAMPLE
from qpavoid.model.trajectory import Sample, Still
from qpavoid.problem import Array
from qpavoid.reason import Reason, ReasonKind


class TargetReader:
    """Reads the targets of a step into the memory of the frame tasks."""

    def __init__(self, tasks: Sequence[RowTask], frames: Array) -> None:
        """Lay out memory for some tasks.

        Args:
            tasks: frame tasks, then all others.
            frames: (f, 18) states that the rows of the frame tasks are made of; every `read` overwrites them.

        Raises:
            ConfigError: two tasks have the same name.
        """
        self._tasks = {task.settings.label: task for task in tasks}
        if len(self._tasks) < len(tasks):
            raise ConfigError(f"tasks: two have the same name among {', '.join(self._tasks)}; give one a `name`")
        self._names, self._list = list(self._tasks), list(tasks)
        self._frames, self._others = frames, np.zeros((len(tasks) - len(frames), STATE))
        self._motions: list[Any] = [task.motion for task in tasks]
        self._views = [*as_samples(self._frames), *as_samples(self._others)]
        self._frame_views = self._views[: len(frames)]
        self._still = all(
            type(motion) is Still and not any(part.flags.writeable for part in motion.pose[:4])
            for motion in self._motions[: len(frames)]
        )
        self._written = False  # whether the frames are the poses of motions that never change
        self._named_views = [*zip(self._names, self._frame_views, strict=False)]
        every = np.arange(max(len(frames), len(self._others)))
        self._every, self._kind = every, np.full(len(every), SAMPLE)
        self._codes, self._off = np.zeros(len(every), dtype=np.intp), np.zeros(len(every))
        self.read(0.0, None)
        self._check(self._frames, self._every[: len(frames)])
        kernels.are_fine(self._frames, FARTHEST, FASTEST)

    def read(
        self, t: float, targets: Mapping[str, Any] | None
    ) -> tuple[Sequence[Any], tuple[Reason, ...], tuple[Reason, ...]]:
        """Return the targets of all tasks, what is wrong with those that are given, and what was normalised in them.

        Args:
            t: time of the step [s].
            targets: what the program gives, by name of the task. What cannot be true counts as not given.

        Raises:
            UnknownName: there is no such task.
            NumericalError: a target of the wrong shape, or not made of numbers.
        """
        if targets is not None and type(targets) is not dict and not isinstance(targets, Mapping):
            raise NumericalError(f"targets: give a mapping of names to targets, not {targets!r:.60}")
        count = len(self._frames)
        if not targets:
            samples = [motion.sample(t) for motion in self._motions]
            if not (self._still and self._written):
                for view, sample in zip(self._frame_views, samples):  # noqa: B905 (strict costs as much as the copying)
                    view[0][:], view[1][:], view[2][:], view[3][:] = sample[:4]
                self._written = True
            return samples, (), ()
        self._written = False
        if len(targets) == count == len(self._list) and self._write(targets):
            return [targets[name] for name in self._names], (), ()
        samples, given, other, faults = [], list[int](), list[int](), list[Reason]()
        known = 0
        for row, (name, task) in enumerate(self._tasks.items()):
            sample = None
            if name in targets:
                known += 1
                try:
                    sample = task.as_target(targets[name])
                except NumericalError as error:
                    raise NumericalError(f"target {name!r}: {error}") from None
                if row < count:
                    given.append(row)
                elif isinstance(sample, Sample):
                    other.append(row - count)
                    put(self._views[row], sample)
                elif fault := task.fault(sample):
                    faults.append(_implausible(name, fault))
                    sample = None
            if sample is None:
                sample = task.motion.sample(t)
            if row < count:
                put(self._views[row], sample)
            samples.append(sample)
        if known < len(targets):
            name = next(name for name in targets if name not in self._tasks)
            raise UnknownName(f"no target {name!r:.60}{nearest(str(name), self._tasks)}")
        normalised: list[Reason] = []
        for states, rows, first in ((self._frames, given, 0), (self._others, other, count)):
            if rows:
                which = self._every[: len(rows)] if len(rows) == len(states) else np.array(rows)
                if self._check(states, which):
                    self._mend(t, samples, [first + row for row in rows], faults, normalised)
        return samples, tuple(faults), tuple(normalised)

    def _write(self, targets: Mapping[str, Any]) -> bool:
        """Write samples that are fine as they are, of all tasks, which are frames; False where there is any other."""
        for name, view in self._named_views:
            sample = targets.get(name)
            if type(sample) is not Sample or not is_sample_of_arrays(sample):
                return False
            view[0][:], view[1][:], view[2][:], view[3][:] = sample[:4]
        return bool(kernels.are_fine(self._frames, FARTHEST, FASTEST))

    def _check(self, states: Array, rows: Any) -> int:
        k = len(rows)
        return int(
            kernels.count_faults(states, rows, self._kind[:k], FARTHEST, FASTEST, self._codes[:k], self._off[:k])
        )

    def _mend(
        self, t: float, samples: list[Any], rows: list[int], faults: list[Reason], normalised: list[Reason]
    ) -> None:
        """Replace what cannot be true by the task's motion, and rotations that are nearly ones by these."""
        for k in np.flatnonzero(self._codes[: len(rows)] != FINE).tolist():
            row, code = rows[k], int(self._codes[k])
            name, view = self._names[row], self._views[row]
            if code == NORMALISED:
                samples[row] = samples[row]._replace(rotation=view.rotation.copy())
                normalised.append(
                    Reason.of(ReasonKind.NORMALISED, "target", name, amount=float(self._off[k]), unit="-")
                )
            else:
                samples[row] = self._list[row].motion.sample(t)
                put(view, samples[row])
                faults.append(_implausible(name, FAULTS[code]))


def _implausible(target: str, detail: str) -> Reason:
    return Reason.of(ReasonKind.IMPLAUSIBLE, "target", target, detail=detail)
