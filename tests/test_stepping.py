"""Contacts that come and leave in MuJoCo: a Talos shifts its weight, lifts a foot, and sets it down."""

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from conftest import EXAMPLES

from qpavoid import Controller, Robot, Sample, build_contacts, build_scene, build_tasks
from qpavoid.config import ComTask, Contact, Dynamics, PlantSettings, PostureTask, Task

pytest.importorskip("mujoco")

from qpavoid.run.torque_plant import TorquePlant

DT, ARMATURE = 1e-3, 0.01
LEFT, RIGHT = "left_sole_link", "right_sole_link"
CORNERS = [(0.1, 0.06, 0.0), (0.1, -0.06, 0.0), (-0.1, -0.06, 0.0), (-0.1, 0.06, 0.0)]
HEIGHT = 0.025
"""Asked of the foot [m]: it lags behind by what posture and friction take."""
SHIFT, LIFT, DOWN, BACK, END = 0.5, 2.5, 3.5, 4.0, 6.0
"""Times [s] from which the weight goes over, the left foot lifts, is back, the weight returns; the end."""


@pytest.fixture(scope="module")
def talos():
    """Talos half sitting."""
    folder = EXAMPLES / "talos_data"
    home = {}
    state = ET.parse(folder / "srdf" / "talos.srdf").find("group_state[@name='half_sitting']")
    for joint in state.iter("joint"):
        values = [float(value) for value in joint.get("value").split()]
        home[joint.get("name")] = values[0] if len(values) == 1 else values
    home.pop("root_joint")
    limits = {"velocity": {"root_joint": 10.0}}
    urdf = folder / "robots" / "talos_reduced.urdf"
    return Robot.from_urdf(urdf, root_joint="free_flyer", bodies=[], home=home, limits=limits)


def ease(t, begin, end):
    """Go from 0 to 1 between two times, at rest at both."""
    s = np.clip((t - begin) / (end - begin), 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def make_controller(robot, solver="qp", priority=1):
    tasks = [
        ComTask(weight=10.0, gain=3.0),
        Task(frame="base_link", type="orientation", gain=3.0),
        Task(frame=LEFT, type="pose", gain=10.0),
        PostureTask(weight=0.01, gain=2.0, priority=priority),
    ]
    contacts = [Contact(frame=frame, vertices=CORNERS) for frame in (LEFT, RIGHT)]
    return Controller(
        build_scene(robot), build_tasks(tasks, robot, robot.home), solver, DT,
        contacts=build_contacts(contacts, robot, robot.home),
        dynamics=Dynamics(tracking_rate=60.0, row_rate=300.0, armature=ARMATURE),
    )  # fmt: skip


class Stepping:
    """Talos on its feet in MuJoCo, with the references of a step on the spot."""

    def __init__(self, robot, controller):
        self.robot, self.controller, self.t = robot, controller, 0.0
        settings = PlantSettings(armature=ARMATURE, friction=0.1, damping=0.1)
        self.plant = TorquePlant(robot, robot.home, settings, [(frame, np.array(CORNERS)) for frame in (LEFT, RIGHT)])
        self.data = robot.model.createData()
        pin.framesForwardKinematics(robot.model, self.data, robot.home)
        self.com = pin.centerOfMass(robot.model, self.data, robot.home).copy()
        self.foot, self.other = (self.data.oMf[robot.model.getFrameId(name)].copy() for name in (LEFT, RIGHT))

    def step(self):
        """Go on by a control period; return the solution."""
        t = self.t
        over = ease(t, SHIFT, LIFT - 0.4) - ease(t, BACK, END - 0.5)
        up = ease(t, LIFT, LIFT + 0.3) - ease(t, DOWN - 0.3, DOWN)
        com = self.com.copy()
        com[:2] += over * (self.other.translation - self.foot.translation)[:2] * 0.5
        foot = Sample.at(self.foot.translation + HEIGHT * up * np.eye(3)[2], self.foot.rotation)
        q, v = self.plant.measure()
        solution = self.controller.step(q, t, {"com": Sample.at(com), LEFT: foot}, v=v)
        self.plant.apply(solution.torque, DT)
        self.t += DT
        return solution

    def lifted(self):
        """Height of the lowest corner of the left foot over where it was [m]."""
        return float((self.plant.point_positions() - self.start)[:4, 2].min())

    def has_fallen(self):
        return self.plant.q[2] < self.robot.home[2] - 0.1


@pytest.mark.slow
def test_a_foot_is_lifted_for_a_second_and_set_down(talos):
    """It stands on one foot, the other one 2 cm off the ground, and goes on standing on both."""
    controller = make_controller(talos)
    body = Stepping(talos, controller)
    body.start = body.plant.point_positions()
    statuses, highest, forces, slip = {}, 0.0, [], 0.0
    for k in range(round(END / DT)):
        if k == round((LIFT - 0.4) / DT):
            controller.set_contacts([RIGHT], 0.3)
        if k == round(DOWN / DT) + 50:
            controller.set_contacts([LEFT, RIGHT], 0.3)
        solution = body.step()
        statuses[solution.status.value] = statuses.get(solution.status.value, 0) + 1
        assert not body.has_fallen()
        highest = max(highest, body.lifted())
        slip = max(slip, float(body.plant.slip()[4:].max()))
        forces.append(body.plant.forces()[:4, 2].sum())
    forces = np.array(forces)
    print(f"\nlifted {1e3 * highest:.1f} mm, right foot slips {1e3 * slip:.2f} mm, {statuses}, {forces[::250].round()}")
    assert highest > 0.02
    assert (forces[round((LIFT + 0.3) / DT) : round((DOWN - 0.3) / DT)] == 0.0).all()
    assert forces[-200:].min() > 0.3 * 9.81 * pin.computeTotalMass(talos.model)
    assert "STOPPED" not in statuses  # bounds admit what a foot asks that comes while it still falls
    assert slip < 5e-3 and np.linalg.norm(body.plant.v) < 0.05


@pytest.mark.parametrize(("solver", "priority"), [("qp", 1), ("hqp", 2)])
def test_talos_stands(talos, solver, priority):
    body = Stepping(talos, make_controller(talos, solver, priority))
    statuses = {body.step().status.value for _ in range(150)}
    assert statuses <= {"SOLVED", "RELAXED"}  # accelerations, while it settles on its feet
    assert not body.has_fallen() and body.plant.slip().max() < 1e-3
