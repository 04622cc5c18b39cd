"""What stands around a robot in a MuJoCo simulation of your own: geoms as obstacles, or as the points a camera sees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from qpavoid import config
from qpavoid.errors import ConfigError
from qpavoid.model.scene import Obstacle
from qpavoid.problem import Array

_GEOMS = mujoco.mjtGeom


def obstacles_of(model: Any, data: Any, bodies: Sequence[str], **settings: Any) -> list[Obstacle]:
    """Return the geoms of some bodies as obstacles for `build_scene`, where they are in `data`.

    An obstacle is named as its body, or `body/number` where that has several geoms. Half-spaces are planes.

    Args:
        model: MuJoCo's.
        data: after `mj_forward` or `mj_kinematics`.
        bodies: names of bodies; `world` has the geoms that belong to no body.
        settings: of `Obstacle.at`, such as `uncertainty`.

    Raises:
        KeyError: of MuJoCo: there is no such body; MuJoCo merges those without a joint into others in a URDF, unless
            `compiler.fusestatic` is false.
        ConfigError: a mesh, height field or signed distance field; a point cloud can stand for it.
    """
    return [
        Obstacle.at(name, _shape(model, geom), data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), **settings)
        for name, geom in geoms_of(model, bodies)
    ]


def camera_points(
    model: Any,
    data: Any,
    camera: str,
    hidden: Sequence[str] = (),
    size: tuple[int, int] = (64, 48),
    max_distance: float = 3.0,
) -> Array:
    """Return what a depth camera sees: points (n, 3) on geoms [m], in world axes. Rays are cast, nothing is drawn.

    Args:
        model: MuJoCo's.
        data: after `mj_forward`.
        camera: its name.
        hidden: bodies that are left out of the points, as the robot's root, with all that is fixed to them or hangs
            from them. They still hide what is behind them.
        size: rays in a row and in a column.
        max_distance: up to which it sees [m].
    """
    number, (width, height) = model.camera(camera).id, size
    edge = np.tan(0.5 * np.deg2rad(model.cam_fovy[number]))
    across, down = np.linspace(-edge, edge, width) * width / height, np.linspace(edge, -edge, height)
    x, y = (part.ravel() for part in np.meshgrid(across, down))
    rays = np.stack((x, y, -np.ones_like(x)), axis=1) @ data.cam_xmat[number].reshape(3, 3).T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    eye, geoms, distances = data.cam_xpos[number], np.full(len(rays), -1, dtype=np.int32), np.zeros(len(rays))
    own = int(model.cam_bodyid[number]) or -1  # what the camera is mounted on does not hide anything
    mujoco.mj_multiRay(model, data, eye, rays.ravel(), None, True, own, geoms, distances, None, len(rays), max_distance)
    roots = [model.body_rootid[model.body(name).id] for name in hidden]
    is_hit = (geoms >= 0) & (distances <= max_distance)
    is_hit &= ~np.isin(model.body_rootid[model.geom_bodyid[geoms]], roots)
    return np.asarray(eye + distances[is_hit, None] * rays[is_hit])


def geoms_of(model: Any, bodies: Sequence[str]) -> list[tuple[str, int]]:
    """Return name as an obstacle and number of each geom of some bodies."""
    geoms = []
    for body in bodies:
        own = np.flatnonzero(model.geom_bodyid == model.body(body).id).tolist()
        geoms += [(body if len(own) == 1 else f"{body}/{i}", geom) for i, geom in enumerate(own)]
    return geoms


def _shape(model: Any, geom: int) -> config.ObstacleShape:
    size = model.geom_size[geom].tolist()
    match model.geom_type[geom]:
        case _GEOMS.mjGEOM_SPHERE:
            return config.Sphere(radius=size[0])
        case _GEOMS.mjGEOM_CAPSULE:
            return config.Capsule(radius=size[0], length=2.0 * size[1])
        case _GEOMS.mjGEOM_CYLINDER:
            return config.Cylinder(radius=size[0], length=2.0 * size[1])
        case _GEOMS.mjGEOM_BOX:
            return config.Box(size=(2.0 * size[0], 2.0 * size[1], 2.0 * size[2]))
        case _GEOMS.mjGEOM_ELLIPSOID:
            return config.Ellipsoid(radii=(size[0], size[1], size[2]))
        case _GEOMS.mjGEOM_PLANE:
            return config.HalfSpace()
    raise ConfigError(
        f"geom {model.geom(geom).name or geom!r}: a {_GEOMS(model.geom_type[geom]).name} is no obstacle here"
    )
