"""Runs the libraries in turn: one process each, one round of steps at a time, A B C A B C."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.config import Beta
from qpavoid.errors import ConfigError
from qpavoid_bench.libraries.process import LibraryError, Process
from qpavoid_bench.tick import build
from qpavoid_bench.tick.libraries import Library, Ours, start
from qpavoid_bench.tick.workloads import Array, Workload

CHECK_TICKS = list(range(0, build.TICKS, 50))
WARM_UP = 20
"""Steps before each round that are not timed."""
FRAME_TOLERANCE = 1e-9
DISTANCE_TOLERANCE = 1e-6
"""For spheres and capsules, which every library computes in closed form [m]."""
BOX_TOLERANCE = 1e-5
"""For pairs with a box, which the libraries compute by different iterative algorithms [m]."""
RATE_TOLERANCE = 2e-3
"""How much faster than its row allows a pair may close: what a difference of distances can tell [m/s]."""


@dataclass
class Cell:
    """What was measured of one library on one workload."""

    rounds: list[list[int]] = field(default_factory=list)
    """Time of each step [ns], round by round."""
    velocities: Array | None = None
    """(k, nv) its answers at the checked ticks."""
    frame_error: float = np.nan
    """Largest difference of a frame's pose to Pinocchio's [m, -]."""
    distance_error: float = np.nan
    """Largest difference of a distance to coal's, pairs without boxes [m]."""
    box_error: float = np.nan
    """The same of pairs in range with boxes [m]."""
    tracking_error: float = np.nan
    """Median distance of the frames to their targets after one step [m]."""
    refused: str = ""
    """Why it was not timed."""

    def quantile(self, percent: float) -> float:
        """Return a quantile of the steps of a round, of the round in which it is least [µs]; NaN without a round."""
        return min((1e-3 * float(np.percentile(ns, percent)) for ns in self.rounds), default=float("nan"))

    @property
    def worst(self) -> float:
        """The slowest step of all [µs]; NaN without a round."""
        return max((1e-3 * max(ns) for ns in self.rounds), default=float("nan"))


@dataclass
class Row:
    """One workload."""

    name: str
    workload: Workload | None
    """None for a closed loop of qpavoid alone."""
    in_range: float
    """Mean number of pairs in range at the checked ticks; NaN for a closed loop."""
    cells: dict[str, Cell]


@dataclass
class Results:
    """Everything for the report."""

    libraries: Sequence[Library]
    rounds: int
    ticks: int
    budget: float
    rows: list[Row] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    """By library."""
    missing: dict[str, str] = field(default_factory=dict)
    """Libraries that could not be run, and why."""
    load: tuple[float, float] = (0.0, 0.0)
    """Mean number of running processes over the minute before the start, and before the end."""


def run(workloads: Sequence[str], libraries: Sequence[Library], rounds: int, ticks: int, budget: float) -> Results:
    """Measure everything.

    Args:
        workloads: their names.
        libraries: in the order of turns.
        rounds: how often the libraries take turns.
        ticks: steps of each library in a round.
        budget: seconds that a round of one library may take: slow ones make fewer steps, spread over the same ticks.
    """
    results = Results(libraries, rounds, ticks, budget)
    previous = os.getloadavg()[0]
    processes: dict[str, Process] = {}
    try:
        for library in libraries:
            try:
                processes[library.name] = process = start(library)
                results.versions[library.name] = process.ask("versions", library.packages)
            except (LibraryError, ConfigError) as error:
                results.missing[library.name] = str(error)
                if library.name in processes:
                    processes.pop(library.name).close()
        used = [library for library in libraries if library.name in processes]
        for name in workloads:
            print(f"{name} ", end="", file=sys.stderr, flush=True)
            results.rows.append(_measure(name, used, processes, rounds, ticks, budget))
            print(file=sys.stderr)
    finally:
        for process in processes.values():
            process.close()
    results.load = (previous, os.getloadavg()[0])
    return results


def _measure(
    name: str, libraries: Sequence[Library], processes: dict[str, Process], rounds: int, ticks: int, budget: float
) -> Row:
    workload = build.build(name) if build.is_recorded(name) else None
    is_ours = workload is None or bool(workload.variant)
    libraries = [library for library in libraries if not is_ours or isinstance(library, Ours)]
    cells, pace = {library.name: Cell() for library in libraries}, dict[str, float]()
    check = _Check(workload) if workload else None
    for library in libraries:
        process = processes[library.name]
        try:
            if isinstance(library, Ours):
                process.ask("setup", workload or name)
            else:
                assert workload is not None and check is not None
                process.ask("setup", build.describe(check.scene, workload, library.options))
            process.ask("record", *((workload.q, workload.targets) if workload else ((), ())))
            if check:
                gain = library.closing_gain if isinstance(library, Ours) else None
                check.apply(cells[library.name], process.ask("check", CHECK_TICKS), gain, _tolerance(library))
            pace[library.name] = 1e-9 * float(np.median(process.ask("round", [0, 1, 2, 3, 4], 1)))
        except (LibraryError, ValueError) as error:
            cells[library.name].refused = str(error)
    for number in range(rounds):
        window = [(number * ticks + i) % build.TICKS for i in range(-WARM_UP, ticks)]
        for timed in list(pace):
            count = int(np.clip(budget / pace[timed], 3, ticks))
            chosen = window[:WARM_UP] + window[WARM_UP :: -(-ticks // count)]
            warm_up = min(WARM_UP, count // 3)
            try:
                times = processes[timed].ask("round", chosen[WARM_UP - warm_up :], warm_up)
            except LibraryError as error:
                cells[timed] = Cell(refused=f"in round {number}: {error}")
                del pace[timed]
                continue
            cells[timed].rounds.append(times)
        print(".", end="", file=sys.stderr, flush=True)
    return Row(name, workload, check.in_range if check else np.nan, cells)


def _tolerance(library: Library) -> float:
    return DISTANCE_TOLERANCE if isinstance(library, Ours) else library.distance_tolerance


class _Check:
    """Compares libraries with Pinocchio and coal on one workload."""

    def __init__(self, workload: Workload) -> None:
        self.workload, self.scene = workload, build.make_scene(workload)
        self.frames, self.distances = build.reference(self.scene, workload, workload.q[CHECK_TICKS])
        self.in_range = float((self.distances < workload.influence).sum(axis=1).mean())

    def apply(self, cell: Cell, answer: dict[str, Any], closing_gain: float | None, tolerance: float) -> None:
        """Record how far a library is off.

        Raises:
            LibraryError: it does not agree, so that its time would be that of another problem.
        """
        workload, distances, box = self.workload, self.distances, self.workload.boxes
        cell.velocities = answer["velocities"]
        cell.frame_error = float(np.abs(answer["frames"] - self.frames).max())
        reported = np.where(np.isnan(answer["distances"]), distances, answer["distances"])  # it does not tell
        error = np.abs(reported - distances)
        # far pairs do not count: iterative algorithms stop early on them
        relevant = distances < 2.0 * workload.influence
        cell.distance_error = float(np.max(error[:, ~box], initial=0.0))
        cell.box_error = float(np.max(np.where(relevant, error, 0.0)[:, box], initial=0.0))
        cell.tracking_error = self._tracking_error(answer["velocities"])
        if not cell.frame_error <= FRAME_TOLERANCE:
            raise LibraryError(f"its frames differ by {cell.frame_error:.1e}")
        if not (cell.distance_error <= tolerance and cell.box_error <= max(tolerance, BOX_TOLERANCE)):
            raise LibraryError(f"its distances differ by {max(cell.distance_error, cell.box_error):.1e} m")
        undecided = np.abs(distances - workload.influence) < max(tolerance, BOX_TOLERANCE)
        different = ((reported < workload.influence) != (distances < workload.influence)) & ~undecided
        if different.any():
            raise LibraryError(f"{int(different.sum())} pairs are in range for one and not for the other")
        if not np.isfinite(answer["velocities"]).all():
            raise LibraryError("its velocities are not finite")
        if closing_gain is not None:
            self._check_rows(answer["velocities"], closing_gain)

    def _check_rows(self, velocities: Array, gain: float) -> None:
        """Compare with the rows `beta` for d_min: ḋ by a difference, β by eq. 12 of the paper."""
        workload, model, step = self.workload, self.scene.robot.model, 1e-5
        moved = [pin.integrate(model, workload.q[i], v * step) for i, v in zip(CHECK_TICKS, velocities, strict=True)]
        after = build.reference(self.scene, workload, np.array(moved))[1]
        margin = self.distances - workload.d_min
        beta = 0.5 + 0.5 * np.cos(np.pi * np.clip(margin / (workload.influence - workload.d_min), 0.0, 1.0))
        closing = np.maximum((1.0 - beta) * gain * margin, np.minimum(gain * margin, Beta().near_speed))
        violation = -closing - (after - self.distances) / step
        worst = float(np.max(violation, initial=-np.inf, where=self.distances < workload.influence))
        if worst > RATE_TOLERANCE:
            raise LibraryError(f"a pair in range closes {1e3 * worst:.1f} mm/s too fast")

    def _tracking_error(self, velocities: Iterable[Array]) -> float:
        """Return the median distance of frames to targets once a velocity has been applied for a period [m]."""
        model, workload = self.scene.robot.model, self.workload
        data, errors = model.createData(), []
        for tick, v in zip(CHECK_TICKS, velocities, strict=True):
            pin.framesForwardKinematics(model, data, pin.integrate(model, workload.q[tick], v * workload.dt))
            for name, target in zip(workload.frames, workload.targets[tick], strict=True):
                errors.append(np.linalg.norm(data.oMf[model.getFrameId(name)].translation - target[:3, 3]))
        return float(np.median(errors))
