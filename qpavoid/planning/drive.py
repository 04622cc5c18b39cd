"""Ways to drive one QP: rows and limits are met in each, so that a drive is a wish and never a risk.

Control steps and forecasts use the same code, so that a forecast is of what steps will do.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from qpavoid.config import Planning
from qpavoid.control.assembler import RowAssembler
from qpavoid.control.builder import StepProblem
from qpavoid.problem import Solution
from qpavoid.safety.arbiter import Arbiter

_MARGIN = 0.5e-3
"""Added to the safety distance by plain velocity dampers [m]: at the safety distance itself, round-off is below it."""


class Mode(Enum):
    """What a drive asks of the QP."""

    TRACK = "track"
    """The tasks, as without planning."""
    FAST = "fast"
    """The tasks with more feedback, and rows that let pairs close faster."""


class Drive(NamedTuple):
    """What is followed from some time on, and why."""

    mode: Mode = Mode.TRACK
    reason: str = ""
    """Why it began, in a sentence."""


TRACK = Drive()
"""The drive of a controller that plans nothing."""


class Driver:
    """Drives the QP of one controller."""

    def __init__(self, rows: RowAssembler, arbiter: Arbiter, config: Planning) -> None:
        """Lay out the forms of the rows; the first drive is `TRACK`."""
        self._rows, self._arbiter = rows, arbiter
        self._forms = {Mode.TRACK: 0}
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
        return self._arbiter.decide(step.q, step.t, step.is_settled, True)
