"""Position, velocity, acceleration and distance as one viable set: 100,000 random ticks.

All limits hold in all of them. All but one in ten thousand are feasible: where two pairs that are tenths of a
millimetre too near ask for parting at once, while the robot still brakes, one of them has to wait for a tick.
"""

import numpy as np
import pytest
from closed_loop import Ruler, cartesian, make_controller

from qpavoid import Obstacle, ReasonKind, Sample, Severity, Status
from qpavoid.config import Box, Capsule, Sphere


def viable_ticks(robot, frame, seed, ticks, shapes, max_speed, dt=0.01):
    """From a random clear pose on after random targets, half of them inside obstacles, changed all the time."""
    rng, bounds = np.random.default_rng(seed), robot.bounds()
    wide = bounds.upper - bounds.lower
    clear = False
    while not clear:
        obstacles = [Obstacle.at(f"o{i}", shape, rng.uniform(-0.8, 0.8, 3)) for i, shape in enumerate(shapes)]
        controller = make_controller(robot, obstacles, frame, dt=dt, task={"gain": 5.0, "max_speed": max_speed})
        ruler = Ruler(controller.scene)
        for _ in range(30):
            q = bounds.lower + rng.uniform(0.05, 0.95, len(wide)) * wide
            clear = ruler.distances(q).min() > 0.021
            if clear:
                break
    step, last, least = dt * bounds.acceleration + 1e-9, np.zeros(robot.model.nv), np.inf
    waiting = 0
    for k in range(ticks):
        if k % 40 == 0:
            inside = obstacles[rng.integers(len(obstacles))].motion.sample(0.0).position
            target = {frame: Sample.at(rng.uniform(-0.9, 0.9, 3) if rng.random() < 0.5 else inside)}
        s = controller.step(q, k * dt, target)
        if s.status is not Status.SOLVED:
            waiting += 1
            short = [reason.amount for reason in s.reasons if reason.kind is ReasonKind.BELOW_SAFETY_DISTANCE]
            rows = [reason for reason in s.reasons if reason.kind is ReasonKind.ROW_RELAXED]
            assert len(short) == len(rows) and len(short) + len(rows) == len(s.reasons), (k, s.reasons)
            assert max(short) <= 4.5e-4 and s.severity is Severity.WARNING, (k, s.reasons)
        assert (np.abs(s.v - last) <= step).all() and (np.abs(s.v) <= bounds.velocity + 1e-9).all()
        last, q = s.v, q + dt * s.v
        assert (q <= bounds.upper + 1e-9).all() and (q >= bounds.lower - 1e-9).all()
        if k % 20 == 0:
            least = min(least, ruler.distances(q).min())
    assert least > 0.019
    assert waiting <= 1


CLUTTER = (Box(size=(0.3, 0.3, 0.3)), Sphere(radius=0.1), Capsule(radius=0.05, length=0.4), Box(size=(0.004, 0.5, 0.5)))


@pytest.mark.parametrize(
    ("seed", "ticks"), [(0, 1000), (1, 1000), *(pytest.param(i, 3000, marks=pytest.mark.slow) for i in range(10))]
)
def test_random_states_of_the_panda_stay_feasible(panda, seed, ticks):
    """Among four obstacles at up to the joints' full speeds; 30,000 steps in the campaign."""
    viable_ticks(panda, "panda_hand_tcp", seed, ticks, CLUTTER, 1.0 if seed % 2 else 5.0)


@pytest.mark.parametrize(
    ("seed", "ticks"), [(0, 3000), *(pytest.param(i, 10_000, marks=pytest.mark.slow) for i in range(7))]
)
def test_random_states_of_a_cartesian_robot_stay_feasible(tmp_path, seed, ticks):
    """Its joint limits form a box that cuts through the obstacles; 70,000 steps in the campaign."""
    robot = cartesian(tmp_path, speed=2.0, acceleration=3.0, reach=0.7)
    viable_ticks(robot, "z", seed, ticks, CLUTTER, 2.0)
