"""Which drive to follow: those that might arrive are rolled out, and the best that does is chosen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.config import Planning
from qpavoid.planning.drive import TRACK, Drive, Mode
from qpavoid.planning.forecast import Forecast, Forecaster, Snapshot

SLACK = 3e-3
"""Distance by which a forecast may fall below what is to be kept [m]: predictions are no better."""
_ARRIVED = 0.9
"""Part of the goal tolerance within which a forecast has arrived [-]."""
_BETTER = 0.7
"""Part of the law's error within which a drive is worth while that does not arrive either [-]."""


class Decision(NamedTuple):
    """A drive that begins at a time."""

    t: float
    """[s]."""
    drive: Drive
    forecast: Forecast
    """What it leads to."""


class Outcome(NamedTuple):
    """What became of a look ahead."""

    arrives: bool
    """Whether the present drive does."""
    forecast: Forecast
    """What the present drive leads to."""
    decision: Decision | None = None
    """Another drive, if one is better."""


class Candidates:
    """Looks ahead from a state, and proposes another drive where the present one does not arrive."""

    def __init__(self, forecaster: Forecaster, config: Planning) -> None:
        self._forecaster, self._config = forecaster, config

    def look(self, start: Snapshot, may_hurry: bool) -> Outcome:
        """Return what the present drive leads to, and a better one.

        Args:
            start: state of the controller.
            may_hurry: whether a fast finish may be tried.
        """
        forecaster, end = self._forecaster, self._forecaster.end_of(start)
        present = forecaster.run(start, end)
        if self._arrives(present):
            return Outcome(True, present)
        step = present.step_at(start.t + self._config.lead)
        if step >= len(present.t) - 1:
            return Outcome(False, present)
        later = forecaster.later(start, present, step)
        better = []
        for drive in self._others(start.drive, may_hurry):
            forecast = forecaster.run(later._replace(drive=drive), end)
            if self._is_clear(forecast) and (
                self._arrives(forecast) or forecast.final_error < _BETTER * present.final_error
            ):
                better.append((forecast, drive))
        if not better:
            return Outcome(False, present)
        forecast, drive = min(better, key=lambda pair: _cost(pair[0], self._arrives(pair[0])))
        drive = self._explained(drive, later.t, present, forecast)
        return Outcome(False, present, Decision(later.t, drive, forecast))

    def _others(self, drive: Drive, may_hurry: bool) -> list[Drive]:
        if drive.mode is Mode.FAST:
            return [TRACK]
        return [Drive(Mode.FAST)] if may_hurry and self._config.fast is not None else []

    def _arrives(self, forecast: Forecast) -> bool:
        return forecast.final_error < _ARRIVED * self._config.goal_tolerance and self._is_clear(forecast)

    def _is_clear(self, forecast: Forecast) -> bool:
        return float(forecast.clearance.min()) > -SLACK

    def _explained(self, drive: Drive, t: float, present: Forecast, forecast: Forecast) -> Drive:
        """Return a drive with the reason for it."""
        if drive.mode is Mode.TRACK:
            return drive
        missing, left = 1e3 * present.final_error, 1e3 * forecast.final_error
        reason = f"fast finish since {t:.2f} s: the tasks alone would end {missing:.0f} mm from their targets"
        return drive._replace(reason=reason + (f", this {left:.0f} mm" if not self._arrives(forecast) else ""))


def _cost(forecast: Forecast, arrives: bool) -> tuple[bool, float]:
    """Return what is compared of candidates: whether they fail, then their mean or final error."""
    return not arrives, float(np.sqrt(np.mean(forecast.errors**2))) if arrives else forecast.final_error
