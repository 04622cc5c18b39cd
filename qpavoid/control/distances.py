"""Closest points of the pairs within reach; without a Python loop.

Bounding spheres tell which pairs can be within reach at all. Spheres, capsules and boxes have closed forms; one call of
coal does the rest, with all other pairs switched off, and its results are viewed as one array.
"""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.config import PointCloud
from qpavoid.control.broadphase import Cull
from qpavoid.control.cloud_proxies import CloudProxies
from qpavoid.control.placement import ObstaclePlacement
from qpavoid.geometry.bodies import bounding_box, bounding_sphere
from qpavoid.geometry.cores import cores, has_closed_form
from qpavoid.kernels.distances import closed_forms
from qpavoid.model.cloud import Voxels
from qpavoid.model.scene import Scene
from qpavoid.model.trajectory import Sample
from qpavoid.model.views import read_poses, read_results, view_poses, view_results
from qpavoid.problem import Array, IntArray, Mask

_CULL_FROM = 48
"""Number of pairs from which looking at bounding spheres first pays."""
_TOLERANCE = 1e-10
"""At which coal stops; its default, 1e-6, leaves errors of 7e-3 in normals of boxes and hulls."""
_LONGEST_GRASP = 0.5
"""Largest gap between the robot and what it carries [m]."""


class DistanceQuery:
    """Distances of a scene's pairs; owns the buffers that every call overwrites."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._geometry = pin.GeometryModel(scene.geometry)
        self._data = self._geometry.createData()
        for request in self._data.distanceRequests:
            request.gjk_tolerance = _TOLERANCE
        bodies = self._geometry.geometryObjects
        self._first_obstacle, self._movable = len(scene.body_names), scene.movable
        self._pieces = [np.flatnonzero(scene.obstacle_of == i).tolist() for i in range(len(scene.obstacles))]
        model = scene.robot.model
        pin.updateGeometryPlacements(model, model.createData(), self._geometry, self._data, pin.neutral(model))
        pin.computeDistances(self._geometry, self._data)  # so that there is something to compare the view with
        view = view_results(self._data.distanceResults)
        self.results: Array = read_results(self._data.distanceResults) if view is None else view
        """(m, 10) [distance, normal, point a, point b] of all pairs; only those of `pairs` are of this tick."""
        poses = view_poses(self._data.oMg, writeable=True)
        self.poses: Array = read_poses(self._data.oMg) if poses is None else poses
        """(g, 12) world poses of all bodies, the robot's first."""
        self._copy, self._copy_poses = view is None, poses is None
        shapes = [bounding_sphere(body.geometry) for body in bodies]
        self.spheres = np.array([(*center, radius) for center, radius in shapes]).reshape(-1, 4)
        """(g, 4) bounding sphere of each body in its own frame: centre and radius [m]; infinite of a half-space."""
        self._joints = model.njoints
        self.placing = ObstaclePlacement(scene, bodies, self.poses, self.spheres)
        """Where the obstacles are."""
        self.group: IntArray = np.arange(len(scene.pairs))
        """(m,) first of the pairs of the same body and point cloud; of other pairs, their own number."""
        self._grouped = np.zeros(len(scene.pairs), dtype=bool)
        self._slots = {i: self._make_slots(i, voxels) for i, voxels in scene.clouds.items()}
        for i, slots in self._slots.items():
            self.placing.reaches(i, slots.reach)
        self.carried: dict[int, int] = {}
        """Joint that carries each obstacle which is carried, by number of the obstacle."""
        self.disabled_pairs: Any = None
        """(m,) pairs that are computed but of which no row is made; None where there are none."""
        self.enabled = np.ones(len(scene.pairs), dtype=bool)
        """(m,) which pairs are computed at all."""
        self.twist_row: IntArray = np.zeros(len(scene.pairs), dtype=np.intp)
        """(m,) row of `twists` that moves each pair."""
        self._cores = cores([body.geometry for body in bodies])
        self._known = has_closed_form(self._cores, scene.pairs)
        self._others = bool(len(self._known)) and not self._known.all()
        self._met, self._request = np.zeros(len(scene.pairs), dtype=np.intp), coal.DistanceRequest()
        self._request.gjk_tolerance = _TOLERANCE
        culls = len(scene.pairs) >= _CULL_FROM or bool(self._slots)
        arrays = self.poses, self.spheres, self.placing.centers, ~self._known
        self._cull = Cull(scene, self._data, *arrays) if culls else None
        self.pairs: IntArray = np.arange(len(scene.pairs))
        """(c,) pairs that were computed and are to get rows, increasing."""
        self._surface = _surface_pairs(scene)
        self.switch()
        self._in_closed_form(self.pairs[:0])  # no tick waits for the compiler

    @property
    def bodies(self) -> Any:
        """Geometries as they are placed and carried now, in the order of the geometry model."""
        return self._geometry.geometryObjects

    def boxes(self) -> Array:
        """(g, 6) box around each body in its own frame: centre and half its sizes [m]."""
        return np.array([np.concatenate(bounding_box(body.geometry)) for body in self.bodies]).reshape(-1, 6)

    def convex(self) -> Mask:
        """(m,) whether both bodies of a pair are convex; pairs with a point cloud stand for more than they hold."""
        mesh = np.array([isinstance(body.geometry, coal.BVHModelBase) for body in self.bodies], dtype=bool)
        return ~mesh[self._scene.pairs].any(axis=1) & ~self._grouped

    def max_extension(self) -> Array:
        """(njoints,) the same as `joint_radius`, with whatever may ever be carried [m]."""
        radii, reach = self.spheres[self._first_obstacle : self._movable, 3], self.joint_radius()
        return np.full_like(reach, reach.max() + 2.0 * radii.max() + _LONGEST_GRASP) if len(radii) else reach

    def moved_by(self) -> IntArray:
        """(m, 2) what moves the two bodies of each pair: number of a joint, or njoints plus that of an obstacle."""
        joints = np.array([body.parentJoint for body in self._geometry.geometryObjects], dtype=np.intp)
        of = self._scene.obstacle_of
        free = (of >= 0) & ~np.isin(of, list(self.carried))
        joints[free] = self._joints + of[free]
        return joints[self._scene.pairs]

    def joint_radius(self) -> Array:
        """(njoints,) distance from each joint's origin to the farthest point of a body that it carries [m]."""
        reach = np.zeros(self._joints)
        bodies = self._geometry.geometryObjects
        for i in [*range(self._first_obstacle), *(self._pieces[index][0] for index in self.carried)]:
            body, (*center, radius) = bodies[i], self.spheres[i]
            placed = body.placement.rotation @ np.array(center) + body.placement.translation
            reach[body.parentJoint] = max(reach[body.parentJoint], float(np.linalg.norm(placed)) + radius)
        return reach

    def place_obstacle(self, index: int, sample: Sample, margin: float = 0.0, voxels: Voxels | None = None) -> None:
        """Puts obstacle number `index` to a pose, with a velocity, and takes a margin [m] off its distances.

        Args:
            index: which one; not one that is carried.
            sample: where it is and how it moves.
            margin: taken off its distances [m].
            voxels: of a point cloud, what is in it now; as before if left out.

        Raises:
            NumericalError: NaN or infinity; names the obstacle, which stays where it was.
        """
        if voxels is not None:
            self.fill(index, voxels)
        self.placing.place_one(index, sample, margin)

    def fill(self, index: int, voxels: Voxels) -> None:
        """Takes other voxels as what is in obstacle number `index`, a point cloud."""
        slots = self._slots[index]
        if voxels is not slots.voxels:
            slots.fill_with(voxels)
            self.placing.reaches(index, slots.reach)

    def carry(self, index: int, joint: int, sample: Sample) -> None:
        """Attach an obstacle to a joint, or release it.

        Args:
            index: number of the obstacle.
            joint: number of the joint; 0 for none.
            sample: its pose in the joint's frame, or in the world.
        """
        (geometry,) = self._pieces[index]
        self._geometry.geometryObjects[geometry].parentJoint = joint
        self.place_obstacle(index, sample)
        self.carried.pop(index, None)
        if joint:
            self.carried[index] = joint
        self.switch()

    def switch(self) -> None:
        """Brings what depends on who carries what up to date, in place."""
        scene, obstacles = self._scene, len(self._scene.obstacles)
        free = ~np.isin(scene.obstacle_of, list(self.carried)) & (scene.obstacle_of >= 0)
        first, second = scene.pairs.T
        of = scene.obstacle_of
        negative = np.where(free[first], obstacles + 1 + of[first], obstacles)
        self.twist_row[:] = np.where(free[second], of[second], negative)
        self.enabled[:] = ~(free[first] & free[second])
        self._off = np.flatnonzero(free[: self._movable])
        self._on = np.flatnonzero(self.enabled)
        if self._cull is not None:
            self._cull.enable(self.enabled)
        else:
            for pair, on in enumerate((self.enabled & ~self._known).tolist()):
                (self._data.activateCollisionPair if on else self._data.deactivateCollisionPair)(pair)

    def compute(self, data: Any, reach: float) -> None:
        """Brings `results` up to date for every pair nearer than `reach`, and says in `pairs` which ones it computed.

        Args:
            data: pinocchio data that holds the joint placements of this tick.
            reach: surface distance [m].
        """
        pin.updateGeometryPlacements(self._scene.robot.model, data, self._geometry, self._data)
        if self._copy_poses:
            self.poses[:] = read_poses(self._data.oMg)
        if self._slots:
            for index, slots in self._slots.items():
                self._fill(index, slots, reach)
        pairs = self._on if self._cull is None else self._cull.switch(reach)
        if self._others:
            pin.computeDistances(self._geometry, self._data)
        self._in_closed_form(pairs)
        if self._surface is not None:
            self._mend_surfaces(pairs)
        self._computed = pairs
        self.pairs = pairs if self.disabled_pairs is None else pairs[~self.disabled_pairs[pairs]]

    def body_spheres(self, data: Any) -> tuple[Array, Array]:
        """World centres (b, 3) and radii (b,) of spheres around the robot's bodies and all that it may carry [m].

        Args:
            data: pinocchio data that holds the joint placements.
        """
        pin.updateGeometryPlacements(self._scene.robot.model, data, self._geometry, self._data)
        poses = read_poses(self._data.oMg) if self._copy_poses else self.poses
        poses, spheres = poses[: self._movable], self.spheres[: self._movable]
        turned = (spheres[:, None, :3] @ poses[:, :9].reshape(-1, 3, 3))[:, 0]
        return turned + poses[:, 9:], spheres[:, 3]

    def found(self, pairs: IntArray) -> Array:
        """Distances (k,) of some pairs at the last call; infinite for those that were out of reach [m].

        Of a point cloud, that of its nearest voxel to each body: which voxel it is changes, and is not what counts.
        """
        distance = self.results[pairs, 0]
        if self._cull is not None and pairs is not self.pairs:
            distance = np.where(self._cull.active[pairs], distance, np.inf)
        if self._slots:
            least = np.full(len(self._scene.pairs), np.inf)
            near = self._computed
            np.minimum.at(least, self.group[near], self.results[near, 0])
            distance = np.where(self._grouped[pairs], least[self.group[pairs]], distance)
        return np.asarray(distance)

    def widest(self, given: Array) -> Array:
        """What is granted (m,) to each pair; of the balls of a cloud, each body's most."""
        if not self._slots:
            return given
        most = np.zeros_like(given)
        np.maximum.at(most, self.group, given)
        return most[self.group]

    def _in_closed_form(self, pairs: IntArray) -> None:
        """Distances of the pairs that have one; those whose cores meet are computed by coal after all."""
        bodies = self._scene.pairs
        if self._copy and self._others:
            self.results[~self._known] = read_results(self._data.distanceResults)[~self._known]
        count = closed_forms(self.poses, self._cores, bodies, self._known, pairs, self.results, self._met)
        for pair in self._met[:count].tolist():
            a, b = (
                (self._geometry.geometryObjects[i].geometry, coal.Transform3s(pose.rotation, pose.translation))
                for i, pose in ((i, self._data.oMg[i]) for i in bodies[pair].tolist())
            )
            result = coal.DistanceResult()
            coal.distance(*a, *b, self._request, result)
            self.results[pair] = read_results([result])[0]

    def _make_slots(self, index: int, voxels: Voxels) -> CloudProxies:
        shape, first = self._scene.obstacles[index].shape, self._movable
        assert isinstance(shape, PointCloud)
        a, b = self._scene.pairs.T
        mine = np.flatnonzero(self._scene.obstacle_of[b] == index)
        self._grouped[mine] = True
        self.group[mine] = mine[np.searchsorted(a[mine], a[mine])]
        bodies = [self._geometry.geometryObjects[i].geometry for i in range(first)]
        return CloudProxies(bodies, np.array(self._pieces[index]), shape.resolution, shape.nearest, voxels)

    def _fill(self, index: int, slots: CloudProxies, reach: float) -> None:
        """Puts the balls of a cloud to the voxels that are nearest to each body."""
        places = slots.places(self.poses[: self._movable], self._off, self.placing.samples[index], reach).reshape(-1, 3)
        geometries = slots.geometries.ravel()
        self.poses[geometries, 9:] = places
        if self._copy_poses:
            for geometry, place in zip(geometries.tolist(), places, strict=True):
                self._data.oMg[geometry] = pin.SE3(np.eye(3), place)
        assert self._cull is not None
        self._cull.place_points(geometries, places)

    def _mend_surfaces(self, pairs: IntArray) -> None:
        """Of two triangle meshes coal gives no normal; of one that is cut through, no distance to be trusted."""
        assert self._surface is not None
        pairs = pairs[np.isin(pairs, self._surface, assume_unique=True)]
        results = self.results[pairs]
        apart = results[:, 0] > 0.0
        results[~apart, 0] = np.nan
        way = results[:, 7:10] - results[:, 4:7]
        with np.errstate(invalid="ignore", divide="ignore"):
            results[:, 1:4] = way / np.linalg.norm(way, axis=1, keepdims=True)
        self.results[pairs] = results


def _surface_pairs(scene: Scene) -> IntArray | None:
    """Pairs with a triangle mesh in them, other than with a half-space; None where there are none."""
    kinds = [body.geometry for body in scene.geometry.geometryObjects]
    mesh = np.array([isinstance(kind, coal.BVHModelBase) for kind in kinds], dtype=bool)
    flat = np.array([isinstance(kind, coal.Halfspace) for kind in kinds], dtype=bool)
    pairs = np.flatnonzero(mesh[scene.pairs].any(axis=1) & ~flat[scene.pairs].any(axis=1))
    return pairs if len(pairs) else None
