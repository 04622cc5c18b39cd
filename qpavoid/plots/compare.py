"""Several runs of one scenario over each other: distances, errors and speeds over time, and tool paths in two views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon
from scipy.spatial import ConvexHull

from qpavoid.log import Log
from qpavoid.metrics import path_deviation
from qpavoid.plots.motion import OBSTACLE, RESTING, capsule_faces, endless, moving_bodies, obstacle_faces
from qpavoid.plots.style import COLOURS, D2, DASHES, add_grid, add_legend, draw_levels, is_qp, label_distances, units
from qpavoid.problem import Array

SOLVER_STYLES: dict[str, tuple[str, Any]] = {
    "tracking": ("#333333", DASHES[2]),
    "eq10-literal": ("#E69F00", DASHES[3]),
    "eq10": ("#D55E00", DASHES[1]),
    "gradient-projection": ("#CC79A7", DASHES[4]),
    "potential-field": ("#56B4E9", DASHES[6]),
    "hqp": ("#009E73", DASHES[5]),
    "qp": ("#0072B2", DASHES[0]),
}
ERROR_FLOOR = 1e-5
"""The axis of distances to the target begins here [m]."""
PLANNED = "#B9A6D3"


def solver_styles(logs: Sequence[Log]) -> list[dict[str, Any]]:
    """Label, colour and line style of each run, the same in every panel and, for known solvers, in every figure.

    No two of up to seven runs share a colour or a dash, and dashed lines lie over solid ones: runs that are alike, as
    of one law with two back ends, show both their lines.
    """
    solvers = [log.meta["solver"] for log in logs]
    used = [SOLVER_STYLES[solver] for solver in dict.fromkeys(solvers) if solver in SOLVER_STYLES]
    spare = [(colour, dash) for dash in DASHES[::-1] for colour in COLOURS[::-1]]  # wide gaps first
    taken: list[str] = []
    styles = []
    for solver in solvers:
        if solver in SOLVER_STYLES and solver not in taken:
            colour, dash = SOLVER_STYLES[solver]
        else:
            colours, dashes = [c for c, _ in used], [d for _, d in used]
            colour, dash = min(spare, key=lambda s: (s in used, colours.count(s[0]), dashes.count(s[1])))
            used.append((colour, dash))
        label = f"{solver} ({taken.count(solver) + 1})" if solver in taken else solver
        taken.append(solver)
        styles.append({"label": label, "color": colour, "linestyle": dash, "zorder": 3.0 if dash == "-" else 3.5})
    return styles


# --- over time ----------------------------------------------------------------------------------------------


def compare_time_figure(logs: Sequence[Log]) -> Figure:
    """Smallest distance, deviation from the planned path, distance to the target and fastest joint over time."""
    meta = logs[0].meta
    figure = Figure(figsize=(9.0, 10.0), layout="constrained")
    distance, deviation, error, speed = figure.subplots(4, 1, sharex=True, height_ratios=(1.5, 1, 1, 1))
    for log, style in zip(logs, solver_styles(logs), strict=True):
        line = {**style, "linewidth": 1.7}
        to_target = np.linalg.norm(log.target - log.tool, axis=2)
        distance.plot(log.t, log.min_distance, **line)
        deviation.plot(log.t, np.max(path_deviation(log), axis=1, initial=0.0), **line)
        error.plot(log.t, np.max(to_target, axis=1, initial=1e-3 * ERROR_FLOOR), **line)
        speed.plot(log.t, np.max(np.abs(log.v), axis=1, initial=0.0), **line)
    solvers = distance.get_legend_handles_labels()[0]
    levels = draw_levels(distance, logs[0], qp=any(map(is_qp, logs)))
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


# --- tool paths ---------------------------------------------------------------------------------------------


def path_figure(logs: Sequence[Log], styles: Sequence[dict[str, Any]]) -> Figure:
    """Tool paths of several runs in two views along world axes, with the planned path and what stood in the way.

    Args:
        logs: runs of one scenario.
        styles: label, colour and line style of each.
    """
    longest = max(logs, key=lambda log: len(log.t))
    outlines = _outlines(logs, longest)
    paths = np.concatenate([longest.target.reshape(-1, 3), *(log.tool.reshape(-1, 3) for log in logs)])
    seen = np.concatenate([paths, *(faces.reshape(-1, 3) for faces, _, _ in outlines)])
    lower, upper = (seen.min(axis=0), seen.max(axis=0)) if len(seen) else (-np.ones(3), np.ones(3))
    pad = 0.04 * max(float(np.max(upper - lower)), 0.1)
    lower, upper = lower - pad, upper + pad
    across = int(np.argmax(np.ptp(paths, axis=0))) if len(paths) else 0
    views = [axis for axis in (2, 1, 0) if axis != across]
    # Laid out by hand [in]: both views at one scale, one above the other.
    extent = (upper - lower) * min(6.0 / (upper - lower)[across], 7.0 / np.sum((upper - lower)[views]))
    width, height = extent[across] + 2.7, float(np.sum(extent[views])) + 1.4
    figure = Figure(figsize=(width, height))
    for up, bottom in zip(views, (0.85 + extent[views[1]], 0.6), strict=True):
        box = (0.75 / width, bottom / height, extent[across] / width, extent[up] / height)
        ax = figure.add_axes(box, xlim=(lower[across], upper[across]), ylim=(lower[up], upper[up]))
        for faces, colour, alpha in outlines:
            flat = faces.reshape(-1, 3)[:, [across, up]]
            hull = flat[ConvexHull(flat, qhull_options="QJ").vertices]
            ax.add_patch(Polygon(hull, facecolor=(colour, alpha), edgecolor=colour, linewidth=0.8, zorder=1))
        for k in range(longest.tool.shape[1]):
            path = longest.target[:, k]
            ax.plot(path[:, across], path[:, up], color=PLANNED, linewidth=4.0, zorder=2, label="planned path")
            ax.plot(path[-1:, across], path[-1:, up], "k*", markersize=9, zorder=4, label="goal")
            for log, style in zip(logs, styles, strict=True):
                ax.plot(log.tool[:, k, across], log.tool[:, k, up], linewidth=1.7, **style)
        add_grid(ax)
        ax.set_ylabel(f"{'xyz'[up]} [m]")
        if up == views[0]:
            ax.tick_params(labelbottom=False)
            lines: dict[str, Any] = {str(line.get_label()): line for line in ax.get_lines()}
    ax.set_xlabel(f"{'xyz'[across]} [m]")
    shown = {colour for _, colour, _ in outlines}
    moved = " (paler: earlier)" if len({alpha for _, _, alpha in outlines}) > 1 else ""
    for colour, name in ((OBSTACLE, f"obstacle{moved}"), (RESTING, "robot body at rest")):
        if colour in shown:
            lines[name] = Patch(facecolor=(colour, 0.5), edgecolor=colour, label=name)
    corner = ((0.85 + extent[across]) / width, 1.0 - 0.5 / height)
    figure.legend(handles=list(lines.values()), loc="upper left", bbox_to_anchor=corner, fontsize=8, frameon=False)
    figure.suptitle(
        f"{longest.meta['title'] or longest.meta['scenario']}  —  tool path", fontsize=11, y=1 - 0.12 / height
    )
    return figure


def _outlines(logs: Sequence[Log], log: Log) -> list[tuple[Array, str, float]]:
    """Faces, colour and opacity of obstacles at up to four places, and of bodies at rest that came near."""
    outlines = []
    for i in range(len(log.meta["obstacles"]) if len(log.t) else 0):
        if endless(log, i):
            continue
        way = np.cumsum(np.r_[0.0, np.linalg.norm(np.diff(log.obstacle_position[:, i], axis=0), axis=1)])
        ticks = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], 4))) if way[-1] > 1e-3 else np.zeros(1, int)
        for rank, tick in enumerate(ticks.tolist()):
            outlines.append((obstacle_faces(log, i, tick), OBSTACLE, 0.5 * (rank + 1) / len(ticks)))
    near: set[str] = set()
    for run in logs:
        avoidance = run.meta["config"]["avoidance"]
        within = run.min_distance + avoidance["offset"] < avoidance["d2"]
        near |= {name for pair in set(run.closest_pair[within].tolist()) for name in run.meta["pairs"][pair]}
    resting = [i for i in np.flatnonzero(~moving_bodies(log)).tolist() if log.meta["bodies"][i] in near]
    outlines += [(capsule_faces(log.body_ends[0, i], log.meta["body_radii"][i]), RESTING, 0.5) for i in resting]
    return outlines
