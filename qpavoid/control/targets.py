"""Targets of the tasks in a step: as a program gives them, checked, or from the motions of the tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from qpavoid import kernels
from qpavoid.control.inputs import FAULTS
from qpavoid.control.tasks import RowTask
from qpavoid.control.trajectories import extrapolate
from qpavoid.errors import ConfigError, NumericalError, UnknownName, nearest
from qpavoid.kernels.obstacles import FARTHEST, FASTEST, FINE, NORMALISED, SAMPLE
from qpavoid.model.sample import Sample, as_sample
from qpavoid.model.trajectory import Trajectory
from qpavoid.problem import Array
from qpavoid.reason import Reason, ReasonKind

_ONE, _AS_SAMPLE = np.zeros(1, dtype=np.intp), np.full(1, SAMPLE)


Targets = tuple[Sequence[Any], tuple[Reason, ...], tuple[Reason, ...]]
"""What each task should reach, in the order of the tasks; what is wrong with what is given, and what was normalised."""


class TargetReader:
    """Reads the targets of a step into the memory of the frame tasks."""

    def __init__(self, tasks: Sequence[RowTask], frames: Array, latency: float = 0.0) -> None:
        """Lay out memory for some tasks.

        Args:
            tasks: frame tasks, then all others.
            frames: (f, 18) states that the rows of the frame tasks are made of; every `read` overwrites them.
            latency: time from a step to that for which it needs the targets [s].

        Raises:
            ConfigError: two tasks have the same name.
        """
        self._tasks = {task.settings.label: task for task in tasks}
        if len(self._tasks) < len(tasks):
            raise ConfigError(f"tasks: two have the same name among {', '.join(self._tasks)}; give one a `name`")
        self._names, self._frames, self._latency = list(self._tasks), frames, latency
        self._named_rows = list(zip(self._names, frames, strict=False))
        self._motions: list[Any] = [task.motion for task in tasks]
        self._is_still = all(type(motion) is Trajectory and motion.is_still for motion in self._motions[: len(frames)])
        self.last: Sequence[Any] = ()
        """Targets of all tasks in the step before; none before the first one."""
        self._is_written = False  # whether the frames are the poses of motions that never change
        self._all_samples = np.arange(len(frames)), np.full(len(frames), SAMPLE)
        self._check = kernels.direct(kernels.check_states, frames.copy(), *self._all_samples, FARTHEST, FASTEST)
        self.read(0.0, None)
        self._takes_samples = not latency and len(tasks) == len(frames)
        """Whether there are only frames, whose samples count as they are given."""

    @property
    def are_given(self) -> bool:
        """Whether the program gave any in the last step."""
        return not self._is_written

    def read(self, t: float, targets: Mapping[str, Any] | None) -> Targets:
        """Return the targets of all tasks.

        Args:
            t: time of the step [s].
            targets: what the program gives, by name of the task. What cannot be true counts as not given.

        Raises:
            UnknownName: there is no such task.
            NumericalError: a target of the wrong shape, or not made of numbers.
        """
        if targets is not None and type(targets) is not dict and not isinstance(targets, Mapping):
            raise NumericalError(f"targets: give a mapping of names to targets, not {targets!r:.60}")
        if (samples := self.usual(t, targets or None)) is None or (targets and not self._are_fine()):
            return self._read_each(t, targets or {})
        return samples, (), ()

    def usual(self, t: float, targets: Any) -> Sequence[Any] | None:
        """Return the targets of all tasks, not checked, where none or a `Sample` of each frame is given; else None."""
        if targets is None:
            samples = [motion.sample(t + self._latency) for motion in self._motions]
            if not (self._is_still and self._is_written):
                self._write(samples)
                self._is_written = True
            return samples
        self._is_written = False
        if type(targets) is not dict or not self._takes_samples or len(targets) != len(self._named_rows):
            return None
        samples = []
        for name, row in self._named_rows:
            sample = targets.get(name)
            if type(sample) is not Sample:
                return None
            row[:] = sample.row
            samples.append(sample)
        return samples

    def _are_fine(self) -> bool:
        """Return whether the states of the frame tasks can be true, and need not be normalised."""
        return not self._check(self._frames, *self._all_samples, FARTHEST, FASTEST)[0].any()

    def _placed(self, task: RowTask, value: Any) -> Any:
        """Return a target as it is, or the pose that it stands for, of a task whose target is somewhere.

        A position alone leaves the orientation as it was in the step before, at first as the motion has it.
        """
        index = self._names.index(task.settings.label)
        last = self.last[index] if len(self.last) else self._motions[index].sample(0.0)
        if not isinstance(last, Sample):
            return value
        return as_sample(value, last.rotation if task.moves else None)

    def _write(self, samples: Sequence[Any]) -> None:
        """Write the states of the frame tasks."""
        for (_, row), sample in zip(self._named_rows, samples, strict=False):
            row[:] = sample.row

    def _read_each(self, t: float, targets: Mapping[str, Any]) -> Targets:
        """Check targets one by one: of several kinds, not of all tasks, or with numbers that cannot be true."""
        samples, faults, normalised = list[Any](), list[Reason](), list[Reason]()
        for name, task in self._tasks.items():
            sample = None
            if name in targets:
                try:
                    sample = task.as_target(self._placed(task, targets[name]))
                except NumericalError as error:
                    raise NumericalError(f"target {name!r}: {error}") from None
                sample, reason = _checked(name, task, sample)
                if reason is not None:
                    (normalised if reason.kind is ReasonKind.NORMALISED else faults).append(reason)
                if self._latency and isinstance(sample, Sample):
                    state = sample.row[None].copy()
                    extrapolate(state, self._latency)
                    sample = Sample.of_row(state[0])
            samples.append(task.motion.sample(t + self._latency) if sample is None else sample)
        if unknown := [name for name in targets if name not in self._tasks]:
            raise UnknownName(f"no target {unknown[0]!r:.60}{nearest(str(unknown[0]), self._tasks)}")
        self._write(samples)
        return samples, tuple(faults), tuple(normalised)


def _checked(name: str, task: RowTask, target: Any) -> tuple[Any, Reason | None]:
    """Return a target, None where it cannot be true, and what is wrong with it or was normalised in it."""
    if not isinstance(target, Sample):
        fault = task.fault(target)
        return (None, _implausible(name, fault)) if fault else (target, None)
    state = target.row[None].copy()
    codes, off = kernels.check_states(state, _ONE, _AS_SAMPLE, FARTHEST, FASTEST)
    code = int(codes[0])
    if code == FINE:
        return target, None
    if code == NORMALISED:
        sample = Sample.of_row(state[0], target.t, target.at_rest)
        return sample, Reason.of(ReasonKind.NORMALISED, "target", name, amount=float(off[0]), unit="-")
    return None, _implausible(name, FAULTS[code])


def _implausible(target: str, detail: str) -> Reason:
    return Reason.of(ReasonKind.IMPLAUSIBLE, "target", target, detail=detail)
