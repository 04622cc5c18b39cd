"""Ways to drive one QP: rows and limits are met in each, so that a drive is a wish and never a risk.

Control steps and forecasts use the same code, so that a forecast is of what steps will do.
"""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.config import Planning
from qpavoid.control.assembler import RowAssembler
from qpavoid.control.builder import StepProblem
from qpavoid.planning.path import Path
from qpavoid.problem import Array, Solution
from qpavoid.safety.arbiter import Arbiter

_MARGIN = 0.5e-3
"""Added to the safety distance by plain velocity dampers [m]: at the safety distance itself, round-off is below it."""
_ROW_GAIN = 15.0
"""ξ of the rows while a path is followed [1/s]: it was checked, so rows need not slow it down early."""
_GAIN = 8.0
"""Feedback on the distance from the path [1/s]."""
_MAX_ERROR = 0.2
"""Distance of a joint from its place on the path at which the place waits for it [rad or m]."""
_FULL_PACE = 1.5
"""Pace without any distance, of which 1 is used [-]: a third of the largest distance costs no time."""
_AT_END = 0.01
"""Distance of the joints from the end of a path at which it has been followed [rad or m]."""
_AT_REST = 0.03
"""Largest velocity of a joint at which the robot rests [rad/s or m/s]."""
_REST_AT_END = 0.1
"""Time at rest after which a path has been followed, once its place is at the end [s]."""


class Mode(Enum):
    """What a drive asks of the QP."""

    TRACK = "track"
    """The tasks, as without planning."""
    FAST = "fast"
    """The tasks with more feedback, and rows that let pairs close faster."""
    FOLLOW = "follow"
    """A path, with rows that let pairs close faster; then the tasks."""


class Drive(NamedTuple):
    """What is followed from some time on, and why."""

    mode: Mode = Mode.TRACK
    reason: str = ""
    """Why it began, in a sentence."""
    path: Path | None = None
    is_timed: bool = False
    """Whether the path is clear at its times alone, so that it is not followed slower."""
    place: float = 0.0
    """Time on the path of what is followed now [s]."""
    rest: float = 0.0
    """Time for which the robot has been at rest on it, about [s]."""


TRACK = Drive()
"""The drive of a controller that plans nothing."""


class Driver:
    """Drives the QP of one controller."""

    def __init__(self, rows: RowAssembler, arbiter: Arbiter, config: Planning, model: Any, dt: float) -> None:
        """Lay out the forms of the rows; the first drive is `TRACK`."""
        self._rows, self._arbiter, self._model, self._dt = rows, arbiter, model, dt
        self._stalled_after = config.stalled_after
        self._forms = {Mode.TRACK: 0, Mode.FOLLOW: rows.add_dampers(_ROW_GAIN, _MARGIN)}
        if config.fast is not None:
            self._forms[Mode.FAST] = rows.add_dampers(config.fast.row_gain, _MARGIN, config.fast.gain)
        self.drive = TRACK
        """What is followed now."""

    def begin(self, drive: Drive) -> None:
        """Follow another drive from the next step on."""
        self._rows.use_form(self._forms[drive.mode])
        self.drive = drive

    def decide(self, step: StepProblem) -> Solution:
        """Return the solution of a step that was built since the drive began."""
        path = self.drive.path
        if path is None:
            return self._arbiter.decide(step.q, step.t, step.is_settled, True)
        error, velocity = self._lag(path, step.q)
        largest = float(np.abs(error).max())
        pace = 1.0 if self.drive.is_timed else min(max(_FULL_PACE * (1.0 - largest / _MAX_ERROR), 0.0), 1.0)
        is_settled = self._rows.follow(pace * velocity + _GAIN * error)
        solution = self._arbiter.decide(step.q, step.t, is_settled, False)
        self._advance(path, pace, solution.v, step.q)
        return solution

    def _lag(self, path: Path, q: Array) -> tuple[Array, Array]:
        """Return how far the joints are from their place on a path (nv,), and the path's velocity there (nv,)."""
        place, t = self.drive.place, path.t
        k = min(max(int(np.searchsorted(t, place, side="right")) - 1, 0), len(t) - 2)
        leg, duration = path.coordinates[k + 1] - path.coordinates[k], max(float(t[k + 1] - t[k]), self._dt)
        part = min(max((place - float(t[k])) / duration, 0.0), 1.0)
        near, on_leg = (k, part) if part < 0.5 else (k + 1, part - 1.0)
        error = np.asarray(pin.difference(self._model, q, path.q[near])) + on_leg * leg
        return error, leg / duration if place < t[-1] else np.zeros_like(leg)

    def _advance(self, path: Path, pace: float, v: Array, q: Array) -> None:
        """Move the place on the path on, and end with it: at its end, or where the robot is stalled."""
        drive, dt, end = self.drive, self._dt, float(path.t[-1])
        rest = drive.rest + dt if np.abs(v).max() < _AT_REST else max(drive.rest - dt, 0.0)
        place = min(drive.place + pace * dt, end)
        is_followed = place >= end and (
            rest > _REST_AT_END or bool(np.abs(pin.difference(self._model, q, path.q[-1])).max() < _AT_END)
        )
        if is_followed or rest > self._stalled_after:
            self.begin(TRACK)
        else:
            self.drive = drive._replace(place=place, rest=rest)
