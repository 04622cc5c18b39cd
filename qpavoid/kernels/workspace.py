"""Memory of the numpy kernels: a layout as attributes, with scratch arrays and views that are made once."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.layout import RowLayout
from qpavoid.problem import Array, IntArray


class Rows(NamedTuple):
    """Views of the memory of the first k near pairs; see `RowLayout`."""

    near: IntArray
    closest: Array
    distance: Array
    normal: Array
    point: Array
    linear: Array
    """(3, k) normals; with `angular`, the moments, the columns of `screws` (6, k)."""
    angular: Array
    screw_rows: Array
    screws: Array
    J: Array
    drift: Array
    d: Array
    least: Array
    touch: Array
    beyond: Array
    share: Array
    outside: Array
    over: Array


class Workspace:
    """A layout as attributes, with scratch memory and views: a tick allocates and slices as little as it can."""

    def __init__(self, layout: RowLayout) -> None:
        for name, value in layout._asdict().items():
            setattr(self, name, value)
        (rows, nv), frames, pairs = layout.A.shape, len(layout.targets), len(layout.near)
        moving = len(layout.screws) // 3 - len(layout.turns)
        split, framed = 3 * moving, len(layout.screws)
        # numbers as arrays: a ufunc takes them in half the time
        self.damping2, self.rate_, self.quarter = (
            np.array([value]) for value in (layout.damping**2, layout.rate, 0.5 * np.pi)
        )
        self.offset_, self.hold_, self.d1_ = (np.array([value]) for value in (layout.offset, layout.hold, layout.d1))
        self.gain_, self.recovery_, self.zero = (np.array([v]) for v in (layout.row_gain, layout.recovery, 0.0))
        self.eased = bool(layout.slack.any())
        self.blend = np.array([0.5 * np.pi / (layout.d2 - layout.d1)])
        self.gain_column, self.moving_gain = layout.gain[:, None], layout.gain[:moving, None]
        self.A_frames, self.b_frames = layout.A[:framed], layout.b[:framed]
        self.fold = np.zeros((len(layout.columns), nv))
        self.fold[np.arange(len(layout.columns)), layout.columns] = 1.0
        self.here = layout.poses[:moving, 9:]
        self.turned = layout.poses[:, :9].reshape(-1, 3, 3)
        self.position, self.rotation = layout.targets[:moving, :3], layout.targets[:, 3:12].reshape(-1, 3, 3)
        self.linear, self.angular = layout.targets[:moving, 12:15], layout.targets[:, 15:]
        self.moments = layout.screws.reshape(-1, 3, 6)[:moving, :, 3:]
        self.wanted, self.wanted_turns = layout.b[:split].reshape(-1, 3), layout.b[split:framed].reshape(-1, 3)
        self.asked = self.b_frames.reshape(-1, 3)
        self.every_turns = len(layout.turns) == frames
        self.capped = bool(np.isfinite(layout.cap).any())
        self.gram = np.empty((rows, rows))
        self.gram_diagonal = self.gram.ravel()[:: rows + 1]
        self.over = np.empty(2 * nv + pairs)
        self.over_upper, self.over_lower = self.over[:nv], self.over[nv : 2 * nv]
        self.was_moving = True
        self.screw_columns = np.empty((6, pairs))
        self.scratch = np.empty((3, pairs))
        joints = len(layout.joint_poses)
        self.slides = bool(layout.sliding.any())
        carried_by = np.zeros((joints, len(layout.column_joints)))  # which columns of the Jacobian move which joint
        for joint in range(1, joints):
            carried_by[joint] = carried_by[layout.parents[joint]] + (layout.column_joints == joint)
        self.carried = carried_by.T
        self.origins = layout.joint_poses[:, 9:].T
        self.moved, self.joint_twists = np.empty((6, len(layout.column_joints))), np.empty((6, joints))
        self.squares, self.by_kind = np.empty((2, joints)), np.repeat(np.eye(2), 3, axis=1)
        self.joints = joints
        self.joint_speeds = layout.speeds[:joints]
        self.body_rotations = layout.body_poses[:, :9].reshape(-1, 3, 3)  # transposed
        # every joint has one coordinate and position limits: bounds are made in place, the lower and upper ones at once
        self.plain = np.array_equal(layout.q_index, np.arange(nv)) and np.array_equal(layout.v_index, np.arange(nv))
        self.q_limits = np.stack((layout.q_lower, layout.q_upper))
        self.room = np.empty_like(self.q_limits)
        self.signs = np.array([[-1.0], [1.0]])
        self.limited_step = layout.v_step[layout.v_index]
        self.finite_step = np.where(np.isfinite(self.limited_step), self.limited_step, 1.0)
        self.fastest = layout.v_max[layout.v_index]
        self.jerk_index = np.flatnonzero(np.isfinite(layout.w_step))
        self.jerk_unit, self.limited_jerk = layout.w_step[self.jerk_index], layout.w_step[layout.v_index]
        self.jerk_most = layout.v_step[self.jerk_index] / self.jerk_unit
        self.jerk_fastest = layout.v_max[self.jerk_index] / self.jerk_unit
        self.slowest, self.v_min = -self.fastest, -layout.v_max

        self._views: dict[int, Rows] = {}

    def rows(self, k: int) -> Rows:
        """Views of the first k near pairs: made once for each k."""
        if k not in self._views:
            closest = self.closest[:k]
            normal, point = closest.T[1:4], closest.T[4:7]
            screws = self.screw_columns[:, :k]
            self._views[k] = Rows(
                self.near[:k], closest, closest[:, 0], normal, point, screws[:3], screws[3:], screws.T, screws,
                self.J[:k], self.drift[:k], self.d[:k], self.least[:k], self.touch[:k],
                self.scratch[0, :k], self.scratch[1, :k],
                self.over[2 * len(self.v0) :][:k], self.over[: 2 * len(self.v0) + k],
            )  # fmt: skip
        return self._views[k]

    def __getattr__(self, name: str) -> Any:  # for the type checker: the fields of the layout
        raise AttributeError(name)
