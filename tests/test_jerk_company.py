"""Jerk limits with moving obstacles, points, contacts, attached objects, moving bases, and strict priorities.

Always: a step that is SOLVED keeps acceleration and jerk limits, and one that does not names the joints beyond them.
"""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian, changed, drive, make_controller
from test_moving_obstacles import COURSES, SAFE, situation
from test_point_cloud import BALL, CLOUD, wall

from qpavoid import Controller, Limits, Obstacle, Points, ReasonKind, Sample, Status, Voxels
from qpavoid.config import Sphere


class Limited:
    """Checks control steps, one after the other, against the limits by their definition."""

    def __init__(self, controller):
        bounds, dt = controller.scene.robot.bounds().within(controller.limits), controller.dt
        self._steps, self._names = (
            (bounds.acceleration * dt, bounds.jerk * dt**2),
            controller.scene.robot.coordinate_names,
        )
        self._last, self.relaxed, self.passed, self.most = np.zeros((2, len(bounds.jerk))), [], 0, 0.0

    def check(self, solution):
        """Check the acceleration and jerk of a step; returns the solution."""
        change = solution.v - self._last[0]
        kinds = ReasonKind.ACCELERATION_RELAXED, ReasonKind.JERK_RELAXED
        named = [reason.subject[0] for reason in solution.reasons if reason.kind in kinds]
        for size, step in zip((change, change - self._last[1]), self._steps, strict=True):
            passing = np.flatnonzero(np.abs(size) > step + 3e-6)
            assert not len(passing) or solution.status is not Status.SOLVED
            assert {self._names[j] for j in passing} <= set(named), solution
            self.passed += len(passing)
        self.most = max(self.most, float(np.max(np.abs(change - self._last[1]) / self._steps[1])))
        self._last = np.array([solution.v, change])
        if solution.status is not Status.SOLVED:
            self.relaxed.append(solution)
        return solution


def run_checked(scenario, steps):
    """A scenario's first steps, checked: the check, least distance, joint velocities (N, nv), configuration after."""
    controller, q = Controller.from_scenario(scenario)
    limited, vs, least = Limited(controller), [], np.inf
    for k in range(steps):
        tick = controller.tick(q, k * controller.dt)
        least = min(least, tick.proximity.distance.min(initial=np.inf))
        vs.append(limited.check(tick.solution).v)
        q = pin.integrate(controller.scene.robot.model, q, vs[-1] * controller.dt)
    return limited, least, np.array(vs), q


# --- moving obstacles --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("course", "jerk"),
    [
        pytest.param(course, 50.0 * 4.0 ** (k % 2), marks=[] if k in (3, 6) else [pytest.mark.slow])
        for k, course in enumerate(COURSES)
    ],
)
def test_distance_to_an_approaching_sphere_is_kept_to_2_mm(course, jerk):
    """As without jerk limits: a margin may be relaxed for some steps, accelerations and jerks are not."""
    fields = situation(course).model_dump(mode="json")
    limited, least, vs, _ = run_checked(
        changed("situation1", **{**fields, "limits": {"acceleration": 5.0, "jerk": jerk}}), 1300
    )
    assert SAFE - 2e-3 < least < 0.03
    assert limited.most == pytest.approx(1.0, abs=1e-3) and not limited.passed
    assert len(limited.relaxed) < 100
    assert all(s.status is Status.RELAXED and any("fist" in r.subject for r in s.reasons) for s in limited.relaxed)
    assert np.abs(vs).max() > 0.1


@pytest.mark.parametrize("solver", ["qp", "hqp"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_limits_and_reports_with_balls_thrown_at_a_panda(panda, solver, seed):
    """Contact is often avoided only beyond the limits; the steps after that have to return into them."""
    rng, count = np.random.default_rng(100 + seed), 3
    balls = [Obstacle.at(f"ball{i}", Sphere(radius=0.08), [5.0, 0.0, i]) for i in range(count)]
    controller = make_controller(
        panda, balls, "panda_hand_tcp", solver, limits=Limits(jerk=100.0), task={"gain": 3.0, "max_speed": 0.6}
    )
    limited, q, place, velocity = Limited(controller), panda.home.copy(), np.full((count, 3), 9.0), np.zeros((count, 3))
    for k in range(250):
        if k % 100 == 0:
            goal = rng.uniform([0.25, -0.4, 0.2], [0.65, 0.4, 0.7])
        for i in np.flatnonzero(np.linalg.norm(place - [0.3, 0.0, 0.4], axis=1) > 1.6):
            direction = rng.normal(size=3)
            velocity[i] = rng.uniform(0.3, 0.9) * direction / np.linalg.norm(direction)
            place[i] = rng.uniform([0.1, -0.4, 0.2], [0.6, 0.4, 0.8]) - velocity[i] * (
                0.5 + 0.6 / np.linalg.norm(velocity[i])
            )
        seen = {f"ball{i}": Sample.at(place[i], linear=velocity[i]) for i in range(count)}
        s = limited.check(controller.step(q, 0.01 * k, {"panda_hand_tcp": Sample.at(goal)}, seen))
        q, place = q + 0.01 * s.v, place + 0.01 * velocity
        bounds = panda.bounds()
        assert (q >= bounds.lower - 1e-9).all() and (q <= bounds.upper + 1e-9).all()
        assert (np.abs(s.v) <= bounds.velocity + 1e-9).all()
    assert limited.relaxed


def test_steps_after_one_beyond_the_limits_report_their_excess(tmp_path):
    """A ball leaves the tool no time: it jumps away at its full speed, and returns into its limits later."""
    robot = cartesian(tmp_path, speed=1.0, acceleration=4.0)
    ball = Obstacle.at("ball", Sphere(radius=0.1), [9.0, 0.0, 0.0])
    controller = make_controller(robot, [ball], "z", limits=Limits(jerk=40.0))
    limited, q, far = Limited(controller), np.zeros(3), [9.0, 0.0, 0.0]
    for k in range(200):
        near = k == 0
        seen = {"ball": Sample.at([0.21 if near else 9.0, 0.0, 0.0], linear=[-6.0 if near else 0.0, 0.0, 0.0])}
        s = limited.check(controller.step(q, 0.01 * k, {"z": Sample.at(far if near else q)}, seen))
        q = q + 0.01 * s.v
    assert limited.passed >= 2 and len(limited.relaxed) >= 2
    assert ReasonKind.JERK_RELAXED in [reason.kind for reason in limited.relaxed[1].reasons]
    assert s.status is Status.SOLVED and np.abs(s.v).max() < 1e-9


# --- points ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.005, 0.02])
@pytest.mark.parametrize("speed", [2.0])
def test_wall_of_points_is_not_crossed(tmp_path, dt, speed):
    robot = cartesian(tmp_path, speed=speed, acceleration=8.0)
    controller = make_controller(
        robot, [Obstacle.at("camera", CLOUD, [0, 0, 0])], "z", dt=dt, task={"gain": 20.0}, limits=Limits(jerk=80.0)
    )
    points, limited, least = wall(), Limited(controller), []
    surface = Voxels.of(points, CLOUD.resolution).centers
    for tick in drive(controller, np.array([-0.5, 0.03, 0.0]), round(3.0 / dt), target=[2.0, 0.1, 0.05],
                      obstacles=lambda t: None if t else {"camera": Points(points, at_rest=True)}):  # fmt: skip
        limited.check(tick.solution)
        after = tick.state.q + dt * tick.solution.v
        least.append(np.linalg.norm(surface - after, axis=1).min() - 0.05 - BALL)
    assert min(least) > 0.02 - 1e-3 and least[-1] < 0.05
    assert not limited.relaxed and limited.most == pytest.approx(1.0, abs=1e-3)


# --- contacts, moving bases, attached objects -----------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["qp", pytest.param("hqp", marks=pytest.mark.slow)])
def test_limits_hold_for_a_humanoid_over_its_contacts(solver):
    """Its feet do not slide, and its joints keep their limits although contact Jacobians change in every step."""
    scenario = changed("humanoid_reach", solver=solver, limits={"acceleration": 2.0, "jerk": 20.0})
    limited, least, vs, q = run_checked(scenario, 220)
    assert least > 0.015 - 1e-3 and np.abs(vs).max() > 0.05
    controller, q0 = Controller.from_scenario(scenario)
    model, data = controller.scene.robot.model, controller.scene.robot.model.createData()
    feet = [model.getFrameId(f"{side}_ankle_roll_link") for side in ("left", "right")]
    places = []
    for at in (q0, q):
        pin.framesForwardKinematics(model, data, at)
        places.append([data.oMf[foot].translation.copy() for foot in feet])
    assert np.abs(np.diff(places, axis=0)).max() < 1e-3
    assert len(limited.relaxed) < (20 if solver == "hqp" else 1) and limited.most < 1.5


@pytest.mark.parametrize("solver", ["qp", pytest.param("hqp", marks=pytest.mark.slow)])
def test_limits_hold_with_an_attached_box_past_a_pole(solver):
    limits = {"acceleration": 5.0, "jerk": 100.0}
    limited, least, vs, _ = run_checked(changed("carried_box", solver=solver, limits=limits), 500)
    assert least > 0.02 - 1e-3 and np.abs(vs).max() > 0.1
    assert not limited.relaxed and limited.most == pytest.approx(1.0, abs=1e-3)
