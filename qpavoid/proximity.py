"""Closest points of every pair, and the rate of the distance of those within reach; by coal, without a Python loop.

coal leaves its results in one contiguous C++ vector. Reading it pair by pair through the bindings would cost more
than computing it, so it is viewed as one array. That layout is not part of coal's interface: it is checked against
the accessors when a query is built, and where it differs the accessors are used.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.kinematics import Kinematics, point_rows
from qpavoid.motion import Sample
from qpavoid.problem import Array, Proximity
from qpavoid.scene import Scene

_FIELDS = 10
"""min_distance, normal, nearest point 1, nearest point 2: neighbours in coal's DistanceResult."""


class DistanceQuery:
    """Distances of a scene's pairs; owns the buffers that every call overwrites."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._geometry = pin.GeometryModel(scene.geometry)
        self._data = self._geometry.createData()
        for request in self._data.distanceRequests:
            request.gjk_tolerance = 1e-10  # the default 1e-6 leaves errors of 7e-3 in normals of boxes and hulls
        self._first_obstacle = len(scene.body_names)
        obstacles = len(scene.obstacles)
        # the row after the obstacles' twists stays zero: it stands for the robot's own bodies
        self._twists = np.zeros((obstacles + 1, 6))
        second = scene.pairs[:, 1] - self._first_obstacle
        self._twist_row = np.where(second >= 0, second, obstacles)
        self._view = _view_results(self._geometry, self._data, scene.robot.model)

    def place_obstacle(self, index: int, sample: Sample) -> None:
        """Puts obstacle number `index` to a pose, with a velocity."""
        placement = pin.SE3(sample.rotation, sample.position)
        self._geometry.geometryObjects[self._first_obstacle + index].placement = placement
        self._twists[index, :3] = sample.linear - np.cross(sample.angular, sample.position)
        self._twists[index, 3:] = sample.angular

    def placements(self) -> Mapping[str, Any]:
        """World placements of all bodies at the last call, by name; for drawing."""
        return {
            body.name: placement for body, placement in zip(self._geometry.geometryObjects, self._data.oMg, strict=True)
        }

    def compute(self, data: Any, kinematics: Kinematics, reach: float) -> Proximity:
        """Distances of all pairs, and the Jacobian rows of those nearer than `reach`.

        The normal is parallel to the line between the witness points, so p × n is the same at both, and every row is
        J = [n, p × n]ᵀ J_world, masked with the difference of the supports of the two bodies.

        Args:
            data: pinocchio data that holds the joint placements of this tick.
            kinematics: of the same tick.
            reach: surface distance below which a pair is near [m].
        """
        pin.updateGeometryPlacements(self._scene.robot.model, data, self._geometry, self._data)
        pin.computeDistances(self._geometry, self._data)
        results = _read_results(self._data.distanceResults) if self._view is None else self._view.copy()
        distance, normal, point_a = results[:, 0], results[:, 1:4], results[:, 4:7]
        near = np.flatnonzero(distance < reach)
        rows = point_rows(normal[near], point_a[near])
        return Proximity(
            distance=distance,
            normal=normal,
            point_a=point_a,
            point_b=results[:, 7:10],
            near=near,
            J=(rows @ kinematics.J) * self._scene.support[near],
            drift=np.einsum("ij,ij->i", rows, self._twists[self._twist_row[near]]),
        )


def _read_results(results: Any) -> Array:
    """All results through the accessors: (m, 10)."""
    rows = [(r.min_distance, *r.normal, *r.getNearestPoint1(), *r.getNearestPoint2()) for r in results]
    return np.array(rows, dtype=np.float64).reshape(-1, _FIELDS)


def _view_results(geometry: Any, data: Any, model: Any) -> Array | None:
    """The same as a view of coal's memory, or None where it does not agree with the accessors.

    The view stays valid as long as `data` lives: its results are never resized.
    """
    pin.updateGeometryPlacements(model, model.createData(), geometry, data, pin.neutral(model))
    pin.computeDistances(geometry, data)
    results = data.distanceResults
    count = len(results)
    if count < 2:
        return None
    addresses = [r.normal.__array_interface__["data"][0] for r in results]
    strides = np.diff(addresses)
    stride = int(strides[0])
    if not (strides == stride).all() or stride < 8 * _FIELDS or stride % 8:
        return None
    # the distance stands before the normal; the last row must not be read past its own end
    doubles = (count - 1) * stride // 8 + _FIELDS
    memory = np.ctypeslib.as_array((ctypes.c_double * doubles).from_address(addresses[0] - 8))
    view = np.lib.stride_tricks.as_strided(memory, shape=(count, _FIELDS), strides=(stride, 8), writeable=False)
    return view if np.array_equal(view, _read_results(results), equal_nan=True) else None
