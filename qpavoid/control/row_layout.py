"""The memory of a tick, laid out once: what kernels read of kinematics, distances, tasks and limits, and write."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from qpavoid.config import Avoidance, Limits
from qpavoid.control.avoidance import row_form
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.tasks import FrameTask, RowTask
from qpavoid.control.tasks.layout import task_layout
from qpavoid.kernels.layout import RowLayout
from qpavoid.model.kinematics import ForwardKinematics, chains, column_joints, columns, max_lever_arm
from qpavoid.model.limits import JointBounds, limit_layout
from qpavoid.model.scene import Scene
from qpavoid.problem import Array


def lay_out(
    scene: Scene,
    frames: Sequence[FrameTask],
    others: Sequence[RowTask],
    bounds: JointBounds,
    kinematics: ForwardKinematics,
    query: DistanceQuery,
    avoidance: Avoidance,
    limits: Limits,
    damping: float,
    dt: float,
    looks_ahead: bool = False,
) -> RowLayout:
    """Lay out memory of a controller, or of backup trajectories; see `RowLayout`.

    Args:
        scene: robot and obstacles.
        frames: frames that follow motions, those with a position first.
        others: all other tasks.
        bounds: limits of the joints.
        kinematics: whose memory is looked into.
        query: distances of the scene.
        avoidance: distances and rows.
        limits: use of the joint limits.
        damping: λ of the tracking law [-].
        dt: length of a tick [s].
        looks_ahead: see `RowLayout`.
    """
    model, pairs = scene.robot.model, len(scene.pairs)
    turning, sliding = chains(model)
    return RowLayout(
        J_world=kinematics.J,
        columns=columns(model),
        has_mimics=model.nvExtended > model.nv,
        unfolded_row=np.zeros(model.nvExtended),
        frame_poses=kinematics.frame_poses,
        **task_layout(frames, others, model),
        results=query.results,
        support=scene.support.copy(),
        twists=query.placing.twists,
        twist_row=query.twist_row,
        margin=query.placing.margin,
        distance_allowance=scene.distance_allowance(avoidance.safety_distance - avoidance.offset),
        joint_poses=kinematics.joint_poses,
        parents=np.array(list(model.parents), dtype=np.intp),
        column_joints=column_joints(model),
        joint_radius=query.joint_radius(),
        moved_by=query.moved_by(),
        bodies=np.array(scene.pairs, dtype=np.intp),
        body_poses=query.poses,
        boxes=query.boxes(),
        convex=query.convex(),
        chain_rotation=turning,
        chain_translation=sliding,
        omega=np.zeros((model.njoints, 3)),
        speeds=query.placing.speeds,
        near_pairs=np.zeros(pairs, dtype=np.intp),
        closest=np.zeros((pairs, 10)),
        J=np.zeros((pairs, model.nv)),
        feedforward=np.zeros(pairs),
        d=np.zeros(pairs),
        rhs=np.zeros(pairs),
        rhs_contact=np.zeros(pairs),
        **limit_layout(bounds, limits.position_gain, dt),
        v_tracking=np.zeros(model.nv),
        lever_arm=max_lever_arm(model, query.max_extension()),
        damping=damping,
        looks_ahead=looks_ahead,
        **row_form(avoidance),
    )


def hand_over(x: RowLayout, masks: Array, query: DistanceQuery) -> None:
    """Takes over which joint carries what, in place.

    Args:
        x: layout.
        masks: which columns of the Jacobian move which joint (njoints, e), see `support_masks`.
        query: distances that know who carries what.
    """
    joints = np.array([body.parentJoint for body in query.bodies], dtype=np.intp)[x.bodies]
    x.support[:] = masks[joints[:, 1]] - masks[joints[:, 0]]
    x.moved_by[:] = query.moved_by()
    x.joint_radius[:] = query.joint_radius()
