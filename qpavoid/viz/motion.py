"""Robots among obstacles, in 3-D at several instants (the paper's Figs. 6, 9, 10, 12, 15)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from qpavoid.problem import Array, IntArray
from qpavoid.run.log import Log
from qpavoid.viz.style import AT_REST, COLLISION, GROUND, MOVING, OBSTACLE, TOOL_PATH
from qpavoid.viz.surfaces import capsule_faces, is_endless, moving_bodies, obstacle_faces

PANELS = 6
_ELEVATION, _AZIMUTH = 25.0, -45.0
"""View [deg]; it looks along no axis, which would take the depth away, and is the same for all solvers."""


def motion_figure(log: Log) -> Figure:
    """Draw bodies, obstacles and paths at up to six instants with one view and scale.

    Bodies are drawn as the capsules of the log, which enclose whatever shape the robot's bodies have.
    """
    steps = instants(log)
    if not len(steps):
        figure = Figure(figsize=(6, 2))
        figure.text(0.5, 0.5, "no steps in this run", ha="center", va="center")
        return figure
    closest = int(np.argmin(log.min_distance)) if np.isfinite(log.min_distance).any() else -1
    lower, upper = _limits(log, steps)
    columns = min(len(steps), 3)
    rows = -(-len(steps) // columns)
    figure = Figure(figsize=(max(3.7 * columns, 7.5), 3.9 * rows + 0.9))
    figure.subplots_adjust(left=0.04, right=0.96, top=1.0 - 0.75 / figure.get_figheight(), bottom=0.06, hspace=0.12)
    for i, step in enumerate(steps):
        ax: Any = figure.add_subplot(rows, columns, i + 1, projection="3d", proj_type="ortho", computed_zorder=False)
        ax.patch.set_visible(False)
        ax.view_init(_ELEVATION, _AZIMUTH)
        _draw(ax, log, int(step), lower, upper)
        ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
        ax.set_box_aspect(upper - lower, zoom=1.2)
        closest_mark = " (closest)" if step == closest else ""
        ax.set_title(f"t = {log.t[step]:.2f} s{closest_mark}", fontsize=10, pad=0)
        for axis, name, size in zip((ax.xaxis, ax.yaxis, ax.zaxis), "xyz", upper - lower, strict=True):
            axis.set_major_locator(MaxNLocator(1 + int(2.5 * size / np.max(upper - lower)), steps=[1, 2, 5, 10]))
            axis.set_tick_params(labelsize=7, pad=-1)
            axis.set_label_text(f"{name} [m]", fontsize=8)
            axis.labelpad = -4
            axis.set_pane_color((0.97, 0.97, 0.97, 1.0))
    figure.legend(handles=_legend(log, steps), loc="lower center", ncols=6, fontsize=8, frameon=False)
    return figure


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


def _limits(log: Log, steps: IntArray) -> tuple[Array, Array]:
    """Return corners (3,), (3,) of the box that holds robot, obstacles and paths at some steps [m]."""
    radii = np.array(log.meta["body_radii"]).reshape(-1, 1, 1)
    points = [log.target.reshape(-1, 3), log.tool.reshape(-1, 3)]
    points += [(log.body_ends[steps] + sign * radii).reshape(-1, 3) for sign in (-1.0, 1.0)]
    sized = [i for i in range(len(log.meta["obstacles"])) if not is_endless(log, i)]
    points += [obstacle_faces(log, i, t).reshape(-1, 3) for i in sized for t in steps]
    cloud = np.concatenate(points)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    lower, upper = (cloud.min(axis=0), cloud.max(axis=0)) if len(cloud) else (-np.ones(3), np.ones(3))
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    half = np.maximum(1.02 * half, 0.25 * max(float(np.max(half)), 0.05))
    return middle - half, middle + half


def _draw(ax: Any, log: Log, step: int, lower: Array, upper: Array) -> None:
    """Draw one step within two corners (3,) [m]."""
    moving, touching = moving_bodies(log), log.body_distance[step] < 0.0
    surfaces = []
    for i, radius in enumerate(log.meta["body_radii"]):
        # A little thicker when hit: neighbours share the ball at their joint, and its colour would be patchy.
        faces = capsule_faces(log.body_ends[step, i], 1.06 * radius if touching[i] else radius)
        surfaces.append((faces, COLLISION if touching[i] else MOVING if moving[i] else AT_REST))
    for i in range(len(log.meta["obstacles"])):
        faces, colour = obstacle_faces(log, i, step), OBSTACLE
        if is_endless(log, i):
            faces, colour = faces[((faces >= lower) & (faces <= upper)).all(axis=(1, 2))], GROUND
        surfaces.append((faces, colour))
    if any(len(faces) for faces, _ in surfaces):
        # One collection for all: matplotlib sorts faces by depth within a collection only.
        faces = np.concatenate([faces for faces, _ in surfaces])
        colours = np.repeat([colour for _, colour in surfaces], [len(faces) for faces, _ in surfaces])
        style = {"facecolors": colours, "edgecolors": colours, "linewidths": 0.3, "zorder": 1, "clip_on": False}
        light = LightSource(azdeg=60.0 - ax.azim, altdeg=55.0)  # from the viewer's side and from above
        ax.add_collection3d(Poly3DCollection(faces, shade=True, lightsource=light, **style))
    # Paths lie on top of the bodies, so that no part of them is hidden.
    for k in range(log.tool.shape[1]):
        ax.plot(*log.target[:, k].T, color="black", linestyle=(0, (4, 2)), linewidth=1.0, zorder=2)
        ax.plot(*log.tool[: step + 1, k].T, color=TOOL_PATH, linewidth=1.8, zorder=3)
        ax.plot(*log.tool[step, k, :, None], color=TOOL_PATH, marker="o", markersize=4, zorder=4)


def _legend(log: Log, steps: IntArray) -> list[Any]:
    moving = moving_bodies(log)
    entries = [
        (moving.any(), Patch(color=MOVING, label="moving bodies")),
        ((~moving).any(), Patch(color=AT_REST, label="bodies at rest")),
        ((log.body_distance[steps] < 0.0).any(), Patch(color=COLLISION, label="bodies in collision")),
        (log.meta["obstacles"], Patch(color=OBSTACLE, label="obstacle")),
        (True, Line2D([], [], color="black", linestyle=(0, (4, 2)), linewidth=1.0, label="planned path")),
        (True, Line2D([], [], color=TOOL_PATH, marker="o", markersize=4, label="tool and its path so far")),
    ]
    return [handle for is_present, handle in entries if is_present]
