"""Kinematics of every robot that ships, and of every kind of joint, by Pinocchio and by finite differences."""

import numpy as np
import pinocchio as pin
import pytest
from conftest import random_q

from qpavoid import Robot
from qpavoid.config.shipped import shipped_names
from qpavoid.model.kinematics import ForwardKinematics, columns

KINDS = ["RX", "RY", "RZ", "RUBX", "RevoluteUnaligned", "PX", "PrismaticUnaligned", "Translation", "Planar",
         "Spherical", "FreeFlyer"]  # fmt: skip


def chain(rng):
    """A tree of one joint of each kind, in random poses and with masses."""
    model, parent, axis = pin.Model(), 0, np.array([0.36, -0.48, 0.8])
    for number, kind in enumerate(KINDS):
        make = getattr(pin, f"JointModel{kind}")
        joint = make(axis) if kind.endswith("Unaligned") else make()
        parent = model.addJoint(parent if number % 4 else parent // 2, joint, pin.SE3.Random(), f"j{number}")
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Identity())
        model.addBodyFrame(f"b{number}", parent, pin.SE3.Random(), 0)
    return model


def compare(model, q):
    """Everything at one configuration, to 1e-12."""
    data, ids = model.createData(), list(range(model.nframes))
    kinematics = ForwardKinematics(model, ids)
    assert kinematics.is_compiled
    kinematics.compute(q)
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    pairs = [(kinematics.joint_poses, data.oMi), (kinematics.frame_poses, data.oMf)]
    for poses, placements in pairs:
        for pose, placement in zip(poses, placements, strict=True):
            np.testing.assert_allclose(pose[:9].reshape(3, 3).T, placement.rotation, rtol=0, atol=1e-12)
            np.testing.assert_allclose(pose[9:], placement.translation, rtol=0, atol=1e-12)
    np.testing.assert_allclose(kinematics.J, data.J.reshape(6, -1, order="F"), rtol=0, atol=1e-12)
    for i in ids:
        J = pin.getFrameJacobian(model, data, i, pin.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(kinematics.frame_jacobian(i), J, rtol=0, atol=1e-12)
    return kinematics


def differences(model, kinematics, q, of, step=1e-6):
    """Central differences (n, nv) of something of the kinematics along each velocity coordinate."""
    found = []
    for e in step * np.eye(model.nv):
        sides = []
        for sign in (1.0, -1.0):
            kinematics.compute(pin.integrate(model, q, sign * e))
            sides.append(np.array(of(kinematics)))
        found.append((sides[0] - sides[1]) / (2.0 * step))
    return np.array(found).T


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", shipped_names("robot"))
def test_kinematics_of_a_robot_that_ships(name):
    robot = Robot.load(name)
    model, rng = robot.model, np.random.default_rng(3)
    for _ in range(3):
        q = random_q(robot, rng)
        kinematics = compare(model, q)
    for i in (model.nframes - 1, model.nframes // 2):
        J = kinematics.frame_jacobian(i)[:3]
        moved = differences(model, kinematics, q, lambda x, i=i: x.frame_poses[i, 9:])
        np.testing.assert_allclose(J, moved, rtol=0, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_kinematics_of_every_kind_of_joint(seed):
    pin.seed(seed)
    rng = np.random.default_rng(seed)
    model = chain(rng)
    q = pin.integrate(model, pin.neutral(model), rng.uniform(-2.0, 2.0, model.nv))
    compare(model, q)
    assert columns(model).tolist() == list(range(model.nv))


def test_kinematics_without_a_kernel():
    """Of a helical joint, Pinocchio computes the same memory."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelHX(0.3), pin.SE3.Random(), "screw")
    model.addBodyFrame("tip", joint, pin.SE3.Random(), 0)
    kinematics, data, q = ForwardKinematics(model, [model.nframes - 1]), model.createData(), np.array([0.7])
    assert not kinematics.is_compiled
    kinematics.compute(q)
    J = pin.computeFrameJacobian(model, data, q, model.nframes - 1, pin.LOCAL_WORLD_ALIGNED)
    np.testing.assert_allclose(kinematics.frame_jacobian(model.nframes - 1)[:, 0], J, rtol=0, atol=1e-12)
