"""The picture of a description: a robot's geometry with the bodies that enclose it over it, from two sides."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial import ConvexHull

from qpavoid.config import Body, Hull
from qpavoid.geometry.bodies import hull_points
from qpavoid.model.joints import frame_index
from qpavoid.problem import Array
from qpavoid.setup.add import Description
from qpavoid.setup.fit import triangles
from qpavoid.setup.texts import volume_line
from qpavoid.setup.written import BLANK, seal
from qpavoid.viz.motion import normals, shade, shape_faces, towards_viewer

_VIEWS = ((15.0, -50.0), (15.0, 130.0))
"""Elevation and azimuth [deg]."""
_MESH, _CAPSULE, _EXACT = "#6E6E6E", "#0072B2", "#E69F00"
_OVER = 0.3
"""Opacity of bodies."""
_GRID = 250
"""Cells along the longest side of a robot: corners of meshes in one cell are drawn as one."""


def bodies_picture(description: Description) -> bytes:
    """Draw the robot at its home pose: a PNG, sealed.

    Args:
        description: what `robot add` worked out.
    """
    meshes, capsules, exact = _surfaces(description)
    cloud = np.concatenate([faces.reshape(-1, 3) for faces in (meshes, capsules, exact)])
    lower, upper = (cloud.min(axis=0), cloud.max(axis=0)) if len(cloud) else (-np.ones(3), np.ones(3))
    size = np.maximum(upper - lower, 0.1 * float(np.max(upper - lower)) + 1e-6)
    meshes = _coarser(meshes, float(np.max(size)) / _GRID)
    figure = Figure(figsize=(11.0, 7.0), dpi=110)
    figure.suptitle(f"{description.config.name}; bodies: {volume_line(description)}", fontsize=10)
    for index, (elevation, azimuth) in enumerate(_VIEWS):
        ax: Any = figure.add_axes(
            (0.5 * index - 0.05, 0.02, 0.6, 0.98), projection="3d", proj_type="ortho", computed_zorder=False
        )
        ax.set_axis_off()
        ax.patch.set_visible(False)
        ax.view_init(elevation, azimuth)
        towards = towards_viewer(elevation, azimuth)
        _paint(ax, [(meshes, _MESH)], 1.0, towards, 1)
        # bodies in one collection: faces are sorted by depth within a collection only
        _paint(ax, [(capsules, _CAPSULE), (exact, _EXACT)], _OVER, towards, 2)
        middle = 0.5 * (lower + upper)
        ax.set(**{f"{axis}lim": (m - 0.5 * s, m + 0.5 * s) for axis, m, s in zip("xyz", middle, size, strict=True)})
        ax.set_box_aspect(tuple(size), zoom=1.0)  # which scales an array in place
    entries = ((_MESH, 1.0, "geometry"), (_CAPSULE, _OVER, "capsules, spheres"), (_EXACT, _OVER, "hulls, primitives"))
    handles = [Patch(color=to_rgba(colour, opacity), label=label) for colour, opacity, label in entries]
    figure.legend(handles=handles, loc="lower center", ncols=3, fontsize=9, frameon=False)
    file = BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return seal(file.getvalue() + f"\n{BLANK}\n".encode())  # readers stop before what comes after the image


def _paint(ax: Any, layers: list[tuple[Array, str]], opacity: float, towards: Array, order: int) -> None:
    """Draw solid faces; of translucent ones those that face the viewer.

    Meshes may be inside out.
    """
    faces = np.concatenate([layer for layer, _ in layers])
    colours = np.concatenate([shade(layer, colour, towards) for layer, colour in layers])
    front = (normals(faces) @ towards > 0.0) | (opacity == 1.0)
    if front.any():
        rgba = np.c_[colours, np.full(len(faces), opacity)][front]
        ax.add_collection3d(Poly3DCollection(faces[front], facecolors=rgba, edgecolors="none", zorder=order))


def _surfaces(description: Description) -> tuple[Array, Array, Array]:
    """Return quadrilaterals (m, 4, 3) of geometry, capsules and exact bodies at home [m].

    Spheres count as capsules.
    """
    robot = description.robot
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.home)

    def in_world(faces: Array, link: str, placement: Any) -> Array:
        pose = data.oMf[frame_index(robot.model, link)] * placement
        return np.asarray(faces @ pose.rotation.T + pose.translation)

    meshes = [in_world(_piece_faces(piece.geometry), piece.link, piece.placement) for piece in description.pieces]
    pieces = {piece.name: piece for piece in description.pieces}
    capsules: list[Array] = []
    exact: list[Array] = []
    for body, live in zip(description.config.bodies, robot.bodies.geometryObjects, strict=True):
        assert isinstance(body, Body)
        in_link = robot.model.frames[live.parentFrame].placement.actInv(live.placement)
        if isinstance(body.shape, Hull):
            piece = pieces[body.shape.geometry]
            exact.append(in_world(_hull_faces(hull_points(piece.geometry)), piece.link, piece.placement))
            continue
        faces = in_world(shape_faces(body.shape.model_dump()), body.frame, in_link)
        (capsules if body.shape.type in ("capsule", "sphere") else exact).append(faces)
    none = np.zeros((0, 4, 3))
    return np.concatenate([none, *meshes]), np.concatenate([none, *capsules]), np.concatenate([none, *exact])


def _piece_faces(geometry: Any) -> Array:
    if isinstance(geometry, coal.BVHModelBase):
        return _as_quads(triangles(geometry))
    if isinstance(geometry, coal.Box):
        return shape_faces({"type": "box", "size": 2.0 * np.array(geometry.halfSide)})
    if isinstance(geometry, coal.Sphere | coal.Capsule | coal.Cylinder):
        kind = "cylinder" if isinstance(geometry, coal.Cylinder) else "capsule"
        length = 2.0 * getattr(geometry, "halfLength", 0.0)
        return shape_faces({"type": kind, "radius": geometry.radius, "length": length})
    return _hull_faces(hull_points(geometry))


def _hull_faces(points: Array) -> Array:
    hull = ConvexHull(points, qhull_options="QJ")
    corners = points[hull.simplices]
    inside = points[hull.vertices].mean(axis=0)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ti,ti->t", normal, corners[:, 0] - inside) < 0.0
    corners[inward] = corners[inward][:, ::-1]
    return _as_quads(corners)


def _as_quads(corners: Array) -> Array:
    return np.asarray(corners[:, [0, 1, 2, 2]])


def _coarser(faces: Array, cell: float) -> Array:
    """Coarsen faces for a picture: corners on a grid.

    Faces that vanish or coincide are left out.
    """
    if not len(faces):
        return faces
    index = np.round(faces / cell).astype(np.int64)
    number = np.sort(np.unique(index.reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1, 4), axis=1)
    index = index[(number[:, 1:] != number[:, :-1]).sum(axis=1) >= 2]
    return np.asarray(cell * np.unique(index, axis=0))
