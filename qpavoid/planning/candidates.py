"""Which drive to follow: those that might arrive are rolled out, and the best that does is chosen.

A path is followed through the same rows as everything else. Whether that succeeds is found out by its forecast, before
it begins. What is tried is limited by counts, not by time: the same state has the same outcome.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from qpavoid.config import Planning
from qpavoid.planning.drive import TRACK, Drive, Mode
from qpavoid.planning.forecast import Expected, Forecast, Forecaster, Snapshot
from qpavoid.planning.path import Path
from qpavoid.planning.planner import Planner
from qpavoid.problem import Array

_SLACK = 3e-3
"""Distance by which a forecast may fall below what is to be kept [m]: predictions are no better."""
_ARRIVED = 0.9
"""Part of the goal tolerance within which a forecast has arrived [-]."""
_WORTH_HURRY, _WORTH_PATH = 0.7, 0.5
"""Part of the present drive's error within which another one is worth while that does not arrive either [-]."""
_LOST = 0.05
"""Error from which on the present drive leaves its targets [m, rad]."""
_LEAVES = (-0.3, 0.0, 0.6, 1.5)
"""When paths leave, after the error is that large; and at half of that time [s]."""
_JOINS = (0.8, 1.6, 2.6)
"""When paths join the motions of the targets, after they leave; and at the end [s]."""
_LATE = 0.4
"""How much later than its target a path may get to where it joins [s]."""
_ARRIVALS = (0.4, 0.8, 1.6, 3.0)
"""Durations of paths among obstacles that move, tried in turn [s]."""
_NODES, _NODES_BETWEEN, _NODES_MOVING = 3000, 600, 800
"""Nodes of the trees of a path to the end, to a place where it joins, and among obstacles that move [-]."""
_CHECK_TIME, _STEP_TIME = 3e-6, 1.2e-4
"""What a check of the planner, and a step of a forecast, are taken to need [s]: more than on any machine measured."""
_READY = 0.05
"""Time between the end of a look and what it has decided [s]."""


class Decision(NamedTuple):
    """A drive that begins at a time."""

    t: float
    """[s]."""
    drive: Drive
    expected: Expected
    """What it leads to."""


class Outcome(NamedTuple):
    """What became of a look ahead."""

    arrives: bool
    """Whether the present drive does."""
    expected: Expected
    """What the present drive leads to."""
    decision: Decision | None = None
    """Another drive, if one is better."""


def is_sound(outcome: Outcome, model: Any) -> bool:
    """Return whether an outcome has finite numbers of the right shapes for a model, and could be followed."""
    decision = outcome.decision
    forecasts = [outcome.expected] if decision is None else [outcome.expected, decision.expected]
    path = None if decision is None else decision.drive.path
    parts: list[tuple[Array, tuple[int, ...]]] = []
    for x in forecasts:
        count = max(len(x.t), 1)
        parts += [(x.t, (count,)), (x.q, (count, model.nq)), (x.errors, (count,))]
    if path is not None:
        count = max(len(path.t), 2)
        parts += [(path.t, (count,)), (path.q, (count, model.nq)), (path.coordinates, (count, model.nv))]
    return all(array.shape == shape and isfinite(array.sum()) for array, shape in parts)


class _Candidate(NamedTuple):
    """Drive that was rolled out."""

    t: float
    drive: Drive
    forecast: Forecast
    arrives: bool
    cost: float
    """Root mean square of the error until the end [m, rad]."""


class Candidates:
    """Looks ahead from a state, and proposes another drive where the present one does not arrive."""

    def __init__(self, forecaster: Forecaster, planner: Planner | None, config: Planning) -> None:
        self._forecaster, self._planner, self._config = forecaster, planner, config

    def look(self, start: Snapshot, is_moving: bool, is_noisy: bool, seed: int) -> Outcome:
        """Return what the present drive leads to, and a better one.

        Args:
            start: state of the controller.
            is_moving: whether obstacles move whose motion is not known.
            is_noisy: whether what is known of them is too noisy for anything but the law.
            seed: of the planner.
        """
        end = self._forecaster.end_of(start)
        present = self._forecaster.run(start._replace(spread=0.0), end)
        if self._arrives(present):
            return Outcome(True, present.expected)
        if is_noisy and start.drive.mode is Mode.TRACK:
            return Outcome(False, present.expected)
        search = _Search(start, end, present, is_moving, is_noisy, seed, _STEP_TIME * len(present.t))
        better = [*self._faster(search)]
        hurried = [one for one in better if one.arrives and one.cost < 1.1 * present.rms_error]
        if self._planner is not None and not is_noisy and not (hurried and is_moving):
            better += self._paths(search, self._planner)
        ready = [one for one in better if one.t >= start.t + min(search.effort, self._config.lead) - 1e-9]
        if not ready:
            return Outcome(False, present.expected)
        best = min(ready, key=lambda one: (not one.arrives, one.cost if one.arrives else one.forecast.final_error))
        drive = best.drive._replace(reason=self._reason(best, search)) if best.drive.mode is not Mode.TRACK else TRACK
        return Outcome(False, present.expected, Decision(best.t, drive, best.forecast.expected))

    def _faster(self, search: _Search) -> Iterator[_Candidate]:
        """Roll out those of tasks with the rows of the law, and of a fast finish, that are not followed."""
        mode, step = search.start.drive.mode, search.present.step_at(search.start.t + self._config.lead)
        if step >= len(search.present.t) - 1:
            return
        if mode is not Mode.TRACK:
            yield from self._try(search, step, TRACK, _WORTH_HURRY)
        if mode is not Mode.FAST and self._config.fast is not None and not search.is_noisy:
            yield from self._try(search, step, Drive(Mode.FAST), _WORTH_HURRY)

    def _paths(self, search: _Search, planner: Planner) -> Iterator[_Candidate]:
        """Roll out paths that leave the forecast at several times, and join the motions of the targets again."""
        start, present, lead = search.start, search.present, self._config.lead
        lost = np.flatnonzero(present.errors > _LOST)
        until_lost = float(present.t[lost[0]] - start.t) if len(lost) else 0.0
        leaves = [lead]
        if not search.is_moving:
            times = [0.5 * until_lost, *[until_lost + leave for leave in _LEAVES]]
            leaves = sorted({round(max(lead, time), 2) for time in times} | {lead})
        arrived = False
        for leave in leaves:
            step = present.step_at(start.t + leave)
            if step >= len(present.t) - 5:
                return
            joins = [search.end]
            if not search.is_moving:
                joins = sorted({min(search.end, round(start.t + leave + join, 2)) for join in _JOINS} | {search.end})
            for join in joins:
                if search.effort > leave - _READY:
                    break
                path = self._plan(search, planner, step, join)
                if not path or (join < search.end and present.t[step] + path.duration > join + _LATE):
                    continue
                drive = Drive(Mode.FOLLOW, path=path, is_timed=search.is_moving)
                for candidate in self._try(search, step, drive, _WORTH_PATH):
                    arrived = arrived or candidate.arrives
                    yield candidate
                if arrived and search.effort > max(0.6 * until_lost, 0.5 * lead):
                    return

    def _plan(self, search: _Search, planner: Planner, step: int, join: float) -> Path:
        """Plan from a step of the forecast to the targets at a time [s]."""
        present, config, is_last = search.present, self._config, join >= search.end
        planner.place(self._forecaster.obstacles_at(search.start, float(present.t[step])))
        arrivals: tuple[float, ...] = ()
        clearances, nodes = config.clearances, _NODES
        if search.is_moving:
            remaining = search.end - float(present.t[step])
            arrivals = tuple(arrival for arrival in _ARRIVALS if arrival <= remaining) or (remaining,)
            clearances, nodes = clearances[1:] or clearances, _NODES_MOVING
        elif not is_last:
            clearances, nodes = clearances[:3], _NODES_BETWEEN
        targets = self._forecaster.targets_at(search.start, join)
        path = planner.plan(
            present.q[step],
            targets=targets,
            clearances=clearances,
            seed=search.seed,
            max_nodes=nodes,
            arrivals=arrivals,
        )
        search.effort += _CHECK_TIME * path.checks
        return path

    def _try(self, search: _Search, step: int, drive: Drive, worth: float) -> Iterator[_Candidate]:
        """Roll a drive out that begins in a step of the forecast; yield it if it is worth while."""
        later = self._forecaster.later(search.start, search.present, step)
        forecast = self._forecaster.run(later._replace(drive=drive), search.end)
        search.effort += _STEP_TIME * len(forecast.t)
        arrives = self._arrives(forecast)
        if arrives or (self._is_clear(forecast) and forecast.final_error < worth * search.present.final_error):
            errors = np.concatenate((search.present.errors[:step], forecast.errors))
            yield _Candidate(later.t, drive, forecast, arrives, _rms(errors))

    def _arrives(self, forecast: Forecast) -> bool:
        return forecast.final_error < _ARRIVED * self._config.goal_tolerance and self._is_clear(forecast)

    @staticmethod
    def _is_clear(forecast: Forecast) -> bool:
        return float(forecast.clearance.min()) > -_SLACK

    def _reason(self, candidate: _Candidate, search: _Search) -> str:
        """Return why a drive begins, in a sentence."""
        path, forecast = candidate.drive.path, candidate.forecast
        begin = f"fast finish since {candidate.t:.2f} s"
        if path is not None:
            begin = f"path from {candidate.t:.2f} s to about {candidate.t + path.duration:.2f} s"
        text = f"{begin}: the present drive would end {1e3 * search.present.final_error:.0f} mm from the targets"
        if search.present.stalled_at:
            text += f", stalled at {search.present.stalled_at}"
        return text if candidate.arrives else f"{text}; this one {1e3 * forecast.final_error:.0f} mm"


class _Search:
    """What is known in a look ahead."""

    def __init__(
        self, start: Snapshot, end: float, present: Forecast, is_moving: bool, is_noisy: bool, seed: int, effort: float
    ) -> None:
        self.start, self.end, self.present, self.seed = start, end, present, seed
        self.is_moving, self.is_noisy = is_moving, is_noisy
        self.effort = effort
        """Time that it is taken to have needed so far [s]."""


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))
