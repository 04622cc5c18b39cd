"""Closest points of the pairs within the influence distance; without a Python loop.

Bounding spheres tell which pairs can be near at all. Kernels compute convex bodies that are apart, and half-spaces; one
call of coal does the rest, with all other pairs switched off; its poses and results are copied through views.
"""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.config import PointCloud
from qpavoid.control.cloud_proxies import CloudProxies
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.control.pair_table import PairTable
from qpavoid.errors import NumericalError
from qpavoid.kernels.distances import BY_COAL, SPARE_BY_COAL
from qpavoid.kernels.gjk import GUESS
from qpavoid.model.cloud import Voxels
from qpavoid.model.sample import STATE, Sample
from qpavoid.model.scene import Scene
from qpavoid.model.views import read_poses, read_results, view_poses, view_results
from qpavoid.problem import Array, IntArray

_TOLERANCE = 1e-10
"""At which coal stops; its default, 1e-6, leaves errors of 7e-3 in normals of boxes and hulls."""
_FIRST_GUESS = coal.DistanceResult()
"""Where a search of coal starts at first."""
_FIRST_GUESS.cached_gjk_guess, _FIRST_GUESS.cached_support_func_guess = np.eye(3)[0], np.zeros(2, dtype=np.int32)
_MAX_STOP = 1.0
"""How far the robot may go before it stands, where a half-space that turns is concerned [m]."""


class DistanceQuery:
    """Distances of a scene's pairs; owns the buffers that every call overwrites."""

    def __init__(self, scene: Scene, table: PairTable | None = None) -> None:
        """Lay the memory out; all obstacles are where they are at time 0.

        Args:
            scene: robot and obstacles.
            table: its bodies and pairs, with what is attached to the robot; one of its own if left out.
        """
        self.table = table = PairTable(scene) if table is None else table
        self._scene, self._data = scene, scene.geometry.createData()
        self._request = coal.DistanceRequest()
        for request in (*self._data.distanceRequests, self._request):
            request.gjk_tolerance = _TOLERANCE
        model, obstacles = scene.robot.model, len(scene.slots)
        pin.updateGeometryPlacements(model, model.createData(), scene.geometry, self._data, pin.neutral(model))
        pin.computeDistances(scene.geometry, self._data)  # so that there is something to compare the view with
        self._results_of_coal = view_results(self._data.distanceResults)
        self._poses_of_coal = view_poses(self._data.oMg, writeable=True)
        radii = np.linalg.norm(table.spheres[:, :3], axis=1) + table.spheres[:, 3]
        self.obstacle_radii: Array = np.array(
            [radii[i:j].max(initial=0.0) for i, j in zip(table.first[:-1], table.first[1:], strict=True)]
        )
        """(o,) distance from each obstacle's origin to its farthest point; infinite of a half-space [m]."""
        self._planes = np.flatnonzero(np.isinf(self.obstacle_radii)).tolist()
        self.has_planes = bool(self._planes)
        """Whether any obstacle is a half-space, whose extent counts from where the robot is."""
        bodies, pairs = len(table.spheres), len(scene.pairs)
        rows = obstacles + 1 + scene.movable - len(scene.body_names)
        self.arrays = kernels.DistanceArrays(
            joints=table.joints,
            placements=table.placements,
            twist_row=table.twist_row,
            enabled=table.enabled,
            ignored=table.ignored,
            pairs=np.ascontiguousarray(scene.pairs, dtype=np.intp),
            pair_of=table.pair_of,
            local=table.spheres[:, :3].copy(),
            shapes=table.shapes,
            method=table.method,
            first=table.first,
            is_cloud=np.array([i in scene.clouds for i in range(obstacles)], dtype=bool),
            bounding_radius=np.nan_to_num(self.obstacle_radii, posinf=0.0),
            max_square=np.empty(table.pair_of.shape),
            states=np.zeros((obstacles, STATE)),
            twists=np.zeros((rows, 6)),
            margin=np.zeros(rows),
            speeds=np.zeros(model.njoints + obstacles),
            poses=read_poses(self._data.oMg),
            centers=np.ones((bodies, 5)),
            radius=table.spheres[:, 3].copy(),
            travels=np.zeros(bodies),
            limits=np.full(pairs, -np.inf),
            guesses=np.zeros((pairs, GUESS)),
            near=np.zeros(pairs, dtype=np.intp),
            rows=np.zeros(pairs, dtype=np.intp),
            meeting=np.zeros(pairs, dtype=np.intp),
            counts=np.zeros(3, dtype=np.intp),
            results=read_results(self._data.distanceResults),
        )
        """Memory of the distances, see `DistanceArrays`; the results are those of `pairs`."""
        self._uncertainty = np.array([obstacle.uncertainty for obstacle in scene.slots])
        self.arrays.margin[:obstacles] = self._uncertainty
        self.arrays.margin[obstacles + 1 :] = self._uncertainty[: rows - obstacles - 1]
        self.packed = kernels.pack(self.arrays)
        none, margin = np.zeros(0, dtype=np.intp), np.zeros(obstacles)
        self._place = kernels.direct(kernels.place_obstacles, self.packed, none, self.arrays.states, margin)
        self.is_moving = False
        """Whether any obstacle has a velocity or a margin."""
        self.influence_distance = np.nan
        """Surface distance below which a pair is near [m]; set it by `set_influence_distance`."""
        for state, obstacle in zip(self.arrays.states, scene.slots, strict=True):
            state[:] = obstacle.motion.sample(0.0).row
        self._clouds = {i: self._make_proxies(i) for i in scene.clouds}
        for i in self._clouds:
            self._set_radius(i)
        for center, pose, sphere in zip(self.arrays.centers, self.arrays.poses, table.spheres, strict=True):
            center[:3] = sphere[:3] @ pose[:9].reshape(3, 3) + pose[9:]
            center[4] = -(center[:3] @ center[:3])
        self._by_coal = np.flatnonzero(table.method == BY_COAL)
        for pair in range(pairs):
            self._data.deactivateCollisionPair(pair)
        self._active, self._last_near = np.zeros(pairs, dtype=bool), b""
        self._outdated = np.zeros(pairs, dtype=bool)  # pairs of spare slots for which coal was made for other shapes
        self._surfaces = table.is_mesh[scene.pairs].any(axis=1) & ~table.is_plane[scene.pairs].any(axis=1)
        self._has_surfaces = bool(self._surfaces.any())
        self.is_compiled = not (len(self._by_coal) or self._clouds)
        """Whether kernels compute everything, but for pairs whose cores meet."""
        self.has_clouds = bool(self._clouds)
        """Whether there are proxies to place between the bodies and the distances of a step."""
        table.queries.add(self)

    def place(self, obstacles: ObstacleStates) -> None:
        """Move obstacles to other states.

        Args:
            obstacles: those that may have another state than at time 0, with margins, and points of clouds.

        Raises:
            NumericalError: NaN or infinity; names the obstacle. All stay where they were.
        """
        x = self.arrays
        for index, voxels in obstacles.voxels.items():
            if voxels is not self._clouds[index].voxels:
                self._clouds[index].fill_with(voxels)
                self._set_radius(index)
        for index in self._planes:
            state = obstacles.states[index]
            x.bounding_radius[index] = self._extent_on_plane(state) if state[15:].any() else 0.0
        bad, self.is_moving = self._place(self.packed, obstacles.which, obstacles.states, obstacles.margin)
        if bad >= 0:
            raise NumericalError(f"obstacle {self._scene.slots[bad].name!r}: NaN or infinity in its pose or twist")

    def set_influence_distance(self, influence_distance: float) -> None:
        """Choose the surface distance below which a pair is near [m]."""
        if influence_distance != self.influence_distance:
            self.influence_distance = influence_distance
            self._set_max_square(slice(None), slice(None))

    def _set_max_square(self, rows: slice, columns: slice) -> None:
        """Write the squared distance of centres up to which some bodies, the first movable, are near each other."""
        table, first = self.table, self.table.first
        radius, empty = table.spheres[:, 3].copy(), table.is_empty
        radius[first[0] :] += np.repeat(self._uncertainty, np.diff(first))
        movable = slice(len(table.pair_of))
        touching = radius[movable][rows, None] + radius[columns] + self.influence_distance
        exists = (table.pair_of[rows, columns] >= 0) & ~(empty[movable][rows, None] | empty[columns])
        self.arrays.max_square[rows, columns] = np.where(exists, touching**2 * (1.0 + 1e-9), -1.0)

    def forget_guesses(self) -> None:
        """Let all searches start anew, not where they ended before: of curved shapes, that shows."""
        self.arrays.guesses[:], self.arrays.limits[:] = 0.0, -np.inf
        for pair in self._by_coal.tolist():
            self._data.distanceRequests[pair].updateGuess(_FIRST_GUESS)

    def update_slot(self, index: int) -> None:
        """Take over what the scene and the table have in a spare slot now; it is where it is at time 0."""
        x, body, obstacle = self.arrays, int(self.table.first[index]), self._scene.slots[index]
        x.local[body], x.radius[body] = self.table.spheres[body, :3], self.table.spheres[body, 3]
        self.obstacle_radii[index] = x.bounding_radius[index] = np.linalg.norm(x.local[body]) + x.radius[body]
        self._uncertainty[index] = obstacle.uncertainty
        self._set_max_square(slice(body, body + 1), slice(None))
        self._set_max_square(slice(None), slice(body, body + 1))
        pairs = self.table.pairs_of(index)
        self._outdated |= pairs
        x.guesses[pairs], x.limits[pairs] = 0.0, -np.inf
        self._last_near = b""
        x.states[index] = obstacle.motion.sample(0.0).row
        kernels.place_obstacles(self.packed, np.array([index]), x.states, self._uncertainty)
        for cloud in self._clouds.values():
            cloud.set_body(body, self._scene.geometry.geometryObjects[body].geometry)

    def compute(self, joint_poses: Array, influence_distance: float) -> None:
        """Compute the distance of every pair that is nearer than `influence_distance`; `pairs` says which.

        Args:
            joint_poses: world poses of all joints (njoints, 12).
            influence_distance: surface distance [m].
        """
        self.set_influence_distance(influence_distance)
        kernels.place_bodies(self.packed, joint_poses)
        for index, cloud in self._clouds.items():
            self._place_proxies(index, cloud)
        kernels.near_pairs(self.packed, np.inf)
        self.finish()

    def finish(self) -> None:
        """Compute what kernels cannot, by coal."""
        x = self.arrays
        left = x.meeting[: x.counts[2]].tolist()
        meet = [pair for pair in left if x.method[pair] != SPARE_BY_COAL]
        if len(self._by_coal) or len(meet) < len(left):
            self._compute_by_coal()
        for pair in meet:
            self._compute_one(pair)

    @property
    def pairs(self) -> IntArray:
        """(c,) pairs that were computed and are to get rows, increasing."""
        return self.arrays.rows[: self.arrays.counts[1]]

    @property
    def _near(self) -> IntArray:
        """(c,) pairs that were computed, increasing."""
        return self.arrays.near[: self.arrays.counts[0]]

    def _compute_by_coal(self) -> None:
        """Compute the near pairs that kernels cannot in one call of coal."""
        x, near = self.arrays, self._near.tobytes()
        if near != self._last_near:
            active = np.zeros(len(self._active), dtype=bool)
            active[self._near] = True
            active &= x.method <= SPARE_BY_COAL
            for pair in np.flatnonzero(active & self._outdated).tolist():
                a, b = (self._scene.geometry.geometryObjects[i] for i in x.pairs[pair].tolist())
                self._data.distance_functors[pair] = pin.ComputeDistance(a, b)
                self._data.distanceRequests[pair].updateGuess(_FIRST_GUESS)
                self._outdated[pair] = False
            changed = np.flatnonzero(active != self._active)
            for pair, on in zip(changed.tolist(), active[changed].tolist(), strict=True):
                (self._data.activateCollisionPair if on else self._data.deactivateCollisionPair)(pair)
            self._active, self._last_near = active, near
        if self._poses_of_coal is None:
            for i, pose in enumerate(x.poses):
                self._data.oMg[i] = pin.SE3(pose[:9].reshape(3, 3).T, pose[9:])
        else:
            self._poses_of_coal[:] = x.poses
        pin.computeDistances(self._scene.geometry, self._data)
        results = self._results_of_coal
        results = read_results(self._data.distanceResults) if results is None else results
        x.results[self._active] = results[self._active]
        if self._has_surfaces:
            meshes = np.flatnonzero(self._active & self._surfaces)
            x.results[meshes] = _with_normals(x.results[meshes])

    def _compute_one(self, pair: int) -> None:
        bodies, poses = self._scene.geometry.geometryObjects, self.arrays.poses
        a, b = (
            (bodies[i].geometry, coal.Transform3s(poses[i, :9].reshape(3, 3).T.copy(), poses[i, 9:].copy()))
            for i in self.arrays.pairs[pair].tolist()
        )
        result = coal.DistanceResult()
        coal.distance(*a, *b, self._request, result)
        self.arrays.results[pair] = read_results([result])[0]

    def distances_of(self, pairs: IntArray) -> Array:
        """Return distances (k,) of some pairs, increasing, at the last call; infinite for those that were not near [m].

        Of a point cloud, that of its nearest voxel to each body: the identity of that voxel may change between calls.
        """
        results = self.arrays.results
        if not self._clouds:
            return np.asarray(kernels.distances_of(self._near, results, pairs))
        distance = np.full(len(self.table.group), np.inf)
        np.minimum.at(distance, self.table.group[self._near], results[self._near, 0])
        return np.asarray(distance[self.table.group[pairs]])

    def voxels(self, index: int) -> Voxels:
        """Return what is in a point cloud, by number of the obstacle."""
        return self._clouds[index].voxels

    def max_over_group(self, values: Array) -> Array:
        """Return the largest of some values (m,) among the pairs of the same body and point cloud (m,)."""
        if not self._clouds:
            return values
        largest = np.zeros_like(values)
        np.maximum.at(largest, self.table.group, values)
        return largest[self.table.group]

    def _make_proxies(self, index: int) -> CloudProxies:
        shape, bodies = self._scene.slots[index].shape, self._scene.geometry.geometryObjects
        assert isinstance(shape, PointCloud)
        proxies = np.arange(self.table.first[index], self.table.first[index + 1])
        geometries = [bodies[i].geometry for i in range(len(self.table.joints))]
        return CloudProxies(geometries, proxies, shape.resolution, shape.nearest, self._scene.clouds[index])

    def _set_radius(self, index: int) -> None:
        self.obstacle_radii[index] = self.arrays.bounding_radius[index] = self._clouds[index].radius

    def _place_proxies(self, index: int, cloud: CloudProxies) -> None:
        """Move the proxies of a cloud to the voxels that are nearest to each body."""
        x, unattached = self.arrays, np.flatnonzero(self.table.joints < 0)
        poses, sample = x.poses[: len(self.table.joints)], Sample.of_row(x.states[index])
        influence_distance = self.influence_distance + self._uncertainty[index]
        positions = cloud.places(poses, unattached, sample, influence_distance).reshape(-1, 3)
        proxies = cloud.geometries.ravel()
        x.poses[proxies, 9:] = x.centers[proxies, :3] = positions
        x.centers[proxies, 4] = -np.einsum("ij,ij->i", positions, positions)

    def _extent_on_plane(self, state: Array) -> float:
        """Return the distance from a half-space's origin to what the robot may come to before it stands [m]."""
        count = len(self.table.joints)
        away = np.linalg.norm(self.arrays.poses[:count, 9:] - state[9:12], axis=1)
        return float(np.max(away + self.table.spheres[:count, 3])) + _MAX_STOP


def _with_normals(results: Array) -> Array:
    """Return results (k, 10) of triangle meshes with their normals, which coal does not give.

    The distance of one that is cut through is NaN, as it cannot be trusted.
    """
    results = results.copy()
    results[~(results[:, 0] > 0.0), 0] = np.nan
    between = results[:, 7:10] - results[:, 4:7]
    with np.errstate(invalid="ignore", divide="ignore"):
        results[:, 1:4] = between / np.linalg.norm(between, axis=1, keepdims=True)
    return results
