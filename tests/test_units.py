"""Lengths and angles among the coordinates are distinguished in the robot, the log and the figures."""

import numpy as np
import pinocchio as pin
import pytest
from conftest import write_chain
from numpy.testing import assert_allclose

from qpavoid import Log, Robot, load_scenario
from qpavoid.run.simulate import simulate

OBLIQUE = np.array([0.6, 0.0, 0.8])
JOINTS = [
    (pin.JointModelRX(), "rad"),
    (pin.JointModelRUBZ(), "rad"),
    (pin.JointModelRevoluteUnaligned(OBLIQUE), "rad"),
    (pin.JointModelSpherical(), "rad rad rad"),
    (pin.JointModelPX(), "m"),
    (pin.JointModelPY(), "m"),
    (pin.JointModelPZ(), "m"),
    (pin.JointModelPrismaticUnaligned(OBLIQUE), "m"),
    (pin.JointModelTranslation(), "m m m"),
    (pin.JointModelPlanar(), "m m rad"),
    (pin.JointModelFreeFlyer(), "m m m rad rad rad"),
]


def robot_of(joints):
    """A chain of bare joints."""
    model, parent = pin.Model(), 0
    for i, joint in enumerate(joints):
        placement = pin.SE3(pin.exp3(np.array([0.3, -0.2, 0.5])), np.array([0.1, 0.2, 0.3]))
        parent = model.addJoint(parent, joint, placement, f"j{i}")
    return Robot("chain", model, pin.GeometryModel(), pin.neutral(model), (), "")


def test_lengths_are_the_coordinates_that_turn_nothing():
    """A coordinate is an angle where a unit of its velocity turns the joint by 1 rad/s, a length where it shifts it."""
    robot = robot_of([joint for joint, _ in JOINTS])
    units = robot.coordinate_units
    assert units == " ".join(unit for _, unit in JOINTS).split()
    assert len(units) == len(robot.coordinate_names) == robot.model.nv
    q = pin.integrate(robot.model, robot.home, np.random.default_rng(0).uniform(-1.0, 1.0, robot.model.nv))
    jacobian = pin.computeJointJacobians(robot.model, robot.model.createData(), q)
    turn = np.linalg.norm(jacobian[3:], axis=0)
    assert_allclose(turn, [{"m": 0.0, "rad": 1.0}[unit] for unit in units], atol=1e-12)


def chain_run(folder, joint_type: str, root_joint: str) -> Log:
    """A few ticks of a chain that moves its last link along x."""
    write_chain(folder, joint_type=joint_type)
    limits = "" if root_joint == "fixed" else "limits: {velocity: {root_joint: 1.0}}\n"
    (folder / "robot.yaml").write_text(
        f"name: chain\nurdf: chain.urdf\nbodies: capsule\nroot_joint: {root_joint}\n{limits}"
    )
    (folder / "scene.yaml").write_text(
        "robot: robot.yaml\n"
        "tasks: [{frame: link3, motion: {type: line, displacement: [0.1, 0, 0], speed: 0.1}}]\n"
        "avoidance: {d1: 0.01, d2: 0.02}\n"
        "solver: tracking\ndt: 0.01\nduration: 0.1\n"
    )
    return simulate(load_scenario(str(folder / "scene.yaml")))


@pytest.mark.parametrize(
    ("joint_type", "root_joint", "units", "position", "speed"),
    [
        ("prismatic", "fixed", "m m m", "[m]", "[m/s]"),
        ("revolute", "planar", "m m rad rad rad rad", "[rad or m]", "[rad/s or m/s]"),
    ],
)
def test_log_holds_units_and_figures_show_them(tmp_path, joint_type, root_joint, units, position, speed):
    pytest.importorskip("matplotlib")
    from qpavoid.viz.compare import compare_time_figure
    from qpavoid.viz.figures import joints_figure, speeds_figure

    log = Log.load(chain_run(tmp_path, joint_type, root_joint).save(tmp_path / "log.npz"))
    assert log.meta["units"] == units.split()
    assert len(log.meta["units"]) == len(log.meta["coordinates"]) == log.v.shape[1]
    assert joints_figure(log).get_supylabel() == f"joint position {position}"
    assert speeds_figure(log).axes[0].get_ylabel() == f"joint velocity {speed}"
    assert compare_time_figure([log]).axes[-1].get_ylabel() == f"fastest joint\n{speed}"
