"""Key figures of a run, computed from its log by the same code for every solver."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from qpavoid.geometry.segments import point_segment_distance
from qpavoid.problem import Array, Status
from qpavoid.reason import Severity

if TYPE_CHECKING:
    from qpavoid.run.log import Log


_MAX_EVENTS = 20
"""Number of changes of reasons that are among the figures of a run: what a reader of JSON can take in."""


def run_metrics(log: Log) -> dict[str, Any]:
    """Compute the figures by which runs are compared.

    Returns:
        scenario, solver; completed: ran for its whole duration; arrived: so it did, and every task that is measured in
        metres ended within the goal tolerance; task_errors: of tasks that are not frames, [error, unit] at the end;
        collided; min_distance: surface to surface [m], None where nothing is paired; min_pair: names of that pair;
        time_in_collision [s]; time_below: threshold -> [s]; final_error [m]; max_deviation: largest distance of a tool
        from its planned path [m]; tracking_rmse: of the distance to the moving target [m]; peak_velocity: fastest
        joint [rad/s or m/s]; jitter: Σ|Δq̇| over joints and ticks [rad/s]; status_counts; relaxed_ticks;
        shortened_ticks: steps scaled down by the stop look-ahead; time_blocked: stalled [s]; severity_counts: steps by
        the worst severity of their reasons; events: the first changes of reasons, as [t, status, reasons as data];
        tick_us: p50, p99 and max of the computation time of a step [µs].
    """
    config, dt = log.meta["config"], log.meta["config"]["dt"]
    distance = log.min_distance
    closest = int(np.argmin(distance)) if np.isfinite(distance).any() else None
    error = np.linalg.norm(log.target - log.tool, axis=2)
    statuses = [status.value for status in Status]
    counts = {name: int(np.sum(log.status == code)) for code, name in enumerate(statuses)}
    tick_us = 1e6 * (log.build_time + log.solve_time)
    other_tasks = {
        name: [float(log.task_error[-1, i]), unit]
        for i, (name, unit) in enumerate(log.meta.get("tasks", []))
        if len(log.task_error)
    }
    metres = [value for value, unit in other_tasks.values() if unit == "m"]
    final_error = float(np.max([*error[-1], *metres])) if len(error) and (error.shape[1] or metres) else float("nan")
    return {
        "scenario": log.meta["scenario"],
        "solver": log.meta["solver"],
        "completed": log.meta["completed"],
        "arrived": log.meta["completed"] and bool(final_error <= config["goal_tolerance"]),
        "collided": bool(np.any(distance < 0.0)),
        "min_distance": None if closest is None else float(distance[closest]),
        "min_pair": None if closest is None else log.meta["pairs"][log.closest_pair[closest]],
        "time_in_collision": dt * float(np.sum(distance < 0.0)),
        "time_below": {str(limit): dt * float(np.sum(distance < limit)) for limit in config["thresholds"]},
        "final_error": final_error,
        "task_errors": other_tasks,
        "max_deviation": float(np.max(path_deviation(log.tool, log.target), initial=0.0)),
        "tracking_rmse": float(np.sqrt(np.mean(error**2))) if error.size else float("nan"),
        "peak_velocity": float(np.max(np.abs(log.v), initial=0.0)),
        "jitter": float(np.sum(np.abs(np.diff(log.v, axis=0)))),
        "status_counts": counts,
        "relaxed_ticks": counts[Status.RELAXED.value],
        "shortened_ticks": int(np.sum(log.command_scale < 1.0)),
        "time_blocked": dt * float(np.sum(log.stalled)),
        "severity_counts": {level.name: int(np.sum(log.severity == level)) for level in Severity},
        "events": log.meta["events"][:_MAX_EVENTS],
        "tick_us": {
            "p50": float(np.median(tick_us)) if len(tick_us) else float("nan"),
            "p99": float(np.quantile(tick_us, 0.99)) if len(tick_us) else float("nan"),
            "max": float(np.max(tick_us, initial=0.0)),
        },
    }


def path_deviation(tool: Array, target: Array, corners: int = 500) -> Array:
    """Compute the distance of each tool from the path that its target draws, at whatever time.

    Args:
        tool: (N, k, 3) positions of the tools [m].
        target: (N, k, 3) positions of their targets [m].
        corners: the path is taken as a polyline with at most so many corners.

    Returns:
        (N, k) [m].
    """
    count, tasks = tool.shape[:2]
    deviation = np.full((count, tasks), np.inf)
    every = np.unique(np.linspace(0, max(count - 1, 0), min(count, corners)).astype(int))
    for task in range(tasks):
        path = target[every, task]
        for start, end in zip(path, np.concatenate((path[1:], path[-1:])), strict=True):
            deviation[:, task] = np.minimum(deviation[:, task], point_segment_distance(tool[:, task], start, end))
    return deviation
