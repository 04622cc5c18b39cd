"""Triangle meshes of robots and obstacles with their colours, as the live view and films show them."""

from __future__ import annotations

from typing import Any, NamedTuple

import coal
import numpy as np
import numpy.typing as npt

from qpavoid.errors import ConfigError
from qpavoid.geometry.bodies import surface_triangles
from qpavoid.model.visuals import GREY, Visual
from qpavoid.problem import Array
from qpavoid.viz.style import OBSTACLES
from qpavoid.viz.surfaces import local_faces, shape_faces

_GROUND = (0.93, 0.90, 0.84)


class Mesh(NamedTuple):
    """Triangles of one colour."""

    vertices: npt.NDArray[np.float32]
    """(n, 3) [m]."""
    faces: npt.NDArray[np.uint32]
    """(t, 3) corners of each triangle, counter-clockwise from outside."""
    colour: tuple[float, ...]
    """Red, green, blue, opacity, 0 to 1."""


EMPTY = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32), (0.0, 0.0, 0.0, 1.0))


def of_quadrilaterals(quadrilaterals: Array, colour: tuple[float, ...]) -> Mesh:
    """Return quadrilaterals (m, 4, 3) [m] as a mesh; corners at the same place become one."""
    corners = np.round(np.asarray(quadrilaterals, dtype=np.float32).reshape(-1, 3), 6)
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    a, b, c, d = index.reshape(-1, 4).T
    faces = np.concatenate((np.stack((a, b, c), axis=1), np.stack((a, c, d), axis=1)))
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Mesh(vertices, faces[proper].astype(np.uint32), colour)


def of_geometry(geometry: Any, colour: tuple[float, ...]) -> Mesh:
    """Return a coal geometry as a mesh; of a half-space, a square of its plane."""
    match geometry:
        case coal.Sphere():
            shape: dict[str, Any] = {"type": "sphere", "radius": geometry.radius}
        case coal.Capsule() | coal.Cylinder() | coal.Cone():
            kind = type(geometry).__name__.lower()
            shape = {"type": kind, "radius": geometry.radius, "length": 2.0 * geometry.halfLength}
        case coal.Box():
            shape = {"type": "box", "size": 2.0 * np.asarray(geometry.halfSide)}
        case coal.Ellipsoid():
            shape = {"type": "ellipsoid", "radii": geometry.radii}
        case coal.Halfspace():
            shape = {"type": "half_space"}
        case _:
            return of_quadrilaterals(surface_triangles(geometry)[:, [0, 1, 2, 2]], colour)
    return of_quadrilaterals(shape_faces(shape), colour)


def of_obstacle(description: dict[str, Any], index: int) -> Mesh:
    """Return an obstacle of a log, or of `describe_obstacle`, as a mesh."""
    endless = description["shape"]["type"] == "half_space"
    colour = _GROUND if endless else OBSTACLES[index % len(OBSTACLES)]
    return of_quadrilaterals(local_faces(description), (*colour, 1.0))


def of_visual(visual: Visual) -> list[Mesh]:
    """Return a visual shape as meshes, one for each colour; none where its file cannot be read.

    Raises:
        ConfigError: the readers of meshes are not installed.
    """
    if not visual.path:
        return [of_geometry(visual.geometry, visual.colour or GREY)]
    try:
        import trimesh
    except ImportError:
        raise ConfigError("meshes are shown by trimesh: pip install 'qpavoid[view]'") from None
    try:
        parts = trimesh.load_scene(visual.path).dump()
    except ImportError:
        raise ConfigError(f"{visual.path}: read by pycollada: pip install 'qpavoid[view]'") from None
    except Exception:  # a dozen kinds, of files from anybody; what cannot be seen can still be avoided
        return []
    by_colour: dict[tuple[float, ...], list[Any]] = {}
    for part in parts:
        part.merge_vertices(merge_norm=True, merge_tex=True)
        by_colour.setdefault(visual.colour or _own_colour(part), []).append(part)
    meshes = []
    for colour, group in by_colour.items():
        starts = np.cumsum([0, *(len(part.vertices) for part in group)])
        vertices = np.concatenate([part.vertices for part in group]) * visual.scale
        faces = np.concatenate([part.faces + start for part, start in zip(group, starts, strict=False)])
        meshes.append(Mesh(vertices.astype(np.float32), faces.astype(np.uint32), colour))
    return meshes


def _own_colour(part: Any) -> tuple[float, ...]:
    """Return the colour that a part of a mesh file has itself."""
    material = getattr(part.visual, "material", None)
    if material is None:
        return GREY
    return tuple(round(float(number) / 255.0, 3) for number in material.main_color)


def decimated(mesh: Mesh, cell: float) -> Mesh:
    """Return a coarse mesh: corners in one cell of a grid become one.

    Args:
        mesh: the mesh.
        cell: side of a cell [m].
    """
    cells, index = np.unique(np.round(mesh.vertices / cell), axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = np.unique(faces[proper], axis=0)
    return Mesh((cells * cell).astype(np.float32), faces.astype(np.uint32), mesh.colour)
