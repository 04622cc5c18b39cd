"""Rows of balance: the capture point stays over what the robot stands on, in closed form and in a loop."""

from collections import namedtuple

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from qpavoid import load_scenario, simulate
from qpavoid.kernels.balance_rows import balance_rows, convex_hull

Step = namedtuple("Step", "v_prev")
Dynamics = namedtuple("Dynamics", "row_factor")
Standing = namedtuple("Standing", "center center_jacobian support_margin")


def test_hull_is_that_of_scipy():
    rng = np.random.default_rng(0)
    for k in range(60):
        points = rng.normal(size=(rng.integers(3, 17), 2))
        points = np.round(points, 1) if k % 3 == 0 else points
        corners = points[convex_hull(points)]
        (x, y), (x_next, y_next) = corners.T, np.roll(corners, -1, axis=0).T
        assert 0.5 * np.sum(x * y_next - y * x_next) == pytest.approx(ConvexHull(points).volume, abs=1e-12)


@pytest.mark.parametrize("factor", [1.0, 0.3])
def test_a_velocity_within_the_rows_keeps_the_capture_point_inside(factor):
    """On a square of 0.2 m, 1 m below: |c + ċ/ω| <= 0.1 - margin in both axes; at a finite rate, part of the way."""
    points = np.array([[0.1, 0.1, 0.0], [-0.1, -0.1, 0.0], [-0.1, 0.1, 0.0], [0.1, -0.1, 0.0], [0.0, 0.05, 0.0]])
    center, J, v = np.array([0.03, -0.02, 1.0]), np.eye(3), np.array([0.2, 0.0, 0.0])
    rows, rhs = balance_rows(points, Step(v), Dynamics(factor), Standing(center, J, 0.02))
    assert rows.shape == (4, 3) and not rows[:, 2].any()
    omega, rng, inside = np.sqrt(9.81), np.random.default_rng(1), 0
    for _ in range(500):
        wanted = rng.uniform(-0.6, 0.6, 3)
        velocity = v + factor * (wanted - v)  # one step towards it
        capture = center[:2] + wanted[:2] / omega
        assert (rows @ velocity >= rhs).all() == (np.abs(capture) <= 0.08).all()
        inside += (np.abs(capture) <= 0.08).all()
    assert inside > 20


@pytest.mark.slow
def test_a_reach_beyond_the_feet_ends_before_it_tips_the_robot_over():
    """A hand is drawn 0.75 m forward in MuJoCo, no task keeps the centre of mass: with rows, all steps are solved."""
    pytest.importorskip("mujoco")
    reach = "tasks.0.motion={type: line, end: [0.75, -0.2, 0.0], speed: 0.4, profile: smooth}"
    fields = ["obstacles=[]", reach, "tasks.2.weight=0.001"]
    log = simulate(load_scenario("g1_wave", [*fields, "duration=3", "dynamics.support_margin=0.01"]))
    figures = log.metrics()
    assert figures["status_counts"]["SOLVED"] == len(log.q)
    assert figures["torque"]["slip"] < 5e-3 and abs(log.q[-1, 2] - log.q[0, 2]) < 0.02
    without = simulate(load_scenario("g1_wave", [*fields, "duration=1.6"])).metrics()
    assert without["status_counts"]["STOPPED"] > 0  # it tips over its toes


def test_two_points_bear_no_balance():
    z = Standing(np.array([0.0, 0.0, 1.0]), np.eye(3), 0.0)
    rows, rhs = balance_rows(np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), Step(np.zeros(3)), Dynamics(1.0), z)
    assert len(rows) == len(rhs) == 0
