"""Figures of several runs of one scenario: distances and errors over time, tool paths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon
from scipy.spatial import ConvexHull

from qpavoid.problem import Array
from qpavoid.run.log import Log
from qpavoid.run.metrics import path_deviation
from qpavoid.viz.style import (
    AT_REST,
    COLOURS,
    D2,
    DASHES,
    OBSTACLES,
    PLAN,
    add_grid,
    add_legend,
    draw_levels,
    label_distances,
    spans,
    units,
)
from qpavoid.viz.surfaces import capsule_faces, is_endless, moving_bodies, obstacle_faces, obstacle_path

_VIEW_ASPECT = 1.9
"""Width of a view of paths, by its height, beside the longest legend at least [-]."""
SOLVER_STYLES: dict[str, tuple[str, Any]] = {
    "tracking": ("#333333", DASHES[2]),
    "eq10-literal": ("#E69F00", DASHES[3]),
    "eq10": ("#D55E00", DASHES[1]),
    "gradient-projection": ("#CC79A7", DASHES[4]),
    "potential-field": ("#56B4E9", DASHES[6]),
    "step-search": ("#999999", DASHES[7]),
    "hqp": ("#009E73", DASHES[5]),
    "qp": ("#0072B2", DASHES[0]),
}
ERROR_FLOOR = 1e-5
"""Lower end of the axis of distances to the target [m]: below it is round-off."""
PLANNED_COLOUR = "#B9A6D3"


def solver_styles(logs: Sequence[Log]) -> list[dict[str, Any]]:
    """Choose label, colour and line style of each run, the same in every panel.

    No two of up to seven runs share a colour or a dash, and dashed lines lie over solid ones: runs that are alike, as
    of one law with two back ends, show both their lines.
    """
    solvers: list[str] = [log.meta["solver"] for log in logs]
    chosen = [SOLVER_STYLES.get(solver) if solver not in solvers[:i] else None for i, solver in enumerate(solvers)]
    used: list[tuple[str, Any]] = [style for style in chosen if style is not None]
    free = [(colour, dash) for dash in DASHES[::-1] for colour in COLOURS[::-1]]  # wide gaps first
    styles = []
    for i, name in enumerate(solvers):
        style = chosen[i]
        if style is None:
            colours, dashes = zip(*used, strict=True) if used else ((), ())
            style = min(free, key=lambda s: (s in used, colours.count(s[0]), dashes.count(s[1])))
            used.append(style)
        colour, dash = style
        label = f"{name} ({solvers[:i].count(name)})" if name in solvers[:i] else name
        styles.append({"label": label, "color": colour, "linestyle": dash, "zorder": 3.0 if dash == "-" else 3.5})
    return styles


def compare_time_figure(logs: Sequence[Log]) -> Figure:
    """Draw smallest distance, path deviation, target error and fastest joint over time."""
    meta = logs[0].meta
    figure = Figure(figsize=(9.0, 10.0), layout="constrained")
    distance, deviation, error, speed = figure.subplots(4, 1, sharex=True, height_ratios=(1.5, 1, 1, 1))
    for log, style in zip(logs, solver_styles(logs), strict=True):
        line = {**style, "linewidth": 1.7}
        to_target = np.linalg.norm(log.target - log.tool, axis=2)
        distance.plot(log.t, log.min_distance, **line)
        deviation.plot(log.t, np.max(path_deviation(log.tool, log.target), axis=1, initial=0.0), **line)
        error.plot(log.t, np.max(to_target, axis=1, initial=1e-3 * ERROR_FLOOR), **line)
        speed.plot(log.t, np.max(np.abs(log.v), axis=1, initial=0.0), **line)
    solvers = distance.get_legend_handles_labels()[0]
    levels = draw_levels(distance, logs[0])
    label_distances(distance, *(log.min_distance for log in logs), name="smallest distance\n")
    deviation.set_ylabel("deviation from the\nplanned path [m]")
    error.set_yscale("log")
    tolerance = meta["config"]["goal_tolerance"]
    goal = error.axhline(tolerance, color=D2, linewidth=1.0, linestyle=":", label=f"goal tolerance: {tolerance:g} m")
    error.set_ylim(bottom=ERROR_FLOOR)
    error.set_ylabel("distance to the\ntarget [m]")
    speed.set_ylabel(f"fastest joint\n[{units(logs[0], '/s')}]")
    speed.set_xlabel("time [s]")
    for ax in (deviation, error, speed):
        add_grid(ax)
    figure.suptitle(meta["title"] or meta["scenario"], fontsize=11)
    add_legend(distance, [*solvers, *levels])
    add_legend(error, [goal])
    return figure


def path_figure(logs: Sequence[Log], styles: Sequence[dict[str, Any]]) -> Figure:
    """Draw tool paths in two views at one scale, with the planned path, the obstacles and the bodies at rest."""
    longest = max(logs, key=lambda log: len(log.t))
    outlines = _outlines(longest) if len(longest.t) else []
    paths = longest.target.reshape(-1, 3)
    horizontal = int(np.argmax(np.ptp(paths, axis=0))) if len(paths) else 0
    figure = Figure(figsize=(8.5, 8.0), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    for ax, vertical in zip(axes, [axis for axis in (2, 1, 0) if axis != horizontal], strict=True):
        for faces, colour, alpha in outlines:
            flat = faces.reshape(-1, 3)[:, [horizontal, vertical]]
            hull = flat[ConvexHull(flat, qhull_options="QJ").vertices]
            ax.add_patch(Polygon(hull, facecolor=(colour, alpha), edgecolor=colour, linewidth=0.8, zorder=1))
        for k in range(longest.tool.shape[1]):
            x, y = longest.target[:, k, horizontal], longest.target[:, k, vertical]
            ax.plot(x, y, color=PLANNED_COLOUR, linewidth=4.0, zorder=2, label="planned path")
            ax.plot(x[-1:], y[-1:], "k*", markersize=9, zorder=4, label="goal")
            for log, style in zip(logs, styles, strict=True):
                x, y = log.tool[:, k, horizontal], log.tool[:, k, vertical]
                ax.plot(x, y, linewidth=1.7, **style)
                for steps in spans(log.planned):
                    _mark_plan(ax, x, y, *steps, log.t)
                for forecast in log.meta.get("forecasts", ()):
                    _draw_forecast(ax, np.array(forecast["tools"][k])[:, [horizontal, vertical]])
        ax.autoscale_view()
        add_grid(ax)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_ylabel(f"{'xyz'[vertical]} [m]")
    _widen(axes)
    axes[1].set_xlabel(f"{'xyz'[horizontal]} [m]")
    named = [line for line in axes[0].get_lines() if not str(line.get_label()).startswith("_")]
    handles: dict[str, Any] = {str(line.get_label()): line for line in named}
    for i, described in enumerate(longest.meta["obstacles"]):
        path, colour = obstacle_path(longest, i), _colour(i)
        if is_endless(longest, i) or not len(path):
            continue
        name = described["name"] + " (paler: earlier)" * (len(path) > 1)
        handles[name] = Patch(facecolor=(colour, 0.5), edgecolor=colour, label=name)
    if any(colour == AT_REST for _, colour, _ in outlines):
        name = "robot body at rest"
        handles[name] = Patch(facecolor=(AT_REST, 0.5), edgecolor=AT_REST, label=name)
    add_legend(axes[0], list(handles.values()))
    figure.suptitle(f"{longest.meta['title'] or longest.meta['scenario']}  —  tool path", fontsize=11)
    return figure


def _mark_plan(ax: Any, x: Array, y: Array, first: int, last: int, t: Array) -> None:
    """Draw the part of a tool's path on which a plan was followed, with the times of its ends [s]."""
    label, part = "plan followed, between its times", slice(first, last + 1)
    ax.plot(x[part], y[part], color=PLAN, linewidth=5.0, alpha=0.45, zorder=2.5, label=label)
    for step, marker in ((first, "v"), (last, "^")):
        ax.plot(x[step], y[step], color=PLAN, marker=marker, markersize=7, zorder=5)
        ax.annotate(f"{t[step]:.2f} s", (x[step], y[step]), (6, 6), textcoords="offset points", fontsize=8, color=PLAN)


def _colour(obstacle: int) -> tuple[float, ...]:
    return OBSTACLES[obstacle % len(OBSTACLES)]


def _outlines(log: Log) -> list[tuple[Array, Any, float]]:
    """Return faces, colour and opacity of bodies at rest, and of obstacles at up to four places of their paths."""
    resting = np.flatnonzero(~moving_bodies(log)).tolist()
    outlines: list[tuple[Array, Any, float]] = [
        (capsule_faces(log.body_ends[0, i], log.meta["body_radii"][i]), AT_REST, 0.5) for i in resting
    ]
    for i in range(len(log.meta["obstacles"])):
        present = np.flatnonzero(np.isfinite(log.obstacle_position[:, i]).all(axis=1))
        if is_endless(log, i) or not len(present):
            continue
        travel = np.cumsum(np.r_[0.0, np.linalg.norm(np.diff(log.obstacle_position[present, i], axis=0), axis=1)])
        steps = np.unique(np.searchsorted(travel, np.linspace(0.0, travel[-1], 4))) if travel[-1] > 1e-3 else [0]
        for rank, step in enumerate(steps):
            outlines.append((obstacle_faces(log, i, int(present[step])), _colour(i), 0.5 * (rank + 1) / len(steps)))
    return outlines


def _draw_forecast(ax: Any, path: Array) -> None:
    """Draw where the tasks alone were expected to bring a tool, points (n, 2), with a cross at the end."""
    label = "forecast without the plan"
    ax.plot(*path.T, color=PLAN, linewidth=1.2, linestyle=(0, (3, 2)), zorder=3, label=label)
    ax.plot(*path[-1], color=PLAN, marker="x", markersize=8, zorder=5)


def _widen(axes: Any) -> None:
    """Make room at the sides, so that what is high fits into views of one scale, and is not cut off."""
    (left, right), height = axes[0].get_xlim(), max(np.ptp(ax.get_ylim()) for ax in axes)
    missing = max(_VIEW_ASPECT * height - (right - left), 0.0)
    axes[0].set_xlim(left - 0.5 * missing, right + 0.5 * missing)
