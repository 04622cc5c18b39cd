"""Robots among obstacles, in pictures at several instants (the paper's Figs. 6, 9, 10, 12, 15)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from qpavoid.problem import Array, IntArray
from qpavoid.run.log import Log
from qpavoid.viz.raster import Canvas, Projection
from qpavoid.viz.robot_pictures import RobotPictures
from qpavoid.viz.style import COLLISION, GROUND, OBSTACLES, TOOL_PATH, rgb
from qpavoid.viz.surfaces import inflated_outline, is_endless, obstacle_faces, obstacle_path, triangulated

PANELS = 6
PIXELS = 520
"""Height of a panel's picture."""
_PREVIEW = 96
"""Height of the pictures by which a view is chosen [pixels]."""
_AZIMUTHS, _ELEVATIONS = tuple(range(-165, 180, 30)), (18.0, 38.0)
"""Views to choose from [deg]; they look along no axis, which would take the depth away."""
_BEHIND = 0.05
"""Depth behind a surface up to which a tool counts as seen: it is inside its own hand [m]."""
_MARGIN, _LEAST = 0.06, 0.12
"""Margin around what fills a panel, as a share of its size, and half its least size [m]."""
_NARROWEST, _FLATTEST = 0.85, 0.6
"""Least width and height of a panel, as a share of the other [-]: titles have to fit."""
_NEAR = 0.15
"""Distance of an obstacle's surface from the robot up to which it is in the picture as a whole [m]."""
_BACKGROUND = "#EDF1F5"


class Sight(NamedTuple):
    """What the panels of a figure show: a projection, and corners (2,), (2,) of a rectangle in it [m]."""

    projection: Projection
    lower: Array
    upper: Array


def motion_figure(log: Log, sight: Sight | None = None) -> Figure:
    """Draw robot, obstacles with d1 around them, and paths at up to six instants, all with one view and scale.

    Args:
        log: the run.
        sight: what the panels show; chosen for this log if left out.
    """
    steps = instants(log)
    if not len(steps):
        figure = Figure(figsize=(6, 2))
        figure.text(0.5, 0.5, "no steps in this run", ha="center", va="center")
        return figure
    robot = RobotPictures.of(log)
    sight = sight or sight_of(log, robot)
    width, height = sight.upper - sight.lower
    closest = int(np.argmin(log.min_distance)) if np.isfinite(log.min_distance).any() else -1
    columns = min(len(steps), 3)
    rows = -(-len(steps) // columns)
    panel = 3.9 * min(1.0, float(height / width)), 3.9 * min(1.0, float(width / height))
    figure = Figure(
        figsize=(max(panel[1] * columns + 0.3, 7.5), panel[0] * rows + 0.35 * rows + 1.0), layout="constrained"
    )  # fmt: skip
    for ax, step in zip(np.ravel(figure.subplots(rows, columns, squeeze=False)), steps.tolist(), strict=False):
        _draw(ax, log, robot, step, sight)
        ax.set_title(_panel_title(log, step, step == closest), fontsize=9)
    for ax in figure.axes[len(steps) :]:
        ax.set_axis_off()
    figure.legend(handles=_legend(log, steps), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    return figure


def _panel_title(log: Log, step: int, is_closest: bool) -> str:
    title = f"t = {log.t[step]:.2f} s"
    if log.closest_pair[step] < 0:
        return title
    pair = " – ".join(log.meta["pairs"][log.closest_pair[step]])
    return f"{title}{', closest of all' * is_closest}\n{1e3 * log.min_distance[step]:.0f} mm: {pair}"


def instants(log: Log) -> IntArray:
    """Choose steps to draw: first, last, closest approach, and others evenly spread.

    Returns:
        (m,) increasing, m <= PANELS.
    """
    if not len(log.t):
        return np.zeros(0, dtype=np.intp)
    moved = np.abs(np.diff(log.q, axis=0)).sum(axis=1)
    moved += np.nansum(np.abs(np.diff(log.obstacle_position, axis=0)), axis=(1, 2))
    # Half time, half motion: neither a long rest at the end nor a quick dodge takes all the panels.
    progress = np.cumsum(np.r_[0.0, moved / max(moved.sum(), 1e-12) + 1.0 / max(len(moved), 1)])
    steps = np.searchsorted(progress, np.linspace(0.0, progress[-1], PANELS) - 1e-9)
    steps = np.minimum(steps, len(log.t) - 1)
    closest = int(np.argmin(log.min_distance))
    if np.isfinite(log.min_distance[closest]) and closest not in steps:
        steps[1 + np.argmin(np.abs(steps[1:-1] - closest))] = closest
    return np.unique(steps).astype(np.intp)


def sight_of(log: Log, robot: RobotPictures | None = None) -> Sight:
    """Choose the view in which most of the tools are seen and least of the paths is lost, and what fills a panel."""
    robot, steps = robot or RobotPictures.of(log), instants(log)
    points = points_of_interest(log, steps)
    sights = []
    for azimuth in _AZIMUTHS:
        for elevation in _ELEVATIONS:
            projection = Projection.looking(azimuth, elevation)
            flat = projection.flat(points)
            lower, upper = flat.min(axis=0), flat.max(axis=0)
            half = 0.5 * (upper - lower) + _MARGIN * float((upper - lower).max())
            half = np.maximum(half, (max(_LEAST, _NARROWEST * half[1]), max(_LEAST, _FLATTEST * half[0])))
            sights.append(Sight(projection, 0.5 * (lower + upper) - half, 0.5 * (lower + upper) + half))
    paths = np.concatenate((log.target.reshape(-1, 3), *(obstacle_path(log, i) for i in _sized(log))))
    length = max(float(np.linalg.norm(np.ptp(paths, axis=0))), 1e-9) if len(paths) else 1.0

    def value(sight: Sight) -> float:
        visible = (
            np.mean([np.mean(_sees_tools(log, robot, step, sight)) for step in steps]) if log.tool.shape[1] else 1.0
        )
        shown = np.linalg.norm(np.ptp(sight.projection.flat(paths), axis=0)) / length if len(paths) else 1.0
        return float(visible + 0.5 * shown)

    return max(sights, key=value)


def _sees_tools(log: Log, robot: RobotPictures, step: int, sight: Sight) -> Any:
    canvas = Canvas(*sight, _PREVIEW)
    canvas.draw(robot.surfaces(log, step, is_coarse=True))
    canvas.draw([(*triangulated(obstacle_faces(log, i, step)), (0.5, 0.5, 0.5)) for i in _sized(log)])
    return canvas.is_visible(log.tool[step], _BEHIND)


def points_of_interest(log: Log, steps: IntArray) -> Array:
    """Return points (n, 3) that a panel has to show: moving bodies, paths of tools, and obstacles that come near."""
    radii = np.array(log.meta["body_radii"]).reshape(-1, 1, 1)
    moves = np.any(np.ptp(log.body_ends, axis=0) > 1e-3, axis=(1, 2)) if len(radii) else np.zeros(0, bool)
    chosen = moves if moves.any() else np.ones(len(radii), bool)
    ends = log.body_ends[steps][:, chosen]
    points = [log.target.reshape(-1, 3), log.tool.reshape(-1, 3)]
    axes = 0.7 * np.vstack((np.eye(3), -np.eye(3)))  # of the balls at the ends of bodies
    points += [(ends + radii[chosen] * axis).reshape(-1, 3) for axis in axes]
    for i in _sized(log):
        for step in steps:
            corners = obstacle_faces(log, i, int(step)).reshape(-1, 3)
            if len(corners) and _gap(corners, log.body_ends[step], radii) < _NEAR:
                points.append(corners)
    cloud = np.concatenate(points)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    return cloud if len(cloud) else np.zeros((1, 3))


def _gap(corners: Array, ends: Array, radii: Array) -> float:
    """Return about how far corners (n, 3) of an obstacle are from bodies with axis ends (b, 2, 3) [m]."""
    axes = np.linspace(ends[:, 0], ends[:, 1], 5)
    gaps = np.linalg.norm(axes[:, :, None] - corners[:: max(1, len(corners) // 200)], axis=-1) - radii[None, :, :, 0]
    return float(gaps.min(initial=np.inf))


def _sized(log: Log) -> list[int]:
    """Return the numbers of the obstacles that are not endless."""
    return [i for i in range(len(log.meta["obstacles"])) if not is_endless(log, i)]


def _draw(ax: Any, log: Log, robot: RobotPictures, step: int, sight: Sight) -> None:
    """Draw one step."""
    projection, lower, upper = sight
    canvas = Canvas(*sight, PIXELS)
    canvas.draw(robot.surfaces(log, step))
    for i, described in enumerate(log.meta["obstacles"]):
        colour = rgb(GROUND) if is_endless(log, i) else OBSTACLES[i % len(OBSTACLES)]
        canvas.draw([(*triangulated(obstacle_faces(log, i, step)), colour)])
        outline = inflated_outline(log, i, step, projection.flat, _safety_distance(log))
        if outline is not None and described["name"]:
            ax.add_patch(Polygon(outline, fill=False, edgecolor=colour, linewidth=1.0, linestyle=(0, (3, 2)), zorder=3))
    extent = (lower[0], upper[0], lower[1], upper[1])
    ax.imshow(canvas.picture(), extent=extent, interpolation="antialiased", zorder=1)
    for i in _sized(log):
        path = projection.flat(obstacle_path(log, i))
        ax.plot(*path.T, color=OBSTACLES[i % len(OBSTACLES)], linewidth=1.2, alpha=0.9, zorder=2)
    for k in range(log.tool.shape[1]):  # on top of the bodies, so that no part of them is hidden
        ax.plot(*projection.flat(log.target[:, k]).T, color="black", linestyle=(0, (4, 2)), linewidth=1.0, zorder=4)
        ax.plot(*projection.flat(log.tool[: step + 1, k]).T, color=TOOL_PATH, linewidth=1.8, zorder=5)
        ax.plot(*projection.flat(log.tool[step, k, None]).T, color=TOOL_PATH, marker="o", markersize=4, zorder=6)
    ax.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[], aspect="equal", facecolor=_BACKGROUND)
    for spine in ax.spines.values():
        spine.set_visible(False)
    _add_scale(ax, float(upper[0] - lower[0]))


def _add_scale(ax: Any, width: float) -> None:
    """Add a bar of a round length to a panel of some width [m]."""
    length = max((x for x in (0.05, 0.1, 0.2, 0.5, 1.0) if x < 0.4 * width), default=0.05)
    start = 0.03
    style = {"transform": ax.transAxes, "color": "#555555"}
    ax.plot([start, start + length / width], [start, start], linewidth=2.0, zorder=7, **style)
    ax.text(start, start + 0.015, f"{length:g} m", fontsize=7, **style)


def _safety_distance(log: Log) -> float:
    """Return d1 between surfaces [m]."""
    avoidance = log.meta["config"]["avoidance"]
    return float(avoidance["d1"] - avoidance["offset"])


def _obstacle_label(log: Log, index: int) -> str:
    return str(log.meta["obstacles"][index]["name"]) + " and its path" * (len(obstacle_path(log, index)) > 1)


def _legend(log: Log, steps: IntArray) -> list[Any]:
    obstacles = [(True, Patch(color=OBSTACLES[i % len(OBSTACLES)], label=_obstacle_label(log, i))) for i in _sized(log)]
    around = Line2D(
        [], [], color="#555555", linestyle=(0, (3, 2)), linewidth=1.0, label=f"d1 = {_safety_distance(log):.3g} m"
    )
    entries = [
        *obstacles[:8],
        (bool(obstacles), around),
        ((log.body_distance[steps] < 0.0).any(), Patch(color=COLLISION, label="link in contact")),
        (True, Line2D([], [], color="black", linestyle=(0, (4, 2)), linewidth=1.0, label="planned path")),
        (True, Line2D([], [], color=TOOL_PATH, marker="o", markersize=4, label="tool and its path so far")),
    ]
    return [handle for is_present, handle in entries if is_present]
