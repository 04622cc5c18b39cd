"""Foresight: a way out is kept at hand where obstacles move, and taken where the task would give it away."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import SHIPPED, cartesian, make_controller

from qpavoid import Controller, Obstacle, Sample, ScenarioConfig, Status, kernels, load_scenario
from qpavoid.config import Avoidance, Escape, Line, Sphere
from qpavoid.errors import ConfigError
from qpavoid.escape import _farthest
from qpavoid.motion import build_motion

DT = 0.01
GAP = 0.5
"""Radius of the two balls that close in [m]."""


def jaws(stop=GAP, speed=0.3):
    """Two large balls that come from both sides until they touch, where the robot stands."""
    balls = []
    for name, side in (("left", 1.0), ("right", -1.0)):
        line = Line(start=(0.0, 1.3 * side, 0.0), end=(0.0, stop * side, 0.0), speed=speed)
        balls.append(Obstacle(name, Sphere(radius=GAP), build_motion(line, None, SHIPPED.parent), moves=True))
    return balls


def pincer(folder, escape, acceleration=None, given=False):
    """A ball on slides, told to stay where the jaws close in 2.7 s; distances at every tick, and the solutions."""
    robot = cartesian(folder, "xy", speed=0.25, acceleration=acceleration)
    avoidance = Avoidance(d1=0.02, d2=0.10, escape=escape)
    controller = make_controller(robot, jaws(), "y", avoidance=avoidance)
    q, gaps, solutions = robot.home.copy(), [], []
    for k in range(280):
        t = k * DT
        centers = [obstacle.motion.sample(t).position[:2] for obstacle in controller.scene.obstacles]
        gaps.append(min(np.linalg.norm(q - center) for center in centers) - GAP - 0.05)
        seen = {o.name: o.motion.sample(t) for o in controller.scene.obstacles} if given else None
        solutions.append(controller.step(q, t, {"y": Sample.at([0.0, 0.0, 0.0])}, seen))
        q = pin.integrate(robot.model, q, DT * solutions[-1].v)
    return np.array(gaps), solutions


def test_jaws_close_on_a_law_that_looks_one_tick_ahead(tmp_path):
    gaps, _ = pincer(tmp_path, None)
    assert gaps.min() < -0.01


@pytest.mark.parametrize(("acceleration", "given"), [(None, True), (2.0, False)])
def test_who_looks_farther_leaves_in_time_and_says_why(tmp_path, acceleration, given):
    gaps, solutions = pincer(tmp_path, Escape(), acceleration, given)
    assert gaps.min() > 0.5 * 0.3 * 0.02  # looked at every 40 ms
    fled = [s for s in solutions if any("no way out" in reason for reason in s.reasons)]
    assert len(fled) > 10 and all(s.status is Status.RELAXED for s in fled)
    # beside balls that touch, a ball of 5 cm is clear at √(0.55² - 0.5²) m from there, which takes 0.92 s
    latest = (1.3 - GAP) / 0.3 - np.sqrt(0.55**2 - GAP**2) / 0.25
    first = next(k for k, solution in enumerate(solutions) if solution is fled[0])
    assert latest - 0.5 < DT * first < latest + 0.05
    v = np.array([s.v for s in solutions])
    assert np.abs(v).max() <= 0.25 + 1e-9
    if acceleration:
        change = np.diff(v, axis=0, prepend=0.0) / DT
        assert np.abs(change).max() <= acceleration + 1e-6


def test_where_nothing_moves_it_changes_no_bit():
    base = load_scenario("ur5_pole", ["duration=3"])
    assert all(o.motion.type == "fixed" for o in base.obstacles)
    watchful = base.model_copy(update={"avoidance": base.avoidance.model_copy(update={"escape": Escape()})})
    (one, q), (two, _) = Controller.from_scenario(base), Controller.from_scenario(watchful.read_from(base.source))
    for k in range(300):
        v = one.step(q, k * base.dt).v
        assert np.array_equal(v, two.step(q, k * base.dt).v)
        q = pin.integrate(one.scene.robot.model, q, v * base.dt)


def test_commands_of_others_are_kept_out_of_traps_too(tmp_path):
    robot = cartesian(tmp_path, "xy", speed=0.25, acceleration=None)
    for escape, trapped in ((None, True), (Escape(), False)):
        controller = make_controller(robot, jaws(), avoidance=Avoidance(d1=0.02, d2=0.10, escape=escape))
        q, least = robot.home.copy(), np.inf
        for k in range(300):
            solution = controller.filter(q, np.zeros(2), k * DT)
            q = pin.integrate(robot.model, q, DT * solution.v)
            centers = [o.motion.sample((k + 1) * DT).position[:2] for o in controller.scene.obstacles]
            least = min(least, *(np.linalg.norm(q - center) - GAP - 0.05 for center in centers))
        assert (least < 0.0) == trapped


def test_the_farthest_velocity_is_that_of_a_linear_program():
    from scipy.optimize import linprog

    rng = np.random.default_rng(0)
    for _ in range(50):
        A, d = 0.2 * rng.normal(size=(6, 4)), rng.uniform(0.0, 0.1, 6)
        lower, upper = -np.ones(4), np.ones(4)
        v = _farthest(A, d, 10.0, np.zeros(4), lower, upper)
        best = linprog(
            [0, 0, 0, 0, -1], A_ub=np.column_stack((-A, np.ones(6))), b_ub=d, bounds=[(-1, 1)] * 4 + [(None, None)]
        )
        # the regularisation costs at most ε/2 ‖v‖² <= 2e-4 of ½ (10 - s)², whose slope is about 10
        assert v is not None and (A @ v + d).min() == pytest.approx(best.x[-1], abs=1e-4)


def test_both_solvers_of_flights_agree(monkeypatch):
    if not kernels.ACCELERATED:
        pytest.skip("there is only one without numba")
    rng = np.random.default_rng(1)
    for _ in range(20):
        arguments = (
            0.2 * rng.normal(size=(5, 3)),
            rng.uniform(0.0, 0.1, 5),
            0.1,
            rng.normal(size=3),
            -np.ones(3),
            np.ones(3),
        )
        fast = _farthest(*arguments)
        with monkeypatch.context() as patch:
            patch.setattr(kernels, "ACCELERATED", False)
            assert _farthest(*arguments) == pytest.approx(fast, abs=1e-6)


def test_contacts_and_flights_are_not_for_each_other():
    scenario = load_scenario("humanoid_reach", ["avoidance.escape={}"])
    with pytest.raises(ConfigError, match=r"humanoid_reach.*avoidance.escape: flights do not hold contacts"):
        Controller.from_scenario(scenario)


def test_limits_of_the_settings_are_told():
    fields = {"robot": "panda", "tasks": [{"frame": "panda_hand_tcp"}], "duration": 1.0}
    with pytest.raises(ValueError, match="horizon"):
        ScenarioConfig.model_validate({**fields, "avoidance": {"escape": {"horizon": 0.0}}})
    assert ScenarioConfig.model_validate(fields).avoidance.escape is None
