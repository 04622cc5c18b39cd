"""Commanded velocities keep acceleration limits while pairs and witness points change."""

from functools import cache
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import accelerations, cartesian, changed, drive, make_controller

from qpavoid import Avoidance, Obstacle, Robot, Sample
from qpavoid.config import Beta, Box, Capsule, Sphere
from qpavoid.run.simulate import simulate

ROWS = {
    "beta": Avoidance(d1=0.02, d2=0.1),
    "damper": Avoidance(d1=0.02, d2=0.1, row=Beta(gain=5.0, near_speed=10.0)),
}


@cache
def run(name, solver, acceleration=None):
    limits = {"saturate": solver == "qp", "acceleration": acceleration}
    return simulate(changed(name, limits=limits) if acceleration else name, solver)


@pytest.mark.parametrize("acceleration", [2.0, 10.0])
@pytest.mark.parametrize("name", ["situation1", "situation2"])
def test_qp_keeps_accelerations_in_the_papers_situations(name, acceleration):
    """The paper's robot has no limits of its own; with one, every step keeps it, and the distance too."""
    log = run(name, "qp", acceleration)
    assert accelerations(log.v, 0.01).max() <= acceleration + 1e-6
    assert log.metrics()["status_counts"]["RELAXED"] == log.metrics()["status_counts"]["STOPPED"] == 0
    assert log.metrics()["min_distance"] > 0.02 - 5e-4


def witnesses(ticks):
    """Largest jump of the witness point on the tool from one step to the next [m]."""
    points = [tick.proximity.point_a[0] for tick in ticks if len(tick.proximity.pair)]
    return max(np.linalg.norm(b - a) for a, b in pairwise(points))


def rocking(shape):
    """An obstacle that rocks by 0.02 rad under the tool, so that the witness point jumps from end to end."""

    def at(t):
        turn = np.array([0.0, 1.0, 0.0])
        return {
            "it": Sample.at(
                [0.0, 0.0, -0.15], pin.exp3(0.02 * np.sin(6.0 * t) * turn), None, 0.12 * np.cos(6.0 * t) * turn
            )
        }

    return Obstacle.at("it", shape, [0.0, 0.0, -0.15]), at


TOOLS = {
    "capsule parallel to a face": ({"type": "capsule", "radius": 0.02, "length": 0.3}, 0.25),
    "box face on box face": ({"type": "box", "size": (0.2, 0.2, 0.05)}, 0.15),
}


@pytest.mark.parametrize("row", ROWS)
@pytest.mark.parametrize("case", TOOLS)
def test_accelerations_are_kept_when_witness_points_jump(tmp_path, case, row):
    """A tool pressed down on a slab that rocks: the nearest point jumps from one end of it to the other."""
    shape, jump = TOOLS[case]
    cartesian(tmp_path)
    body = {"name": "tool", "frame": "z", "shape": shape, "rpy": (0.0, np.pi / 2 if "capsule" in case else 0.0, 0.0)}
    limits = {"acceleration": {f"joint_{axis}": 4.0 for axis in "xyz"}}
    robot = Robot.from_urdf(tmp_path / "cartesian.urdf", bodies=[body], limits=limits)
    slab, at = rocking(Box(size=(1.0, 1.0, 0.1)))
    controller = make_controller(robot, [slab], "z", avoidance=ROWS[row])
    ticks = list(drive(controller, np.array([0.0, 0.0, 0.05]), 350, target=[0.0, 0.0, -0.1], obstacles=at))
    assert accelerations([tick.solution.v for tick in ticks], 0.01).max() <= 4.0 + 1e-6
    assert min(tick.proximity.distance.min(initial=np.inf) for tick in ticks) > 0.02 - 1e-3
    assert witnesses(ticks) > jump


@pytest.mark.parametrize("row", ROWS)
def test_accelerations_are_kept_when_the_nearest_pair_changes(tmp_path, row):
    """A tool pressed down while it slides over a ball and a capsule: pairs enter, become the nearest, and leave."""
    robot = cartesian(tmp_path, acceleration=4.0)
    over = [
        ("one", Sphere(radius=0.1), [0.15, 0.0, -0.16]),
        ("two", Capsule(radius=0.1, length=0.2), [0.4, 0.02, -0.16]),
    ]
    controller = make_controller(robot, [Obstacle.at(*o) for o in over], "z", avoidance=ROWS[row])
    ticks = list(
        drive(controller, np.array([-0.3, 0.0, 0.0]), 800, target=lambda t: [-0.3 + 0.15 * t, 0.0, -0.05 * min(t, 3)])
    )
    assert accelerations([tick.solution.v for tick in ticks], 0.01).max() <= 4.0 + 1e-6
    assert min(tick.proximity.distance.min(initial=np.inf) for tick in ticks) > 0.02 - 5e-4
    assert {len(tick.proximity.pair) for tick in ticks} == {0, 1, 2}
    nearest = [tick.proximity.pair[np.argmin(tick.proximity.distance)] for tick in ticks if len(tick.proximity.pair)]
    assert set(nearest) == {0, 1}


@pytest.mark.parametrize("seed", range(1))
def test_accelerations_are_kept_with_flickering_obstacles(panda, seed):
    """Detected and lost at random, at the edge of the influence distance."""
    rng, bounds = np.random.default_rng(seed), panda.bounds()
    controller = make_controller(
        panda, [Obstacle.at(f"ball{i}", Sphere(radius=0.05), [9.0, 0, i]) for i in range(3)], "panda_hand_tcp"
    )
    places = {f"ball{i}": p for i, p in enumerate(([0.50, 0.1, 0.62], [0.42, -0.17, 0.5], [0.3, 0.1, 0.86]))}
    last, near = np.zeros(7), set()
    for k, tick in enumerate(drive(controller, panda.home, 400, target=lambda t: [0.35, 0.03 * np.sin(3 * t), 0.5],
        obstacles=lambda t: {n: Sample.at(p if rng.random() < 0.5 else [9.0, 0, 0]) for n, p in places.items()},
    )):  # fmt: skip
        v = tick.solution.v
        assert (np.abs(v - last) <= 0.01 * bounds.acceleration + 1e-6).all(), k
        last = v
        near.add(len(tick.proximity.pair))
    assert len(near) > 4
