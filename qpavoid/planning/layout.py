"""Lay out the memory of a plan: coordinates, the pairs that count, bounds on how fast their distances change."""

from __future__ import annotations

import numpy as np

from qpavoid import kernels
from qpavoid.control.distances import DistanceQuery
from qpavoid.errors import ConfigError
from qpavoid.geometry.bodies import hull
from qpavoid.kernels.distances import BY_COAL, SPARE_BY_COAL
from qpavoid.kernels.kinematics import PRISMATIC, REVOLUTE, UNBOUNDED
from qpavoid.kernels.planning import PlanningArrays, scratch
from qpavoid.kernels.support import OTHER
from qpavoid.model.convex_shapes import convex_shapes, pair_methods
from qpavoid.model.kinematics import ForwardKinematics, column_joints, columns, support_masks, turning_columns
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, IntArray

_MARGIN = 1e-3
"""Distance of goals and samples from the ends of the joints' ranges [rad or m]."""
_LEAST_TRAVEL = 0.02
"""Least lever arm in the metric [m]: a joint that moves nothing near would else turn at will."""


class PlanLayout:
    """Memory of the plans of one scene, in coordinates x (n,): the angle or length of each joint."""

    def __init__(self, scene: Scene, distances: DistanceQuery) -> None:
        """Read all constants off a robot.

        Args:
            scene: robot and obstacles.
            distances: distances of its pairs, with what is attached to the robot; a plan overwrites them.

        Raises:
            ConfigError: a joint has several coordinates, or slides without a limit.
        """
        self.scene, self.distances, self._model = scene, distances, scene.robot.model
        self._kinematics = ForwardKinematics(self._model)
        self._columns, self._column_joints = columns(self._model), column_joints(self._model)
        self._masks, self._turns = support_masks(self._model), turning_columns(self._model)
        kinds = self._kinematics.arrays.kind
        if not self._kinematics.is_compiled or not np.isin(kinds, (REVOLUTE, UNBOUNDED, PRISMATIC)).all():
            names = [
                name
                for name, joint in zip(self._model.names, self._model.joints, strict=True)
                if joint.nv > 1 or not self._kinematics.is_compiled
            ]
            raise ConfigError(
                f"{scene.robot.name}: no plans with joints of several coordinates, or of a kind that kernels do not "
                f"know: {', '.join(names[1:] or names)}; lock them"
            )
        joints = list(self._model.joints)
        self._v_index = np.array([joint.idx_v for joint in joints], dtype=np.intp)
        self._arrays = self._kinematics.arrays._replace(
            kind=np.where(kinds == UNBOUNDED, REVOLUTE, kinds), q_index=self._v_index
        )
        moved = [i for i, joint in enumerate(joints) if i and joint.shortname() != "JointModelMimic"]
        self._q_index = np.array([joints[i].idx_q for i in moved], dtype=np.intp)
        self._x_index, self._is_circle = self._v_index[moved], kinds[moved] == UNBOUNDED
        self._lower, self._upper = self._ranges()
        self._lengths, self._levers = self._lever_bounds()
        self._known: tuple[bytes, ...] = ()
        self._allowance: tuple[float, Array] | None = None
        self._empty = np.zeros(0, dtype=np.intp)
        bare = self._arrays._replace(
            column_joints=self._empty, motions=np.zeros((0, 6)), frame_ids=self._empty, frame_joints=self._empty
        )
        self._bare = kernels.pack(bare)

    # --- coordinates

    def coordinates(self, q: Array, near: Array | None = None) -> Array:
        """Return the coordinates (n,) of a configuration (nq,), of joints without limits those next to others."""
        x = np.zeros(self._model.nv)
        cosines = q[self._q_index]
        x[self._x_index] = cosines
        circle = self._is_circle
        index = self._q_index[circle]
        x[self._x_index[circle]] = np.arctan2(q[index + 1], cosines[circle])
        if near is not None:
            turned = self._x_index[circle]
            x[turned] += 2.0 * np.pi * np.round((near[turned] - x[turned]) / (2.0 * np.pi))
        return x

    def configurations(self, x: Array) -> Array:
        """Return the configurations (k, nq) of coordinates (k, n)."""
        q = np.zeros((len(x), self._model.nq))
        values, circle = x[:, self._x_index], self._is_circle
        q[:, self._q_index[~circle]] = values[:, ~circle]
        q[:, self._q_index[circle]], q[:, self._q_index[circle] + 1] = (
            np.cos(values[:, circle]),
            np.sin(values[:, circle]),
        )
        return q

    def _ranges(self) -> tuple[Array, Array]:
        """Return the ranges (n,) of all coordinates, infinite of joints without limits."""
        bounds, n = self.scene.robot.bounds(), self._model.nv
        lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
        lower[bounds.v_index], upper[bounds.v_index] = bounds.lower + _MARGIN, bounds.upper - _MARGIN
        sliding = np.unique(self._columns[~self._turns])
        endless = sliding[~(np.isfinite(lower[sliding]) & np.isfinite(upper[sliding]))]
        if len(endless):
            names = [self.scene.robot.coordinate_names[i] for i in endless.tolist()]
            raise ConfigError(f"no plans with joints that slide without limits: {', '.join(names)}; give them limits")
        return lower, upper

    def ranges(self, points: Array) -> tuple[Array, Array]:
        """Return the ranges (n,) that are planned in, given coordinates (k, n) that are to be in them.

        Of a joint that can turn farther than once around, half a turn to both sides of its zero, and what is between
        there and the points; where it has no limits, half a turn to both sides of the first point.
        """
        low, high, turning = points.min(axis=0), points.max(axis=0), np.isinf(self._lower)
        winding = np.zeros(len(low), dtype=bool)
        winding[self._columns[self._turns]] = True
        winding &= self._upper - self._lower > 2.0 * np.pi
        lower = np.where(winding, np.maximum(self._lower, -np.pi), self._lower)
        upper = np.where(winding, np.minimum(self._upper, np.pi), self._upper)
        lower[turning], upper[turning] = points[0, turning] - np.pi, points[0, turning] + np.pi
        return np.minimum(lower, low), np.maximum(upper, high)

    # --- bounds on travel

    def _lever_bounds(self) -> tuple[Array, Array]:
        """Return bounds on the lever arms of each column about the origins of joints, and on path lengths.

        Returns:
            (njoints, e) distance from the joint of a column to the origin of a joint that it moves, along the links
            in between; (e,) factor of each column: that of a mimic.
        """
        model, count = self._model, len(self._columns)
        lengths, factors = np.zeros((model.njoints, count)), np.ones(count)
        multiplier, axes = self._arrays.multiplier, self._arrays.motions
        travel = np.zeros(model.njoints)
        for c in range(count):
            joint = self._column_joints[c]
            factors[c] = abs(multiplier[joint])
            if not self._turns[c]:
                x = self._columns[c]
                largest = max(abs(self._lower[x]), abs(self._upper[x])) + _MARGIN
                travel[joint] = factors[c] * largest + abs(self._arrays.origin[joint])
        for i in range(1, model.njoints):
            for c in np.flatnonzero(self._masks[i]).tolist():
                joint, parent = self._column_joints[c], model.parents[i]
                if joint == i:
                    continue
                step = model.jointPlacements[i].translation
                if joint == parent and self._turns[c]:
                    axis = axes[c, 3:] / np.linalg.norm(axes[c, 3:])
                    step = step - axis * (axis @ step)
                lengths[i, c] = lengths[parent, c] + float(np.linalg.norm(step)) + travel[i]
        return lengths, factors

    def _body_levers(self) -> Array:
        """Return bounds on the travel (g, e) of any point of each body per unit of each column's coordinate."""
        table, arrays = self.distances.table, self._arrays
        levers = np.zeros((len(table.spheres), len(self._columns)))
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, 8).T
        for g, joint in enumerate(table.joints.tolist()):
            if joint <= 0:
                continue
            pose = table.placements[g]
            rotation, center = pose[:9].reshape(3, 3), table.spheres[g, :3]
            sphere = center @ rotation + pose[9:]
            corners = (table.boxes[g, :3] + signs * table.boxes[g, 3:]) @ rotation + pose[9:]
            extension = min(np.linalg.norm(sphere) + table.spheres[g, 3], np.linalg.norm(corners, axis=1).max())
            levers[g] = self._lengths[joint] + extension
            for c in np.flatnonzero((self._column_joints == joint) & self._turns).tolist():
                axis = arrays.motions[c, 3:] / np.linalg.norm(arrays.motions[c, 3:])
                around = [p - np.outer(p @ axis, axis) for p in (sphere[None], corners)]
                radii = [np.linalg.norm(p, axis=1).max() for p in around]
                levers[g, c] = min(radii[0] + table.spheres[g, 3], radii[1])
            levers[g] = np.where(self._turns, levers[g], 1.0) * self._levers * self._masks[joint]
        return levers

    # --- pairs

    def update(self) -> None:
        """Take over which pairs count, what is attached, and what is in the spare slots."""
        table = self.distances.table
        known = (
            table.separable.tobytes(), table.ignored.tobytes(), table.joints.tobytes(), table.placements.tobytes(),
            table.spheres.tobytes(), table.method.tobytes(),
        )  # fmt: skip
        if known == self._known:
            return
        self._known, self._allowance, scene = known, None, self.scene
        selected = table.separable & ~table.ignored & (table.group == np.arange(len(table.group)))
        self.pairs: IntArray = np.flatnonzero(selected)
        """(k,) numbers of the pairs that count."""
        first, second = self.first, self.second = np.ascontiguousarray(scene.pairs[self.pairs].T, dtype=np.intp)
        levers = self.body_lever = self._body_levers()
        rows = np.abs(table.support[self.pairs]) * (levers[first] + levers[second])
        folded = np.zeros((len(rows), self._model.nv))
        np.add.at(folded.T, self._columns, rows.T)
        self.lever, self.row = np.unique(folded, axis=0, return_inverse=True)
        self.row = self.row.reshape(-1).astype(np.intp)
        self.travel = np.maximum(folded.max(axis=0, initial=0.0), _LEAST_TRAVEL)
        of = np.array([i if i not in table.attached else -1 for i in scene.obstacle_of.tolist()], dtype=np.intp)
        self.obstacle = np.where(of[second] >= 0, of[second], of[first])
        clouds = {number: k for k, number in enumerate(scene.clouds)}
        self.cloud = np.array([clouds.get(i, -1) for i in of[second].tolist()], dtype=np.intp)
        radius = table.spheres[:, 3]
        self.radii = np.where(self.cloud < 0, radius[first] + radius[second], np.inf)
        self._lay_out_shapes()

    def _lay_out_shapes(self) -> None:
        """Choose how distances are computed: of what is not convex, the hull stands for it."""
        table, arrays = self.distances.table, self.distances.arrays
        method, shapes = table.method, table.shapes
        self.hulls: set[str] = set()
        if (method[self.pairs] <= SPARE_BY_COAL).any():
            geometries = [hull(body.geometry) for body in self.scene.geometry.geometryObjects]
            names = [body.name for body in self.scene.geometry.geometryObjects]
            self.hulls = {names[i] for i in np.flatnonzero(shapes.kind == OTHER).tolist()}
            shapes = convex_shapes(geometries)
            method = pair_methods(shapes, self.scene.pairs)
            if left := self.pairs[method[self.pairs] == BY_COAL].tolist():
                pair = " - ".join(self.scene.pair_names[left[0]])
                raise ConfigError(f"no plans with {pair}: only coal computes the distance of such shapes")
        self._packed = kernels.pack(arrays._replace(shapes=shapes, method=method))

    def needs(self, safety_distance: float) -> Array:
        """Return the safety distance (k,) of each pair, with the uncertainty of its obstacle [m]."""
        if self._allowance is None or self._allowance[0] != safety_distance:
            self._allowance = safety_distance, self.scene.distance_allowance(safety_distance)
        own = safety_distance - self._allowance[1][self.pairs]
        margin = np.append(self.distances.arrays.margin[: len(self.scene.slots)], 0.0)
        return np.asarray(own + margin[self.obstacle])

    def arrays(
        self, states: Array, points: Array, speed: Array, longest: float, frame_ids: list[int]
    ) -> PlanningArrays:
        """Lay out the memory of one plan.

        Args:
            states: of the obstacles at its time 0 (o, 18).
            points: coordinates (k, n) of its start and goals.
            speed: of each coordinate at most (n,) [rad/s or m/s].
            longest: length of an edge at most, see `PlanningArrays`.
            frame_ids: frames of its targets.
        """
        scene, frames = self.scene, [self._model.frames[i] for i in frame_ids]
        linear, angular = (np.linalg.norm(states[:, i : i + 3], axis=1) for i in (12, 15))
        radii = self.distances.obstacle_radii
        point_speed = linear + np.where(angular > 0.0, angular * np.where(angular > 0.0, radii, 0.0), 0.0)
        clouds = np.array([i in scene.clouds for i in range(len(scene.slots))], dtype=bool)
        voxels, blocks, block_start, cloud_start = self._voxels(states)
        lower, upper = self.ranges(points)
        placements = np.array([[*f.placement.rotation.T.ravel(), *f.placement.translation] for f in frames])
        of_frames = self._arrays._replace(
            frame_ids=np.arange(len(frames)),
            frame_joints=np.array([frame.parentJoint for frame in frames], dtype=np.intp),
            frame_placements=placements.reshape(-1, 12),
            frame_poses=np.zeros((len(frames), 12)),
        )
        support = np.vstack([self._masks[[frame.parentJoint for frame in frames]], np.zeros(len(self._columns))])
        return PlanningArrays(
            kinematics=self._bare,
            frames=kernels.pack(of_frames),
            distances=self._packed,
            joint_poses=self._arrays.joint_poses,
            lower=lower,
            upper=upper,
            speed=speed,
            travel=self.travel,
            longest=longest,
            radius=self.distances.table.spheres[:, 3],
            boxes=self.distances.table.boxes,
            pairs=self.pairs,
            first=self.first,
            second=self.second,
            radii=self.radii,
            cloud=self.cloud,
            row=self.row,
            lever=self.lever,
            body_lever=self.body_lever,
            factors=self._levers,
            obstacle=self.obstacle,
            point_speed=np.append(np.where(clouds, 0.0, point_speed), 0.0),
            moving=np.flatnonzero((point_speed > 0.0) & ~clouds),
            states=states,
            voxels=voxels,
            blocks=blocks,
            block_start=block_start,
            cloud_start=cloud_start,
            columns=self._columns,
            frame_support=support,
            **scratch(self._model.nv, len(self.lever), len(self.pairs), len(self.body_lever), self._model.njoints),
        )

    def _voxels(self, states: Array) -> tuple[Array, Array, IntArray, IntArray]:
        """Return the voxels of all clouds, and their blocks, in the world; see `PlanningArrays`."""
        centers, blocks, starts, counts = [np.zeros((0, 3))], [np.zeros((0, 4))], [0], [0]
        for index in self.scene.clouds:
            voxels, state = self.distances.voxels(index), states[index]
            rotation, position = state[:9].reshape(3, 3), state[9:12]
            centers.append(voxels.centers @ rotation + position)
            blocks.append(np.column_stack((voxels.blocks[:, :3] @ rotation + position, voxels.blocks[:, 3])))
            starts += (starts[-1] + voxels.starts[1:]).tolist()
            counts.append(len(starts) - 1)
        return np.concatenate(centers), np.concatenate(blocks), np.array(starts, np.intp), np.array(counts, np.intp)


def describe(scene: Scene, pair: int, hulls: set[str]) -> tuple[str, ...]:
    """Return the names of a pair's bodies, with a remark where a hull stands for one."""
    return tuple(f"the hull of {name}" if name in hulls else name for name in scene.pair_names[pair])
