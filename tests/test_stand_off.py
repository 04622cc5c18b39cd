"""Where the everyday row ends: at d1, within seconds, whatever the robot, its limits and the period."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import Ruler, drive, make_controller

from qpavoid import Avoidance, Obstacle, Robot, Sample, Status
from qpavoid.config import Limits, Sphere
from qpavoid.model.kinematics import ForwardKinematics

D1 = 0.03
ROBOTS = {
    "panda": ("panda_hand_tcp", [1.0, 0.0, 0.0]),
    "ur5": ("tool0", [0.0, 1.0, 0.0]),
    "paper-dual-arm": ("left_tool", [1.0, 0.0, 0.0]),
}
"""Tool of each robot, and a way from it that is free."""


def ball_at(robot, frame, way, gap):
    """A ball along `way` from the tool whose distance to the nearest body is `gap` at home, and its centre."""
    kinematics = ForwardKinematics(robot.model, [robot.frame_id(frame, "test")])
    kinematics.compute(robot.home)
    tool = kinematics.frame_poses[robot.frame_id(frame, "test"), 9:].copy()
    ball = Obstacle.at("ball", Sphere(radius=0.06), tool)
    scene = make_controller(robot, [ball]).scene
    ruler, of_ball = Ruler(scene), np.array(["ball" in names for names in scene.pair_names])
    near, far = 0.0, 0.5
    for _ in range(40):
        middle = 0.5 * (near + far)
        d = ruler.distances(robot.home, {0: Sample.at(tool + middle * np.array(way))})[of_ball].min()
        near, far = (middle, far) if d < gap else (near, middle)
    place = tool + far * np.array(way)
    return Obstacle.at("ball", Sphere(radius=0.06), place), place


def press(name, start, seconds, dt=0.01, accelerations=True, limits=None, **row):
    """A tool at rest, `start` above d1, whose target is inside the ball: d - d1 [m], |dv| of each tick, statuses."""
    frame, way = ROBOTS[name]
    robot = Robot.load(name)
    if not accelerations:
        robot = replace(robot, acceleration={}, jerk={})
    ball, place = ball_at(robot, frame, way, D1 + start)
    avoidance = Avoidance(d1=D1, row={"type": "beta", **row})
    controller = make_controller(robot, [ball], frame, dt=dt, avoidance=avoidance, limits=limits)
    ticks = list(drive(controller, robot.home, round(seconds / dt) + 1, target=place))
    of_ball = [["ball" in controller.scene.pair_names[i] for i in tick.proximity.pair] for tick in ticks]
    least = [tick.proximity.distance[own].min(initial=0.1) - D1 for tick, own in zip(ticks, of_ball, strict=True)]
    changes = np.abs(np.diff([tick.solution.v for tick in ticks], axis=0)).sum(axis=1)
    return np.array(least), changes, {tick.solution.status for tick in ticks}


@pytest.mark.parametrize("dt", [0.01, 0.002])
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize(("start", "seconds"), [(0.010, 1.0), (0.060, 2.0)])
def test_what_presses_is_at_d1_within_seconds(name, dt, start, seconds):
    """From 10 mm off in one second, from nearly d2 in two; then it rests there."""
    d, changes, statuses = press(name, start, seconds + 0.5, dt)
    assert d[round(seconds / dt)] <= 5e-4 and d.min() >= -1e-4
    assert changes[-round(0.2 / dt) :].max() < 0.02
    assert statuses == {Status.SOLVED}


@pytest.mark.parametrize(
    ("accelerations", "limits"),
    [(False, None), (True, Limits(acceleration_scale=0.2)), (True, Limits(jerk=300.0))],
    ids=["free", "a fifth of the accelerations", "jerks"],
)
def test_row_keeps_what_limits_leave_it(accelerations, limits):
    """Braking within accelerations and jerks begins as before; the near speed asks for none that is not there."""
    d, changes, statuses = press("panda", 0.060, 2.5, accelerations=accelerations, limits=limits)
    assert d[200] <= 5e-4 and d.min() >= -1e-4
    assert changes[-20:].max() < 0.02
    assert statuses == {Status.SOLVED}


def test_without_a_near_speed_it_creeps():
    d, *_ = press("panda", 0.010, 1.0, near_speed=0.0)
    assert 6e-3 < d[100] < 9e-3
