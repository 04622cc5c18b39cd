"""Record of a run, saved as .npz with the configuration and versions that made it, and its key figures."""

from __future__ import annotations

import json
import os.path
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from qpavoid.errors import ConfigError
from qpavoid.problem import Array, IntArray, Status
from qpavoid.reason import Severity
from qpavoid.run.metrics import path_deviation, torque_figures

STATUSES = tuple(Status)
"""Status of each code in `Log.status`."""
WITH_PLANNING = "with planning"
"""Ends the name of a solver in runs with planning."""
_FORMAT = 9
_SHAPES = {
    "t": "N", "q": "N nq", "v": "N nv",
    "target": "N k 3", "tool": "N k 3", "tool_rotation": "N k 3 3", "turn_error": "N k",
    "task_error": "N s",
    "body_distance": "N b", "body_pair": "N b", "closest_pair": "N", "alpha": "N", "beta": "N", "status": "N",
    "slack": "N", "saturation": "N", "build_time": "N", "solve_time": "N", "command_scale": "N", "stalled": "N",
    "planned": "N", "severity": "N",
    "body_ends": "N b 2 3", "obstacle_position": "N o 3", "obstacle_rotation": "N o 3 3",
    "torque": "N m", "contact_force": "N c 3", "slip": "N c",
}  # fmt: skip
"""Shape of each array; a letter is the same number wherever it stands."""
_TYPES = {
    "closest_pair": np.intp, "body_pair": np.intp, "status": np.int8, "stalled": np.bool_, "planned": np.bool_,
    "severity": np.int8,
}  # fmt: skip
"""Type of an array's numbers, where they are not floating point."""
_MAX_EVENTS = 20
"""Number of changes of reasons that are among the figures of a run: what a reader of JSON can take in."""


@dataclass(frozen=True)
class Log:
    """Arrays of a run, one row a control step.

    N steps, n joints, k frames that follow motions, s other tasks, b bodies, o obstacles; of a run with a plant, m
    motors and c contact points, else none.

    Distances are between surfaces [m]. Everything is in world axes and SI units.
    """

    t: Array
    """(N,) time [s]."""
    q: Array
    """(N, nq) configuration at the start of the step [rad or m]."""
    v: Array
    """(N, nv) commanded velocity [rad/s or m/s]."""
    target: Array
    """(N, k, 3) target position of each task's frame [m]; the frame's own position if only its orientation counts."""
    tool: Array
    """(N, k, 3) position of each task's frame [m]."""
    tool_rotation: Array
    """(N, k, 3, 3) orientation of each task's frame."""
    turn_error: Array
    """(N, k) angle between target and frame [rad]; 0 for position tasks."""
    task_error: Array
    """(N, s) error of each other task, in its unit; see `meta["tasks"]`."""
    body_distance: Array
    """(N, b) smallest distance of each body over the pairs that it is in [m]; inf where there is none."""
    body_pair: IntArray
    """(N, b) index in `meta["pairs"]` of the pair with that distance; -1 where there is none."""
    closest_pair: IntArray
    """(N,) index of the closest pair in `meta["pairs"]`; -1 where there are none."""
    alpha: Array
    """(N,) eq. 11 for the closest pair; 0 out of range."""
    beta: Array
    """(N,) eq. 12 for the closest pair; 0 out of range."""
    status: npt.NDArray[np.int8]
    """(N,) index in STATUSES."""
    slack: Array
    """(N,) largest slack of an avoidance row [m/s]."""
    command_scale: Array
    """(N,) fraction of the solver's velocity that was commanded after the stop look-ahead; the rest was a stop's."""
    stalled: npt.NDArray[np.bool_]
    """(N,) whether the tasks made no progress."""
    planned: npt.NDArray[np.bool_]
    """(N,) whether a path or a fast finish was followed, see `Solution.plan`."""
    severity: npt.NDArray[np.int8]
    """(N,) worst severity of the step's reasons, see `qpavoid.reason.Severity`; 0 without reasons."""
    saturation: Array
    """(N,) largest change that the limits made to the raw velocity of the solver [rad/s or m/s]."""
    build_time: Array
    """(N,) time to set up the problem [s]."""
    solve_time: Array
    """(N,) time to solve the problem [s]."""
    body_ends: Array
    """(N, b, 2, 3) ends of the axis of each body, or of the capsule around it, for drawing [m]."""
    obstacle_position: Array
    """(N, o, 3) origin of each obstacle [m]."""
    obstacle_rotation: Array
    """(N, o, 3, 3) orientation of each obstacle."""
    torque: Array
    """(N, m) torques of the motors at the end of the step [Nm or N]; limits are in `meta["torque_limit"]`."""
    contact_force: Array
    """(N, c, 3) force of the floor on each contact point at the end of the step [N]."""
    slip: Array
    """(N, c) how far each contact point is then from where it was at the start, along the floor [m]."""
    meta: dict[str, Any] = field(default_factory=dict)
    """Names, shapes, limits, the scenario's configuration, versions, and how the run ended."""

    @classmethod
    def allocate(cls, sizes: dict[str, int]) -> dict[str, Any]:
        """Lay out the arrays of a run; `sizes` has the numbers N, nq, nv, k, s, b, o, m, c of the shapes above."""
        sides = {"2": 2, "3": 3, **sizes}
        shapes = {name: [sides[letter] for letter in letters.split()] for name, letters in _SHAPES.items()}
        return {name: np.zeros(shape, dtype=_TYPES.get(name, np.float64)) for name, shape in shapes.items()}

    @property
    def stem(self) -> str:
        """Return what files of the run begin with: scenario and solver."""
        return f"{self.meta['scenario']}_{self.meta['solver']}".replace(":", "-").replace(" ", "_")

    @property
    def min_distance(self) -> Array:
        """Return the smallest distance of any body at each step, (N,) [m]."""
        return np.asarray(np.min(self.body_distance, axis=1, initial=np.inf))

    def until(self, t: float) -> Log:
        """Return the part of the run before time t [s]."""
        count = int(np.searchsorted(self.t, t - 1e-9))
        return Log(**{name: array[:count] for name, array in self._arrays().items()}, meta=self.meta)

    def metrics(self) -> dict[str, Any]:
        """Compute the figures by which runs are compared.

        Returns:
            scenario, solver; completed: ran for its whole duration; arrived: so it did, and every task that
            is measured in metres ended within the goal tolerance; task_errors: of tasks that are not
            frames, [error, unit] at the end; collided; min_distance: surface to surface [m], None where
            nothing is paired; min_pair: names of that pair; time_in_collision [s]; time_below: threshold ->
            [s]; final_error [m]; max_deviation: largest distance of a tool from its planned path [m];
            tracking_rmse: of the distance to the moving target [m]; peak_velocity: fastest joint [rad/s or
            m/s]; jitter: Σ|Δq̇| over joints and ticks [rad/s]; torque: of a run with motors, share of their
            limits that was used, Σ|Δτ| [Nm/s] and slip of a contact point [m], else None; status_counts; relaxed_ticks;
            shortened_ticks: steps scaled down by the stop look-ahead; time_blocked: stalled [s];
            severity_counts: steps by the worst severity of their reasons; events: the first changes of
            reasons, as [t, status, reasons as data]; tick_us: p50, p99 and max of the computation time of a
            step [µs].
        """
        config, dt = self.meta["config"], self.meta["config"]["dt"]
        distance = self.min_distance
        closest = int(np.argmin(distance)) if np.isfinite(distance).any() else None
        error = np.linalg.norm(self.target - self.tool, axis=2)
        statuses = [status.value for status in STATUSES]
        counts = {name: int(np.sum(self.status == code)) for code, name in enumerate(statuses)}
        tick_us = 1e6 * (self.build_time + self.solve_time)
        other_tasks = {
            name: [float(self.task_error[-1, i]), unit]
            for i, (name, unit) in enumerate(self.meta.get("tasks", []))
            if len(self.task_error)
        }
        metres = [value for value, unit in other_tasks.values() if unit == "m"]
        final_error = (
            float(np.max([*error[-1], *metres])) if len(error) and (error.shape[1] or metres) else float("nan")
        )
        return {
            "scenario": self.meta["scenario"],
            "solver": self.meta["solver"],
            "completed": self.meta["completed"],
            "arrived": self.meta["completed"] and bool(final_error <= config["goal_tolerance"]),
            "collided": bool(np.any(distance < 0.0)),
            "min_distance": None if closest is None else float(distance[closest]),
            "min_pair": None if closest is None else self.meta["pairs"][self.closest_pair[closest]],
            "time_in_collision": dt * float(np.sum(distance < 0.0)),
            "time_below": {str(limit): dt * float(np.sum(distance < limit)) for limit in config["thresholds"]},
            "final_error": final_error,
            "task_errors": other_tasks,
            "max_deviation": float(np.max(path_deviation(self.tool, self.target), initial=0.0)),
            "tracking_rmse": float(np.sqrt(np.mean(error**2))) if error.size else float("nan"),
            "peak_velocity": float(np.max(np.abs(self.v), initial=0.0)),
            "jitter": float(np.sum(np.abs(np.diff(self.v, axis=0)))),
            "torque": torque_figures(self.torque, self.meta["torque_limit"], self.slip, dt),
            "status_counts": counts,
            "relaxed_ticks": counts[Status.RELAXED.value],
            "shortened_ticks": int(np.sum(self.command_scale < 1.0)),
            "time_blocked": dt * float(np.sum(self.stalled)),
            "severity_counts": {level.name: int(np.sum(self.severity == level)) for level in Severity},
            "events": self.meta["events"][:_MAX_EVENTS],
            "tick_us": {
                "p50": float(np.median(tick_us)) if len(tick_us) else float("nan"),
                "p99": float(np.quantile(tick_us, 0.99)) if len(tick_us) else float("nan"),
                "max": float(np.max(tick_us, initial=0.0)),
            },
        }

    def save(self, path: str | Path) -> Path:
        """Write the log; the parent folder is made where it is missing.

        Returns:
            The file written, ending in .npz.
        """
        path = Path(path)
        path = path.with_name(path.name.removesuffix(".npz") + ".npz")
        path.parent.mkdir(parents=True, exist_ok=True)
        meta: Any = np.array(json.dumps({"format": _FORMAT, **self.meta}))
        with path.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, meta=meta, **self._arrays())
        return path

    @classmethod
    def load(cls, path: str | Path) -> Log:
        """Read a log from a file.

        Raises:
            ConfigError: no such file, or not a whole log of this format.
        """
        if not os.path.isfile(path):  # reading a pipe or a device may never end
            raise ConfigError(f"{path}: no such file; give a log written by `qpavoid run`")
        try:
            with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
                meta = json.loads(str(file["meta"]))
                if meta.pop("format") != _FORMAT:
                    raise ConfigError(f"{path}: written by another version of qpavoid; run the scenario again")
                log = cls(**{name: file[name] for name in file.files if name != "meta"}, meta=meta)
            log._check()
            return log
        except ConfigError:
            raise
        except Exception as error:  # zipfile, its decompressors, numpy and json raise a dozen kinds on damaged files
            message = str(error) or type(error).__name__
            raise ConfigError(f"{path}: not a qpavoid log: {message}; give one written by `qpavoid run`") from None

    def _check(self) -> None:
        """Raise ValueError where the arrays do not belong together."""
        sides: dict[str, int] = {"2": 2, "3": 3}
        for name, dimensions in _SHAPES.items():
            shape, letters = getattr(self, name).shape, dimensions.split()
            if len(letters) != len(shape) or any(
                sides.setdefault(letter, side) != side for letter, side in zip(letters, shape, strict=True)
            ):
                raise ValueError(f"{name} has shape {shape}; must be ({dimensions})")

    def _arrays(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "meta"}
