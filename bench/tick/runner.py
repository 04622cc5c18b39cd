"""Runs the libraries in turn: one process each, one round of ticks at a time, A B C A B C."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from bench.tick import build
from bench.tick.libs import LIBRARIES, Library
from bench.tick.workloads import Array, Workload

ROOT = Path(__file__).resolve().parents[2]
PLACO_ENVIRONMENT = ROOT / "bench" / ".venv-placo"
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
CHECK_TICKS = list(range(0, build.TICKS, 50))
FRAME_TOLERANCE = 1e-9
DISTANCE_TOLERANCE = 1e-6
"""For spheres and capsules, which every library computes in closed form."""
BOX_TOLERANCE = 1e-5
"""For pairs with a box, which the libraries compute by different iterative algorithms [m]."""

RATE_TOLERANCE = 2e-3
"""How much faster than its row allows a pair may close: what a difference of distances can tell [m/s]."""


class LibraryError(Exception):
    """What a library could not do."""


class Process:
    """A worker and the pipe to it."""

    def __init__(self, library: Library) -> None:
        python = _placo_python() if library.own_python else sys.executable
        self.name = library.name
        self._process = subprocess.Popen(
            [python, "-m", "bench.tick.worker", library.adapter],
            cwd=ROOT,
            env={**os.environ, **ONE_THREAD},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """One request, and its answer.

        Raises:
            LibraryError: the library raised, or its process ended.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            pickle.dump({"command": command, **arguments}, self._process.stdin)
            self._process.stdin.flush()
            answer: dict[str, Any] = pickle.load(self._process.stdout)
        except (EOFError, BrokenPipeError):
            raise LibraryError(f"its process ended with status {self._process.wait()}") from None
        if "error" in answer:
            raise LibraryError(answer["error"])
        return answer

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


@dataclass
class Cell:
    """What was measured of one library on one workload."""

    ticks: list[int] = field(default_factory=list)
    ns: list[int] = field(default_factory=list)
    frame_error: float = np.nan
    """Largest difference of a frame's pose to Pinocchio's [m, -]."""
    distance_error: float = np.nan
    """Largest difference of a distance to coal's, pairs without boxes [m]."""
    box_error: float = np.nan
    """The same of pairs in range with boxes [m]."""
    tracking_error: float = np.nan
    """Median distance of the frames to their targets after one step [m]."""
    stages: dict[str, float] = field(default_factory=dict)
    """Median time of each stage [µs], for qpavoid."""
    """(k, nv) its answers at the checked ticks."""
    refused: str = ""
    """Why it was not timed."""

    @property
    def us(self) -> Array:
        """Times [µs]."""
        return 1e-3 * np.array(self.ns, dtype=np.float64)


@dataclass
class Row:
    """One workload."""

    workload: Workload
    in_range: Array
    """(k,) number of pairs in range at the checked ticks."""
    bound: Array
    """(T,) 1 where an avoidance row or limit changes qpavoid's velocity at a tick, else 0; NaN if it was not run."""
    cells: dict[str, Cell]


@dataclass
class Results:
    """Everything for the report."""

    rows: list[Row] = field(default_factory=list)
    libraries: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Versions and settings by library."""
    missing: dict[str, str] = field(default_factory=dict)
    """Libraries that could not be run, and why."""
    rounds: int = 0
    ticks: int = 0
    budget: float = 0.0
    load: tuple[float, float] = (0.0, 0.0)
    """Mean number of running processes over the minute before the start, and before the end."""


def run(workloads: Sequence[str], libraries: Sequence[str], rounds: int, ticks: int, budget: float) -> Results:
    """Measures everything.

    Args:
        workloads: their names.
        libraries: their names, in the order of turns.
        rounds: how often the libraries take turns.
        ticks: steps of each library in a round.
        budget: seconds that a round of one library may take: slow ones make fewer steps, spread over the same ticks.
    """
    results = Results(rounds=rounds, ticks=ticks, budget=budget)
    before = os.getloadavg()[0]
    processes: dict[str, Process] = {}
    try:
        for name in libraries:
            process = None
            try:
                process = Process(LIBRARIES[name])
                results.libraries[name] = process.ask("hello")
                processes[name] = process
            except (LibraryError, OSError, subprocess.CalledProcessError) as error:
                results.missing[name] = str(error)
                if process is not None:
                    process.close()
        gains = {name: info["closing_gain"] for name, info in results.libraries.items()}
        for name in workloads:
            print(f"{name} ", end="", file=sys.stderr, flush=True)
            results.rows.append(_measure(build.build(name), processes, gains, rounds, ticks, budget))
            print(file=sys.stderr)
    finally:
        for process in processes.values():
            process.close()
    results.load = (before, os.getloadavg()[0])
    return results


def _measure(
    workload: Workload,
    processes: dict[str, Process],
    gains: dict[str, float | None],
    rounds: int,
    ticks: int,
    budget: float,
) -> Row:
    scene = build.make_scene(workload)
    frames, distances = build.reference(scene, workload, CHECK_TICKS)
    cells = {name: Cell() for name in processes}
    pace: dict[str, float] = {}
    for name, process in processes.items():
        try:
            process.ask("setup", workload=workload)
            answer = process.ask("check", ticks=CHECK_TICKS)
            _check(cells[name], answer, frames, distances, workload, scene)
            if gains.get(name) is not None:
                _check_rows(answer["velocities"], gains[name], distances, workload, scene)
            sample = process.ask("round", ticks=CHECK_TICKS[:3], warmup=CHECK_TICKS[:1])["ns"]
            pace[name] = 1e-9 * float(np.median(sample))
        except LibraryError as error:
            cells[name].refused = str(error)
    for number in range(rounds):
        window = [(number * ticks + i) % build.TICKS for i in range(ticks)]
        for name in list(pace):
            count = int(np.clip(budget / pace[name], 3, ticks))
            chosen = window[:: -(-ticks // count)]
            try:
                answer = processes[name].ask("round", ticks=chosen, warmup=chosen[: min(20, len(chosen) // 3)])
            except LibraryError as error:
                cells[name] = Cell(refused=f"in round {number}: {error}")
                del pace[name]
                continue
            cells[name].ticks += chosen
            cells[name].ns += answer["ns"]
        print(".", end="", file=sys.stderr, flush=True)
    for name in pace:
        cells[name].stages = processes[name].ask("stages", ticks=list(range(0, build.TICKS, 2)))["us"]
    return Row(
        workload=workload,
        in_range=(distances < workload.influence).sum(axis=1),
        bound=_bound(pace, processes),
        cells=cells,
    )


def _bound(timed: Iterable[str], processes: dict[str, Process]) -> Array:
    """Return whether a constraint binds at each tick (T,), as reported by qpavoid; NaN if it was not timed."""
    for name in timed:
        if name == "qpavoid":
            return np.array(processes[name].ask("bound")["bound"], dtype=np.float64)
    return np.full(build.TICKS, np.nan)


def _check(cell: Cell, answer: dict[str, Any], frames: Array, distances: Array, workload: Workload, scene: Any) -> None:
    """Compares a library with Pinocchio and coal.

    Raises:
        LibraryError: it does not agree, so that its time would be that of another problem.
    """
    box = workload.boxes
    cell.frame_error = float(np.abs(answer["frames"] - frames).max())
    error = np.abs(answer["distances"] - distances)
    # far pairs do not count: iterative algorithms stop early on them
    relevant = distances < 2.0 * workload.influence
    cell.distance_error = float(np.max(error[:, ~box], initial=0.0))
    cell.box_error = float(np.max(np.where(relevant, error, 0.0)[:, box], initial=0.0))
    cell.tracking_error = _tracking_error(answer["velocities"], workload, scene)
    if not cell.frame_error <= FRAME_TOLERANCE:
        raise LibraryError(f"its frames differ by {cell.frame_error:.1e}")
    if not (cell.distance_error <= DISTANCE_TOLERANCE and cell.box_error <= BOX_TOLERANCE):
        raise LibraryError(f"its distances differ by {cell.distance_error:.1e} m, with boxes {cell.box_error:.1e} m")
    undecided = np.abs(distances - workload.influence) < BOX_TOLERANCE
    different = ((answer["distances"] < workload.influence) != (distances < workload.influence)) & ~undecided
    if different.any():
        raise LibraryError(f"{int(different.sum())} pairs are in range for one and not for the other")
    if not np.isfinite(answer["velocities"]).all():
        raise LibraryError("its velocities are not finite")


def _check_rows(velocities: Array, gain: float, distances: Array, workload: Workload, scene: Any) -> None:
    """Whether a library's velocities respect its rows ḋ >= -(1 - β(d)) ξ (d - d_min): ḋ by a difference, β by eq. 12.

    Raises:
        LibraryError: a pair in range closes too fast, so that its row must be missing or wrong.
    """
    model, step = scene.robot.model, 1e-5
    moved = [pin.integrate(model, workload.q[tick], v * step) for tick, v in zip(CHECK_TICKS, velocities, strict=True)]
    rate = (build.reference(scene, replace(workload, q=np.array(moved)), range(len(moved)))[1] - distances) / step
    left = distances - workload.d_min
    beta = 0.5 + 0.5 * np.cos(np.pi * np.clip(left / (workload.influence - workload.d_min), 0.0, 1.0))
    short = -(1.0 - beta) * gain * left - rate
    worst = float(np.max(short, initial=-np.inf, where=distances < workload.influence))
    if worst > RATE_TOLERANCE:
        raise LibraryError(f"a pair in range closes {1e3 * worst:.1f} mm/s too fast")


def _tracking_error(velocities: Iterable[Array], workload: Workload, scene: Any) -> float:
    """How far the frames are from their targets when the velocity has been held for one period: median [m]."""
    model = scene.robot.model
    data, errors = model.createData(), []
    for tick, v in zip(CHECK_TICKS, velocities, strict=True):
        pin.framesForwardKinematics(model, data, pin.integrate(model, workload.q[tick], v * workload.dt))
        for frame, target in zip(workload.frames, workload.targets[tick], strict=True):
            errors.append(np.linalg.norm(data.oMf[model.getFrameId(frame.name)].translation - target[:3, 3]))
    return float(np.median(errors))


def _placo_python() -> str:
    """The interpreter of placo's own environment, which is made on first use: placo needs an older pin."""
    python = PLACO_ENVIRONMENT / "bin" / "python"
    if not (PLACO_ENVIRONMENT / "ready").exists():
        print("making bench/.venv-placo for placo", file=sys.stderr)
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(PLACO_ENVIRONMENT)], check=True)
        subprocess.run([str(python), "-m", "pip", "install", "-qq", "placo"], check=True)
        (PLACO_ENVIRONMENT / "ready").touch()
    return str(python)
