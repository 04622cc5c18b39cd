"""Pairs of bodies that slide into each other by design: the segments of a telescope, the finger in its guide."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.model.pairs import pair_array
from qpavoid.model.robot import Robot
from qpavoid.problem import Array
from qpavoid.setup.sampling import BoolArray, PairSamples

_LEAST = 0.1
"""Share of the samples in which such a pair touches, at the least: what touches more seldom meets an end stop [-]."""
_ERRORS = 0.01
"""Share of the samples in which the extension may fail to predict whether the pair touches [-]."""
_STRAIGHT = 1e-6
"""Departure of a path from a straight line, as a share of its length, that is rounding [-]."""


def nested_pairs(robot: Robot, pair_samples: PairSamples) -> BoolArray:
    """Find the pairs (m,) that overlap when a telescope is drawn in.

    Two conditions. The origin of one body's joint moves along a straight line as seen from the other's, so that nothing
    but prismatic joints with a common axis moves it; and its place along that line alone decides whether they touch:
    always on one side of a threshold, never on the other. A pair that meets an obstacle of the robot's own, such as two
    carriages on one rail, touches in the middle of its range or only near an end, and stays.

    Args:
        robot: with its pairs.
        pair_samples: of these pairs.
    """
    bodies = robot.bodies.geometryObjects
    is_nested = np.zeros(len(pair_samples.contact), dtype=bool)
    candidates = np.flatnonzero((pair_samples.touching.mean(axis=0) >= _LEAST) & ~pair_samples.always).tolist()
    if not candidates:
        return is_nested
    poses = _joint_poses(robot.model, pair_samples.poses)
    pairs = pair_array(robot.bodies)
    for index in candidates:
        a, b = (bodies[int(i)].parentJoint for i in pairs[index])
        for one, other in ((a, b), (b, a)):
            extension = _along_line(poses[:, one], poses[:, other])
            if extension is not None and _decides(extension, pair_samples.touching[:, index]):
                is_nested[index] = True
    return is_nested


def _joint_poses(model: Any, samples: Array) -> Array:
    """Compute world poses (k, joints, 4, 4) of all joints in configurations (k, nq)."""
    data, poses = model.createData(), []
    for q in samples:
        pin.forwardKinematics(model, data, q)
        poses.append([pose.homogeneous for pose in data.oMi])
    return np.array(poses)


def _along_line(frames: Array, origins: Array) -> Array | None:
    """Return the place (k,) of origins along a straight line, as seen from frames [m].

    None if they do not keep to one.
    """
    offset = origins[:, :3, 3] - frames[:, :3, 3]
    in_frame = np.einsum("kij,ki->kj", frames[:, :3, :3], offset)
    centred = in_frame - in_frame.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    if sizes[0] < 1e-6 or sizes[1] > _STRAIGHT * sizes[0]:
        return None
    return np.asarray(centred @ axes[0])


def _decides(extension: Array, touching: BoolArray) -> bool:
    """Return True if a threshold of the extension (k,) separates touching samples (k,)."""
    in_order = touching[np.argsort(extension)]
    below = np.concatenate(([0], np.cumsum(in_order)))
    count, total = np.arange(len(in_order) + 1), int(below[-1])
    errors_low = (count - below) + (total - below)  # those below touch, those above do not
    return bool(min(errors_low.min(), (len(in_order) - errors_low).min()) <= _ERRORS * len(in_order))
