"""Every tick has a defined outcome: SOLVED, RELAXED or STOPPED, with a finite velocity within the hard limits."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian, make_controller

from qpavoid import Obstacle, ReasonKind, Sample, Status
from qpavoid.config import Box, Capsule, Sphere


def test_relaxed_step_names_the_limiting_joint(tmp_path):
    """A ball comes at 0.3 m/s, and the tool stands at the limit of the only joint that leads away from it."""
    robot = cartesian(tmp_path, axes="x", acceleration=None)
    controller = make_controller(robot, [Obstacle.at("ball", Sphere(radius=0.05), [0.0, 0, 0])], "x")
    coming = Sample.at([-4.87, 0.0, 0.0], linear=[-0.3, 0.0, 0.0])
    s = controller.step([-5.0], obstacles={"ball": coming})
    assert s.status is Status.RELAXED
    assert s.v[0] == pytest.approx(0.0, abs=1e-5)
    row, limit = s.reasons  # backup trajectories are still sought
    assert (row.kind, row.subject, row.unit) == (ReasonKind.ROW_RELAXED, ("tool", "ball"), "m/s")
    # 10 mm above d1: it may close at the near speed, of 20 mm/s
    assert row.amount == pytest.approx(0.3 - 0.02, abs=1e-5)
    assert (limit.kind, limit.subject, limit.unit) == (ReasonKind.AT_LOWER_LIMIT, ("joint_x",), "m/s")
    assert limit.amount == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("solver", "name"), [("qp", "panda"), ("qp", "paper"), ("qp", "solo"), ("qp:daqp", "panda")])
def test_step_from_any_state_ends_in_a_velocity(name, solver, request):
    """Deep penetration, limits violated, any velocity before, obstacles at any speed: 200 steps a robot."""
    robot = request.getfixturevalue(name)
    rng, bounds, nv = np.random.default_rng(3), robot.bounds(), robot.model.nv
    frame = {"panda": "panda_hand_tcp", "paper": "left_tool", "solo": "FL_FOOT"}[name]
    shapes = (
        Sphere(radius=0.2),
        Box(size=(0.4, 0.01, 0.6)),
        Capsule(radius=0.1, length=0.5),
        Box(size=(0.3, 0.3, 0.3)),
    )
    obstacles = [Obstacle.at(f"o{i}", shape, [0.0, 0.0, 9.0]) for i, shape in enumerate(shapes)]
    controller = make_controller(robot, obstacles, frame, solver)
    fastest = np.where(bounds.velocity < 100.0, bounds.velocity, 5.0)
    seen = dict.fromkeys(Status, 0)
    for k in range(200):
        if k % 4 == 0:
            q = pin.integrate(robot.model, robot.home, rng.uniform(-2.5, 2.5, nv))
            controller.reset(rng.uniform(-1.2, 1.2, nv) * fastest)
            places = {
                o.name: Sample.at(
                    rng.uniform(-0.5, 0.7, 3), linear=rng.uniform(-1, 1, 3), angular=rng.uniform(-3, 3, 3)
                )
                for o in obstacles
            }
            target = {frame: Sample.at(rng.uniform(-2.0, 2.0, 3), linear=rng.uniform(-5, 5, 3))}
        tick = controller.tick(q, 0.01 * k, target, places)
        s, x = tick.solution, tick.problem
        seen[s.status] += 1
        assert np.isfinite(s.v).all()
        assert (np.abs(s.v) <= bounds.velocity + 2e-6).all()
        assert (s.v >= x.hard_lower - 2e-6).all() and (s.v <= x.hard_upper + 2e-6).all()
        assert (s.status is Status.SOLVED) == (not s.reasons)
        assert all(reason.amount is None or np.isfinite(reason.amount) for reason in s.reasons)
        q = pin.integrate(robot.model, q, 0.01 * s.v)
    assert seen[Status.STOPPED] == 0
    # the quadruped's free base has no limits: it can always get out of the way
    assert seen[Status.RELAXED] >= {"panda": 25, "paper": 2, "solo": 0}[name] and seen[Status.SOLVED] > 5


@pytest.mark.parametrize("seed", range(3))
def test_stop_from_any_speed_brakes_all_joints_alike(panda, seed):
    """Within the accelerations, and with no distance closing faster on the way, as all rates shrink by one factor."""
    rng, bounds = np.random.default_rng(seed), panda.bounds()
    controller = make_controller(panda, [Obstacle.at("ball", Sphere(radius=0.1), [0.5, 0.2, 0.5])])
    step = 0.01 * bounds.acceleration
    v = rng.uniform(-1.0, 1.0, 7) * bounds.velocity
    q, ticks = panda.home.copy(), 0
    needed = int(np.ceil(np.max(np.abs(v) / step)))
    controller.reset(v)
    while v.any():
        tick = controller.tick(q, np.nan)
        following, rates = tick.solution.v, tick.proximity.J
        assert tick.solution.status is Status.STOPPED
        assert (np.abs(following - v) <= step + 1e-9).all()
        closing = np.maximum(-(rates @ v), 0.0)
        inside = ((q + 0.5 > bounds.lower) & (q - 0.5 < bounds.upper)).all()
        assert inside and (-(rates @ following) <= closing + 1e-9).all()
        v, q, ticks = following, q + 0.01 * following, ticks + 1
    assert ticks == needed
