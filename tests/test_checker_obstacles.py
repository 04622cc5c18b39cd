"""MuJoCo as independent checker of clouds, attached objects, decomposed meshes and half-spaces."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import drive, make_controller
from conftest import random_q
from test_shapes import SHELF, boards
from urdfs import write_stl

from qpavoid import Avoidance, Obstacle, Robot, Status, build_scene
from qpavoid.config import Box, Capsule, Ellipsoid, HalfSpace, Mesh
from qpavoid.geometry.bodies import make_shape

pytest.importorskip("mujoco")

from qpavoid.run.mujoco import build

TCP, HOLD = "panda_hand_tcp", 0.02


def smallest_distances(controller, checked, ticks, target, updates=None):
    """Return the smallest distance of every pair in a closed loop, checked five times in each step."""
    least = np.full(len(checked.scene.pairs), np.inf)
    for tick in drive(controller, controller.scene.robot.home.copy(), ticks, target=target, obstacles=updates):
        assert tick.solution.status is Status.SOLVED, tick.solution.reasons
        for share in (0.2, 0.4, 0.6, 0.8, 1.0):
            checked.place(checked.integrate(tick.state.q, tick.solution.v, share * controller.dt), 0.0)
            least = np.minimum(least, [checked.distance(pair) for pair in range(len(least))])
    return least


def tool_at(robot):
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.home)
    return data.oMf[robot.model.getFrameId(TCP)].copy()


def test_distances_to_the_new_shapes(panda, tmp_path):
    mesh = Mesh(path=str(write_stl(tmp_path / "shelf.stl", boards(*SHELF))))
    shapes = [Ellipsoid(radii=(0.1, 0.2, 0.1)), HalfSpace(), mesh]
    scene = build_scene(panda, [Obstacle.at(f"o{i}", s, [0.5, 0.1, 0.2 * i - 0.2]) for i, s in enumerate(shapes)])
    checked, rng, count = build(scene, panda.home), np.random.default_rng(0), 0
    for _ in range(8):
        q = random_q(panda, rng)
        checked.place(q, 0.0)
        model, data = panda.model, scene.geometry.createData()
        pin.updateGeometryPlacements(model, model.createData(), scene.geometry, data, q)
        pin.computeDistances(scene.geometry, data)
        for pair, result in enumerate(data.distanceResults):
            if result.min_distance > 0.0:
                assert checked.distance(pair) == pytest.approx(result.min_distance, abs=2e-4), scene.pair_names[pair]
                count += 1
    assert count > 150


def test_attached_object_equals_body_of_robot(panda):
    """The checker's robot has the box welded to its hand, by its own description."""
    tool = tool_at(panda)
    held = tool * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.14]))
    box, pole = Box(size=(0.06, 0.06, 0.24)), Capsule(radius=0.025, length=0.16)
    at = held.translation + np.array([0.02, 0.2, -0.02])
    load = Obstacle.at("box", box, held.translation, held.rotation, graspable=True)
    avoidance = Avoidance(d1=HOLD, d2=0.1)
    controller = make_controller(panda, [load, Obstacle.at("pole", pole, at)], TCP, avoidance=avoidance)
    controller.attach("box", TCP, panda.home)
    welded = _with_body(panda, "box", box, pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.14])))
    checked = build(build_scene(welded, [Obstacle.at("pole", pole, at)]), panda.home)
    pair = checked.scene.pair_names.index(("box", "pole"))
    start = tool.translation

    def way(t):
        return start + np.array([0.0, min(0.3 * t, 0.4), 0.0])

    assert HOLD - 1e-3 < smallest_distances(controller, checked, 150, way)[pair] < HOLD + 0.03
    alone = make_controller(panda, [Obstacle.at("pole", pole, at)], TCP, avoidance=avoidance)
    assert smallest_distances(alone, checked, 150, way)[pair] < 0.0


def _with_body(robot: Robot, name, shape, inside):
    """The robot with one more body, in its tool's frame."""
    bodies, frame = robot.bodies.copy(), robot.model.frames[robot.model.getFrameId(TCP)]
    bodies.addGeometryObject(
        pin.GeometryObject(name, frame.parentJoint, 0, frame.placement * inside, make_shape(shape))
    )
    return replace(robot, bodies=bodies)
