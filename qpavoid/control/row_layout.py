"""The memory of a tick, laid out once: what kernels read of kinematics, distances, tasks and limits, and write."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from qpavoid.control.avoidance import row_form
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.settings import ControlSettings
from qpavoid.control.tasks import FrameTask, RowTask
from qpavoid.control.tasks.layout import task_layout
from qpavoid.kernels import SUMMARY, RowLayout
from qpavoid.model.kinematics import ForwardKinematics, chains, columns, max_lever_arm
from qpavoid.model.limits import limit_layout


def lay_out(
    settings: ControlSettings,
    frames: Sequence[FrameTask],
    row_tasks: Sequence[RowTask],
    kinematics: ForwardKinematics,
    query: DistanceQuery,
) -> RowLayout:
    """Lay out memory of a controller, or of backup trajectories; see `RowLayout`.

    Args:
        settings: of the controller.
        frames: frames that follow motions, those with a position first.
        row_tasks: all other tasks.
        kinematics: whose memory is looked into.
        query: distances of the scene.
    """
    scene, avoidance = settings.scene, settings.avoidance
    model, pairs, table, x = scene.robot.model, len(scene.pairs), query.table, query.arrays
    turning, sliding = chains(model)
    return RowLayout(
        kinematics=kinematics.packed,
        distances=query.packed,
        J_world=kinematics.J,
        columns=columns(model),
        has_mimics=model.nvExtended > model.nv,
        unfolded_row=np.zeros(model.nvExtended),
        frame_poses=kinematics.frame_poses,
        **task_layout(frames, row_tasks, model, settings.dt),
        results=x.results,
        support=table.support,
        twists=x.twists,
        twist_row=table.twist_row,
        margin=x.margin,
        distance_allowance=scene.distance_allowance(settings.safety_distance),
        joint_poses=kinematics.joint_poses,
        parents=kinematics.arrays.parents,
        column_joints=kinematics.arrays.column_joints,
        joint_radius=table.joint_radius,
        moved_by=table.moved_by,
        bodies=x.pairs,
        body_poses=x.poses,
        boxes=table.boxes,
        convex=~table.is_mesh[scene.pairs].any(axis=1) & ~table.is_grouped,
        chain_rotation=turning,
        chain_translation=sliding,
        omega=np.zeros((model.njoints, 3)),
        speeds=x.speeds,
        near_pairs=np.zeros(pairs, dtype=np.intp),
        closest=np.zeros((pairs, 10)),
        J=np.zeros((pairs, model.nv)),
        feedforward=np.zeros(pairs),
        d=np.zeros(pairs),
        rhs=np.zeros(pairs),
        rhs_contact=np.zeros(pairs),
        **limit_layout(settings.bounds, settings.limits.position_gain, settings.dt),
        v_tracking=np.zeros(model.nv),
        v=np.zeros(model.nv),
        summary=np.zeros(1, SUMMARY).view(np.recarray),
        identity=np.eye(model.nv),
        lever_arm=max_lever_arm(model, table.max_extension()),
        looks_ahead=False,
        regularization=0.0,
        **row_form(avoidance),
    )
