"""Forward kinematics and Jacobians of one configuration."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.kernels.kinematics import FREE, PLANAR, PRISMATIC, REVOLUTE, SPHERICAL, TRANSLATION, UNBOUNDED
from qpavoid.model.views import read_poses
from qpavoid.problem import Array, IntArray, Mask

MIMIC = "JointModelMimic"
"""A joint that another joint's coordinate moves, at a constant ratio; it has none of its own."""

_KINDS = {
    REVOLUTE: "JointModel(R[XYZ]|RevoluteUnaligned)",
    UNBOUNDED: "JointModelR(UB[XYZ]|evoluteUnboundedUnaligned)",
    PRISMATIC: "JointModelP([XYZ]|rismaticUnaligned)",
    TRANSLATION: "JointModelTranslation",
    PLANAR: "JointModelPlanar",
    SPHERICAL: "JointModelSpherical",
    FREE: "JointModelFreeFlyer",
}
"""Joint types of Pinocchio that the kernels know."""


class Kinematics(NamedTuple):
    """Where the tracked frames are, and how everything moves with v, until the next control step overwrites it."""

    J: Array
    """(6, e) world Jacobian: column j is the twist of joint j [linear velocity of the body point at the world
    origin; angular velocity], for every joint of the robot. e = nv, and one more for each joint that mimics another
    one: its column is moved by the other's coordinate, see `columns`."""
    poses: Array
    """(f, 12) world poses of the tracked frames: rotation by columns, then position [m]."""

    @property
    def position(self) -> Array:
        """(f, 3) world positions of the tracked frames [m]."""
        return self.poses[:, 9:]

    @property
    def rotation(self) -> Array:
        """(f, 3, 3) world orientations of the tracked frames."""
        return np.swapaxes(self.poses[:, :9].reshape(-1, 3, 3), 1, 2)


class ForwardKinematics:
    """Joint placements, world Jacobian and the poses of some frames, in memory that every call overwrites.

    A kernel computes them; of joints that it does not know (helical, universal, composite), Pinocchio does.
    """

    def __init__(self, model: Any, frame_ids: Sequence[int] = ()) -> None:
        """Allocate the memory of all results.

        Args:
            model: pinocchio model.
            frame_ids: the f frames to keep up to date.
        """
        self._data = data = model.createData()
        self._model, self._ids = model, list(frame_ids)
        pin.framesForwardKinematics(model, data, pin.neutral(model))
        pin.computeJointJacobians(model, data, pin.neutral(model))
        self.J: Array = np.array(data.J.reshape(6, model.nvExtended, order="F"), order="C")  # a vector for one joint
        """(6, e) see `Kinematics.J`."""
        self.joint_poses: Array = read_poses(data.oMi)
        """(njoints, 12) world poses of all joints."""
        self.frame_poses: Array = read_poses(data.oMf)
        """(frames, 12) world poses of all frames; only the frames `frame_ids` are kept up to date."""
        kinds = [_joint_kind(model, data, i) for i in range(model.njoints)]
        self.arrays = self._lay_out(kinds)
        """The same memory, as kernels see it."""
        self.packed = kernels.pack(self.arrays)
        self.is_compiled = min(kinds) >= 0
        """Whether the kernel computes everything."""

    def compute(self, q: Array) -> None:
        """Compute everything at a configuration q (nq,)."""
        if self.is_compiled:
            kernels.update_kinematics(self.packed, q)
            return
        model, data = self._model, self._data
        pin.computeJointJacobians(model, data, q)
        for frame_id in self._ids:
            pin.updateFramePlacement(model, data, frame_id)
        self.J[:] = data.J.reshape(6, -1, order="F")
        self.joint_poses[:], self.frame_poses[:] = read_poses(data.oMi), read_poses(data.oMf)

    @cached_property
    def _support(self) -> Array:
        """(njoints, e) see `support_masks`."""
        return support_masks(self._model)

    @cached_property
    def _fold(self) -> Array:
        """(e, nv) adds up the columns that the same coordinate moves."""
        return np.eye(self._model.nv)[columns(self._model)]

    def frame_jacobian(self, frame_id: int) -> Array:
        """Return the Jacobian (6, nv) of a frame: velocity of its origin and its angular velocity, in world axes.

        Args:
            frame_id: of a frame that is kept up to date.
        """
        linear, angular = (self.J * self._support[self._model.frames[frame_id].parentJoint]).reshape(2, 3, -1)
        x = self.frame_poses[frame_id, 9:]
        return np.asarray(np.concatenate((linear - pin.skew(x) @ angular, angular)) @ self._fold)

    def center_of_mass(self, q: Array) -> tuple[Array, Array]:
        """Return the centre of mass (3,) at q (nq,), world [m], and its Jacobian (3, nv)."""
        J = pin.jacobianCenterOfMass(self._model, self._data, q)
        return np.array(self._data.com[0]), np.asarray(J)

    def momentum_matrix(self, q: Array) -> Array:
        """Return A_g (6, nv) at q (nq,): A_g v is momentum, then angular momentum about the centre of mass, world."""
        return np.asarray(pin.computeCentroidalMap(self._model, self._data, q))

    def _lay_out(self, kinds: Sequence[int]) -> kernels.KinematicsArrays:
        model, data, joints = self._model, self._data, list(self._model.joints)
        owners, frames = column_joints(model), [model.frames[i] for i in self._ids]
        scaling = [_mimicry(joint)[0] for joint in joints]
        motions = np.array(
            [data.oMi[j].actInv(pin.Motion(self.J[:, c])).vector for c, j in enumerate(owners.tolist())]
        ).reshape(-1, 6)
        placements, turns = read_poses(model.jointPlacements), np.zeros((model.njoints, 2, 9))
        slides = np.zeros((model.njoints, 3))
        for i in range(1, model.njoints):
            first, last = motions[owners == i][0] / scaling[i], motions[owners == i][-1] / scaling[i]
            cross, rotation = pin.skew(last[3:]), model.jointPlacements[i].rotation
            turns[i] = [(rotation @ k).ravel(order="F") for k in (cross, cross @ cross)]
            slides[i] = rotation @ first[:3]
        return kernels.KinematicsArrays(
            kind=np.array(kinds, dtype=np.intp),
            parents=np.array(list(model.parents), dtype=np.intp),
            q_index=np.array([joint.idx_q for joint in joints], dtype=np.intp),
            multiplier=np.array(scaling),
            origin=np.array([_mimicry(joint)[1] for joint in joints]),
            placements=placements,
            turns=turns,
            slides=slides,
            column_joints=owners,
            motions=motions,
            frame_ids=np.array(self._ids, dtype=np.intp),
            frame_joints=np.array([frame.parentJoint for frame in frames], dtype=np.intp),
            frame_placements=read_poses([frame.placement for frame in frames]),
            local_poses=read_poses(data.liMi),
            joint_poses=self.joint_poses,
            frame_poses=self.frame_poses,
            J=self.J,
        )


def _joint_kind(model: Any, data: Any, i: int) -> int:
    """Return the kind of joint i as the kernels call it, -1 of one that they do not know; of the world, any."""
    if i == 0:
        return REVOLUTE
    joint = model.joints[i]
    name = joint.shortname()
    if name == MIMIC:  # of one angle or length
        return REVOLUTE if data.J.reshape(6, -1, order="F")[3:, joint.idx_vExtended].any() else PRISMATIC
    return next((kind for kind, pattern in _KINDS.items() if re.fullmatch(pattern, name)), -1)


def _mimicry(joint: Any) -> tuple[float, float]:
    """Return by what the coordinate of a joint is multiplied, and what is added to it: 1 and 0 but for a mimic."""
    if joint.shortname() != MIMIC:
        return 1.0, 0.0
    mimic = joint.extract()
    return float(mimic.scaling), float(mimic.offset)


def columns(model: Any) -> IntArray:
    """Return the velocity coordinate that moves each column of the world Jacobian (e,)."""
    index = np.zeros(model.nvExtended, dtype=np.intp)
    for joint in list(model.joints)[1:]:
        width = joint.nvExtended
        index[joint.idx_vExtended : joint.idx_vExtended + width] = np.arange(joint.idx_v, joint.idx_v + width)
    return index


def column_joints(model: Any) -> IntArray:
    """Return the joint of each column of the world Jacobian (e,)."""
    widths = [joint.nvExtended for joint in list(model.joints)[1:]]  # that of the world counts for nothing
    return np.repeat(np.arange(1, model.njoints), widths)


def turning_columns(model: Any) -> Mask:
    """Return which columns of the world Jacobian (e,) turn; the coordinates of the others are lengths."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    return np.asarray(data.J.reshape(6, -1, order="F")[3:].any(axis=0))


def chains(model: Any) -> tuple[Array, Array]:
    """Return the rotation and the translation of each chain's end: twice (chains, nv).

    They are per unit of each velocity coordinate.

    One angle or length of a chain for each coordinate, as a rule; more where a joint mimics another one.
    """
    turns, rates = turning_columns(model), np.ones(model.nvExtended)
    for joint in list(model.joints)[1:]:
        if joint.shortname() == MIMIC:
            rates[joint.idx_vExtended] = abs(joint.extract().scaling)
    ends = np.setdiff1d(np.arange(1, model.njoints), list(model.parents))
    fold = rates[:, None] * np.eye(model.nv)[columns(model)]
    support = support_masks(model)[ends]
    return (support * turns) @ fold, (support * ~turns) @ fold


def max_lever_arm(model: Any, joint_radius: Array) -> float:
    """Bound the distance of any point of a body from a joint that turns it [m].

    Lengths of the links in between, one after the other, with what joints can slide; infinite where one can slide
    without a limit.

    Args:
        model: pinocchio model.
        joint_radius: distance from each joint's origin to the farthest point that it carries (njoints,) [m].
    """
    lever_arm = np.zeros(model.njoints)  # from the first joint that turns to the origin of each one
    turns_below = np.zeros(model.njoints, dtype=bool)
    lower, upper = np.abs(model.lowerPositionLimit), np.abs(model.upperPositionLimit)
    turns = turning_columns(model)
    for i, joint in enumerate(list(model.joints)[1:], start=1):
        own_turns = turns[joint.idx_vExtended : joint.idx_vExtended + joint.nvExtended]
        parent, slides = model.parents[i], int((~own_turns).sum())  # lengths precede angles
        if turns_below[parent]:
            coordinates = slice(joint.idx_q, joint.idx_q + slides)
            slide = float(np.maximum(lower[coordinates], upper[coordinates]).sum())
            if slides and joint.shortname() == MIMIC:
                slide = abs(joint.extract().scaling) * slide + abs(joint.extract().offset)
            lever_arm[i] = lever_arm[parent] + float(np.linalg.norm(model.jointPlacements[i].translation)) + slide
        turns_below[i] = turns_below[parent] or own_turns.any()
    return float(np.max((lever_arm + joint_radius)[turns_below], initial=0.0))


def support_masks(model: Any) -> Array:
    """Return which columns of the world Jacobian move which joint (njoints, e).

    Entries are 0 and 1; row 0, the world, is all 0.
    """
    mask = np.zeros((model.njoints, model.nvExtended))
    for joint in range(1, model.njoints):
        for ancestor in list(model.supports[joint])[1:]:  # without the world, which supports everything
            start, width = model.joints[ancestor].idx_vExtended, model.joints[ancestor].nvExtended
            mask[joint, start : start + width] = 1.0
    return mask
