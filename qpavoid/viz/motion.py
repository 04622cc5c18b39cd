"""Robots among obstacles, in 3-D at several instants (the paper's Figs. 6, 9, 10, 12, 15)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from qpavoid.geometry.segments import point_segment_distance, segment_segment_distance
from qpavoid.problem import Array, IntArray
from qpavoid.run.log import Log

MOVING_COLOUR = "#6BA3D6"
AT_REST_COLOUR = "#C4C4C4"
COLLISION_COLOUR = "#C62F2F"
OBSTACLE_COLOUR = "#E69F00"
TOOL_PATH_COLOUR = "#007A56"
GROUND_COLOUR = "#EFE3C8"
PANELS = 6
_PANEL = np.array([3.0, 2.9])  # largest width and height of a panel on paper [in]
_TICK = 0.35  # of an axis on paper for each of its numbers, which would overlap otherwise [in]
_AROUND, _ARC = 28, 8
_PATCHES = 200  # of each obstacle, of which it is judged what it hides


def motion_figure(log: Log) -> Figure:
    """Draw bodies, obstacles and paths at up to six instants with one view and scale.

    Bodies are drawn as the capsules of the log, which enclose whatever shape the robot's bodies have.
    """
    ticks = instants(log)
    if not len(ticks):
        figure = Figure(figsize=(6, 2))
        figure.text(0.5, 0.5, "no ticks in this run", ha="center", va="center")
        return figure
    closest = int(np.argmin(log.min_distance)) if np.isfinite(log.min_distance).any() else -1
    lower, upper = _limits(log, ticks)
    size = upper - lower
    elevation, azimuth = view_angles(log)
    towards = towards_viewer(elevation, azimuth)
    # Size of the drawn box on paper. An Axes3D is a square of 0.97 times the box's diagonal, mostly empty: the squares
    # overlap, so that the boxes lie side by side.
    right = np.array([-np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth)), 0.0])
    extent = np.array([np.abs(right) @ size, np.abs(np.cross(towards, right)) @ size])
    scale = min(_PANEL / extent)
    cell_width, cell_height = scale * extent + (1.1, 0.95)
    square = 0.97 * scale * float(np.linalg.norm(size))
    columns = min(len(ticks), 3)
    rows = -(-len(ticks) // columns)
    width, height = max(columns * cell_width, 7.5), rows * cell_height + 0.85
    figure = Figure(figsize=(width, height))
    for i, tick in enumerate(ticks):
        row, column = divmod(i, columns)
        x = 0.5 * (width - columns * cell_width) + (column + 0.5) * cell_width
        y = 0.45 + (rows - row - 0.55) * cell_height
        box = ((x - square / 2) / width, (y - square / 2) / height, square / width, square / height)
        ax: Any = figure.add_axes(box, projection="3d", proj_type="ortho", computed_zorder=False)
        ax.patch.set_visible(False)
        ax.view_init(elevation, azimuth)
        _draw(ax, log, int(tick), towards, lower, upper)
        ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
        ax.set_box_aspect(size)
        title = f"t = {log.t[tick]:.2f} s" + (" (closest)" if tick == closest else "")
        ax.set_title(title, fontsize=10, y=0.5 + (0.5 * scale * extent[1] + 0.36) / square, pad=0)
        for k, axis in enumerate((ax.xaxis, ax.yaxis, ax.zaxis)):
            on_paper = scale * size[k] * np.sqrt(1.0 - towards[k] ** 2)
            axis.set_major_locator(MaxNLocator(int(np.clip(on_paper / _TICK, 1, 4)), steps=[1, 2, 5, 10]))
            axis.set_tick_params(labelsize=7, pad=2 if k == 2 else -1)  # upright: a minus would lie on its line
            axis.set_label_text(f"{'xyz'[k]} [m]", fontsize=8)
            axis.labelpad = -1.5
            axis.set_pane_color((0.97, 0.97, 0.97, 1.0))
    figure.legend(handles=_legend(log, ticks), loc="lower center", ncols=6, fontsize=8, frameon=False)
    return figure


def instants(log: Log) -> IntArray:
    """Choose steps to draw: first, last, closest approach, and others evenly spread.

    Returns:
        (m,) increasing, m <= PANELS.
    """
    if not len(log.t):
        return np.zeros(0, dtype=np.intp)
    moved = np.abs(np.diff(log.q, axis=0)).sum(axis=1) + np.abs(np.diff(log.obstacle_position, axis=0)).sum((1, 2))
    # Half time, half motion: neither a long rest at the end nor a quick dodge takes all the panels.
    progress = np.cumsum(np.r_[0.0, moved / max(moved.sum(), 1e-12) + 1.0 / max(len(moved), 1)])
    ticks = np.searchsorted(progress, np.linspace(0.0, progress[-1], PANELS) - 1e-9)
    ticks = np.minimum(ticks, len(log.t) - 1)
    closest = int(np.argmin(log.min_distance))
    if np.isfinite(log.min_distance[closest]) and closest not in ticks:
        ticks[1 + np.argmin(np.abs(ticks[1:-1] - closest))] = closest
    return np.unique(ticks).astype(np.intp)


def moving_bodies(log: Log) -> Any:
    """Return for each body (b,) whether it moves by more than 1 mm in the run."""
    return np.any(np.ptp(log.body_ends, axis=0) > 1e-3, axis=(1, 2)) if len(log.t) else np.zeros(0, bool)


# --- surfaces -----------------------------------------------------------------------------------------------


def shape_faces(shape: dict[str, Any]) -> Array:
    """Return outward quadrilaterals (m, 4, 3) of a shape in its own frame [m].

    Of a half-space they are a square of its plane.
    """
    if shape["type"] == "box":
        return _box_faces(np.array(shape["size"]))
    if shape["type"] == "ellipsoid":
        return np.asarray(shape_faces({"type": "sphere", "radius": 1.0}) * np.array(shape["radii"]))
    if shape["type"] == "half_space":
        return _box_faces(np.array([_PLANE, _PLANE, 0.0]), 40)[-1600:]
    radius, half = shape["radius"], 0.5 * shape.get("length", 0.0)
    if shape["type"] == "cone":
        side = np.linspace(0.0, 1.0, _ARC)
        profile_r, profile_z = np.r_[0.0, radius * (1.0 - side)], np.r_[-half, half * (2.0 * side - 1.0)]
    elif shape["type"] == "cylinder":
        side = np.linspace(-half, half, _ARC)
        profile_r, profile_z = np.r_[0.0, np.full(_ARC, radius), 0.0], np.r_[-half, side, half]
    else:
        angle = np.linspace(-0.5 * np.pi, 0.0, _ARC)
        profile_r = radius * np.r_[np.cos(angle), np.cos(angle[::-1])]
        profile_z = np.r_[radius * np.sin(angle) - half, half - radius * np.sin(angle[::-1])]
    return _revolve(profile_r, profile_z)


def capsule_faces(ends: Array, radius: float) -> Array:
    """Return outward quadrilaterals (m, 4, 3) of a capsule about a segment (2, 3) [m]."""
    axis = ends[1] - ends[0]
    length = float(np.linalg.norm(axis))
    z = axis / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    rotation = np.column_stack([x, np.cross(z, x), z])
    faces = shape_faces({"type": "capsule", "radius": radius, "length": length})
    return np.asarray(faces @ rotation.T + ends.mean(axis=0))


def _revolve(radius: Array, height: Array) -> Array:
    """Return quadrilaterals (m, 4, 3) of a profile of radius and height revolved about z."""
    angle = np.linspace(0.0, 2.0 * np.pi, _AROUND + 1)
    grid = np.stack(
        [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.outer(height, np.ones_like(angle))], -1
    )
    corners = [grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]]
    return np.stack(corners, axis=2).reshape(-1, 4, 3)


def _box_faces(size: Array, cuts: int = 6) -> Array:
    # Cut up, because faces are painted from back to front by their middle.
    """Return quadrilaterals (m, 4, 3) of a box of full side lengths `size` (3,) [m], `cuts` by `cuts` a side."""
    u, v = np.meshgrid(np.linspace(-1, 1, cuts + 1), np.linspace(-1, 1, cuts + 1), indexing="ij")
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            grid = np.empty((cuts + 1, cuts + 1, 3))
            grid[..., axis], grid[..., (axis + 1) % 3], grid[..., (axis + 2) % 3] = sign, sign * u, v
            corners = [grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]]
            faces.append(np.stack(corners, axis=2).reshape(-1, 4, 3))
    return np.concatenate(faces) * 0.5 * size


_PLANE = 4.0
"""Side of the square that is drawn of the plane of a half-space [m]: twice the span of a large arm."""


def local_faces(obstacle: dict[str, Any]) -> Array:
    """Return outward quadrilaterals (m, 4, 3) of an obstacle of the log in its own frame [m]."""
    if "triangles" in obstacle:
        triangles = np.array(obstacle["triangles"]).reshape(-1, 3, 3)
        return triangles[:, [0, 1, 2, 2]]
    if "voxels" in obstacle:
        voxel = _box_faces(np.full(3, obstacle["shape"]["resolution"]), 1)
        return np.asarray(voxel + np.array(obstacle["voxels"]).reshape(-1, 1, 1, 3)).reshape(-1, 4, 3)
    return shape_faces(obstacle["shape"])


def obstacle_faces(log: Log, index: int, tick: int) -> Array:
    """Return outward quadrilaterals (m, 4, 3) of an obstacle at a step, in world axes [m]."""
    faces = local_faces(log.meta["obstacles"][index])
    return np.asarray(faces @ log.obstacle_rotation[tick, index].T + log.obstacle_position[tick, index])


def is_endless(log: Log, index: int) -> bool:
    """Return True if an obstacle is a half-space, which has neither size nor middle."""
    return bool(log.meta["obstacles"][index]["shape"]["type"] == "half_space")


# --- view ---------------------------------------------------------------------------------------------------


def towards_viewer(elevation: float, azimuth: float) -> Array:
    """Return the unit vector (3,) from the scene to the viewer; angles in degrees."""
    e, a = np.radians([elevation, azimuth])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def view_angles(log: Log) -> tuple[float, float]:
    """Choose elevation and azimuth [deg] that hide least of path, robot and obstacles.

    Each candidate is scored by the share of points of interest that nothing else hides, times how much of the path's
    extent is not foreshortened. None looks straight along an axis, which would take the depth away. Only what all
    solvers share goes in (the robot at the start, the plan and the obstacles), so that their figures have one view.
    """
    path = log.target[np.linspace(0, len(log.t) - 1, 2 * PANELS).astype(int)].reshape(-1, 3)
    spread = path - path.mean(axis=0)
    size = np.linalg.norm(spread)
    bodies, thickness = log.body_ends[0], np.array(log.meta["body_radii"])
    middles, patches, radii, is_foreign = _occluders(log)
    points = np.concatenate([path, bodies.mean(axis=1), bodies[:, 1], middles])[:, None]
    own = point_segment_distance(points, bodies[:, 0], bodies[:, 1]) < 1.3 * thickness
    to_patches = patches - points
    squared = np.sum(to_patches**2, axis=2)
    is_screen = squared > (1.3 * radii) ** 2
    is_screen[len(points) - len(middles) :] &= is_foreign
    best, best_score = (20.0, -45.0), -1.0
    for elevation in (20.0, 35.0):
        for azimuth in (-25.0, 25.0, -45.0, 45.0, -65.0, 65.0, -115.0, 115.0, -135.0, 135.0, -155.0, 155.0):
            towards = towards_viewer(elevation, azimuth)
            ray = segment_segment_distance(points, points + 10.0 * towards, bodies[:, 0], bodies[:, 1])
            along = to_patches @ towards
            is_hidden = is_screen & (along > 0.0) & (squared - along**2 < radii**2)
            hidden = np.any((ray < thickness) & ~own, axis=1) | np.any(is_hidden, axis=1)
            visible_fraction = 1.0 - float(np.mean(hidden))
            length = float(np.linalg.norm(spread - np.outer(spread @ towards, towards)) / size) if size > 1e-6 else 1.0
            score = (
                visible_fraction**2 * length * (0.94 if abs(azimuth) > 90.0 else 1.0)
            )  # rather from before the robot
            if score > best_score + 1e-9:
                best, best_score = (elevation, azimuth), score
    return best


def _occluders(log: Log) -> tuple[Array, Array, Array, Any]:
    """Sample patches of the obstacles' surfaces, which may hide other things.

    Returns:
        middles (n, 3) [m] of the obstacles, patches (m, 3) [m], radius of each (m,) [m], and (n, m) whether a patch is
        of another obstacle.
    """
    rng, ticks = np.random.default_rng(0), np.linspace(0, len(log.t) - 1, PANELS).astype(int)
    middles, patches, radii, owner = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, int)]
    sized = [i for i in range(len(log.meta["obstacles"])) if not is_endless(log, i)]
    for i in sized:
        faces = local_faces(log.meta["obstacles"][i])
        area = 0.5 * np.linalg.norm(np.cross(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1]), axis=1)
        if not area.sum() > 0.0:
            continue
        patch_centers = faces[rng.choice(len(faces), _PATCHES, p=area / area.sum())].mean(axis=1)
        for tick in ticks if np.ptp(log.obstacle_position[:, i], axis=0).any() else ticks[:1]:
            patches.append(patch_centers @ log.obstacle_rotation[tick, i].T + log.obstacle_position[tick, i])
            middles.append(np.mean(patches[-1], axis=0, keepdims=True))
            # Patches drawn at random overlap: of 2.5 times the area in all, they leave 8 % of it free.
            radii.append(np.full(_PATCHES, np.sqrt(2.5 * area.sum() / _PATCHES / np.pi)))
            owner.append(np.full(_PATCHES, i))
    owners = np.concatenate(owner)
    return np.concatenate(middles), np.concatenate(patches), np.concatenate(radii), owners[::_PATCHES, None] != owners


def _limits(log: Log, ticks: IntArray) -> tuple[Array, Array]:
    """Return corners (3,), (3,) of the box that holds robot, obstacles and paths at some steps [m]."""
    radii = np.array(log.meta["body_radii"]).reshape(-1, 1, 1)
    points = [log.target.reshape(-1, 3), log.tool.reshape(-1, 3)]
    points += [(log.body_ends[ticks] + sign * radii).reshape(-1, 3) for sign in (-1.0, 1.0)]
    sized = [i for i in range(len(log.meta["obstacles"])) if not is_endless(log, i)]
    points += [obstacle_faces(log, i, t).reshape(-1, 3) for i in sized for t in ticks]
    cloud = np.concatenate(points)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    lower, upper = (cloud.min(axis=0), cloud.max(axis=0)) if len(cloud) else (-np.ones(3), np.ones(3))
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    half = np.maximum(1.02 * half, 0.25 * max(float(np.max(half)), 0.05))
    return middle - half, middle + half


# --- drawing ------------------------------------------------------------------------------------------------


def _draw(ax: Any, log: Log, tick: int, towards: Array, lower: Array, upper: Array) -> None:
    """Draw one step, seen from the direction `towards` (3,), within two corners (3,) [m]."""
    moving, touching = moving_bodies(log), log.body_distance[tick] < 0.0
    surfaces = []
    for i, radius in enumerate(log.meta["body_radii"]):
        # A little thicker when hit: neighbours share the ball at their joint, and its colour would be patchy.
        faces = capsule_faces(log.body_ends[tick, i], 1.06 * radius if touching[i] else radius)
        surfaces.append((faces, COLLISION_COLOUR if touching[i] else MOVING_COLOUR if moving[i] else AT_REST_COLOUR))
    for i in range(len(log.meta["obstacles"])):
        faces = obstacle_faces(log, i, tick)
        if is_endless(log, i):
            faces = faces[((faces >= lower) & (faces <= upper)).all(axis=(1, 2))]
        surfaces.append((faces, GROUND_COLOUR if is_endless(log, i) else OBSTACLE_COLOUR))
    if surfaces:
        # One collection for all: matplotlib sorts faces by depth within a collection only.
        faces = np.concatenate([faces for faces, _ in surfaces])
        colours = np.concatenate([shade(faces, colour, towards) for faces, colour in surfaces])
        front = normals(faces) @ towards > -0.02
        faces, colours = faces[front], colours[front]
        ax.add_collection3d(Poly3DCollection(faces, facecolors=colours, edgecolors=colours, linewidths=0.3, zorder=1))
    # Paths lie on top of the bodies, so that no part of them is hidden.
    for k in range(log.tool.shape[1]):
        ax.plot(*log.target[:, k].T, color="black", linestyle=(0, (4, 2)), linewidth=1.0, zorder=2)
        ax.plot(*log.tool[: tick + 1, k].T, color=TOOL_PATH_COLOUR, linewidth=1.8, zorder=3)
        ax.plot(*log.tool[tick, k, :, None], color=TOOL_PATH_COLOUR, marker="o", markersize=4, zorder=4)


def normals(faces: Array) -> Array:
    """Return unit normals (m, 3) of quadrilaterals (m, 4, 3)."""
    normal = np.cross(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1])
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-15))


def shade(faces: Array, colour: str, towards: Array) -> Array:
    """Return colours (m, 3) of faces (m, 4, 3) lit from the viewer's side and from above."""
    light = towards + np.array([0.0, 0.0, 0.7])
    brightness = 0.55 + 0.5 * np.clip(normals(faces) @ (light / np.linalg.norm(light)), 0.0, 1.0)
    return np.asarray(np.clip(brightness[:, None] * to_rgb(colour), 0.0, 1.0))


def _legend(log: Log, ticks: IntArray) -> list[Any]:
    moving = moving_bodies(log)
    entries = [
        (moving.any(), Patch(color=MOVING_COLOUR, label="moving bodies")),
        ((~moving).any(), Patch(color=AT_REST_COLOUR, label="bodies at rest")),
        ((log.body_distance[ticks] < 0.0).any(), Patch(color=COLLISION_COLOUR, label="bodies in collision")),
        (log.meta["obstacles"], Patch(color=OBSTACLE_COLOUR, label="obstacle")),
        (True, Line2D([], [], color="black", linestyle=(0, (4, 2)), linewidth=1.0, label="planned path")),
        (True, Line2D([], [], color=TOOL_PATH_COLOUR, marker="o", markersize=4, label="tool and its path so far")),
    ]
    return [handle for is_present, handle in entries if is_present]
