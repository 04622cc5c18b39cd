"""Bodies that overlap already: signed normals, a bounded recovery, the margin restored and then held."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import Ruler, accelerations, cartesian, drive, make_controller

from qpavoid import Avoidance, Obstacle, Status
from qpavoid.config import Box, Capsule, Sphere

D1 = 0.02
TURNED = pin.exp3(np.array([0.0, np.pi / 2, 0.0]))
HULL = {"type": "box", "size": (0.08, 0.06, 0.1)}

CAPSULE = {"type": "capsule", "radius": 0.03, "length": 0.2}
OVERLAPS = {
    "sphere in sphere": ({"type": "sphere", "radius": 0.05}, Sphere(radius=0.06), [0.02, 0.01, 0.0]),
    "sphere centres coincide": ({"type": "sphere", "radius": 0.05}, Sphere(radius=0.06), [0.0, 0.0, 0.0]),
    "capsule axes cross": (CAPSULE, Capsule(radius=0.04, length=0.3), [0, 0, 0]),
    "capsule axes nearly cross": (CAPSULE, Capsule(radius=0.04, length=0.3), [0.0, 0.003, 0.01]),
    "sphere centre in box": ({"type": "sphere", "radius": 0.05}, Box(size=(0.2, 0.3, 0.1)), [0.01, 0.02, 0.01]),
    "capsule through box": (CAPSULE, Box(size=(0.2, 0.3, 0.1)), [0.02, 0, 0.01]),
    "box in box": (HULL, Box(size=(0.2, 0.3, 0.1)), [0.03, 0.02, 0.02]),
    "boxes at the same place": (HULL, Box(size=(0.2, 0.3, 0.1)), [0.0, 0.0, 0.0]),
}


def overlapping(tmp_path, name, **fields):
    shape, obstacle, place = OVERLAPS[name]
    robot = cartesian(tmp_path, shape=shape, speed=1.0, acceleration=4.0)
    rotation = TURNED if "capsule axes" in name else np.eye(3)
    return make_controller(robot, [Obstacle.at("it", obstacle, place, rotation)], **fields)


@pytest.mark.parametrize("name", OVERLAPS)
@pytest.mark.parametrize("recovery", [0.1, 0.3])
def test_recovery_is_bounded_and_lasting(tmp_path, name, recovery):
    """Also where witness points coincide: within the speed asked for, the joints' speeds and accelerations."""
    avoidance = Avoidance(d1=D1, d2=0.1, recovery_speed=recovery)
    controller = overlapping(tmp_path, name, frame="z", avoidance=avoidance)
    distances, vs = [], []
    start = controller.tick(np.zeros(3)).proximity.distance[0]
    controller.reset()
    slowest = min(recovery, 0.1)  # a tenth of what the joints can do
    ticks = round((D1 - start) / slowest / 0.01) + 250
    for tick in drive(controller, np.zeros(3), ticks, target=[0.0, 0.0, 0.0]):
        assert tick.solution.status is not Status.STOPPED
        distances.append(tick.proximity.distance[0] if len(tick.proximity.pair) else 0.1)
        vs.append(tick.solution.v)
    distances, vs = np.array(distances), np.array(vs)
    assert distances[0] < -0.02
    assert np.linalg.norm(vs, axis=1).max() < recovery + 0.05
    assert np.abs(vs).max() <= 1.0 and accelerations(vs, 0.01).max() <= 4.0 + 1e-6
    assert (np.diff(distances) > -1e-3).all()  # during recovery and after it
    assert distances[-1] > D1 - 1e-3
    restored = np.argmax(distances > D1 - 1e-3)
    assert restored < (D1 - start) / slowest / 0.01 + 200
    assert (distances[restored:] > D1 - 1e-3).all()


@pytest.mark.parametrize("target", [1.0, 0.3, 0.81])
@pytest.mark.parametrize("backend", ["qp", "qp:daqp", "qp:proxqp"])
@pytest.mark.parametrize("acceleration", [None, 4.0])
def test_recovery_of_a_sphere_in_a_wall_leads_back(tmp_path, target, backend, acceleration):
    """The case that drives others through: the wall's face at x = 0.85, the tool's radius 0.05, its centre at 0.805."""
    robot = cartesian(tmp_path, axes="x", acceleration=acceleration)
    wall = Obstacle.at("wall", Box(size=(0.3, 2.0, 2.0)), [1.0, 0.0, 0.0])
    controller = make_controller(robot, [wall], "x", backend)
    x = []
    for tick in drive(controller, np.array([0.805]), 400, target=[target, 0.0, 0.0]):
        assert tick.solution.v[0] <= 1e-9 or tick.proximity.distance[0] > D1 - 1e-9
        x.append(tick.state.q[0])
    assert max(x) <= 0.805 + 1e-12
    assert x[-1] == pytest.approx(min(target, 0.85 - 0.05 - D1), abs=2e-3)
    assert tick.solution.status is Status.SOLVED


def test_recovery_from_several_obstacles(tmp_path):
    """Between two balls that both overlap the tool, it leaves both, and sideways."""
    robot = cartesian(tmp_path)
    balls = [Obstacle.at(f"ball{i}", Sphere(radius=0.05), [x, 0.0, 0.001]) for i, x in enumerate((-0.06, 0.07))]
    controller = make_controller(robot, balls, "z")
    least = []
    for tick in drive(controller, np.zeros(3), 400, target=[0.0, 0.0, 0.0]):
        least.append(tick.proximity.distance.min())
    assert least[0] == pytest.approx(-0.04, abs=1e-4)
    assert least[-1] > D1 - 1e-3
    assert abs(tick.state.q[2]) > 0.05


def test_recovery_of_an_arm(panda):
    """The hand and fingers of the Panda 30 to 60 mm deep in a box; limits hold, and its own bodies stay apart."""
    box = Obstacle.at("box", Box(size=(0.2, 0.2, 0.2)), [0.35, 0.05, 0.5])
    controller = make_controller(panda, [box], "panda_hand_tcp")
    bounds, ruler, vs = panda.bounds(), Ruler(controller.scene), []
    for tick in drive(controller, panda.home, 500):
        assert tick.solution.status is not Status.STOPPED
        vs.append(tick.solution.v)
    assert ruler.distances(panda.home).min() < -0.03
    assert (np.abs(vs) <= bounds.velocity + 1e-9).all()
    assert ruler.distances(tick.state.q).min() > D1 - 1e-3
