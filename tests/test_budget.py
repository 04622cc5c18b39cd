"""A budget cuts relaxation, stop look-ahead and backup search; a clock of the test says when, none is read."""

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    Obstacle,
    ReasonKind,
    Sample,
    Severity,
    Status,
    build_scene,
    build_tasks,
    load_scenario,
)
from qpavoid.budget import Budget
from qpavoid.config import Sphere, Task

TCP, DT = "panda_hand_tcp", 0.01


class Clock:
    """Stands still, or is a second later at each reading."""

    def __init__(self):
        self.now, self.runs = 0.0, False

    def __call__(self):
        self.now += 1.0 if self.runs else 0.0
        return self.now


def make_controller(panda, obstacles, budget=None, **avoidance):
    tasks = build_tasks([Task(frame=TCP)], panda, panda.home)
    scene = build_scene(panda, obstacles)
    return Controller(scene, tasks, dt=DT, avoidance=Avoidance(d1=0.03, d2=0.1, **avoidance), budget=budget)


def loop(controller, robot, steps, clock, spent):
    """Ticks of a closed loop past a ball that comes at 0.5 m/s; the clock runs in the steps for which `spent`."""
    q = robot.home.copy()
    for k in range(steps):
        clock.runs = spent(k)
        ball = Sample.at([1.3 - 0.5 * DT * k, 0.0, 0.6], linear=[-0.5, 0.0, 0.0])
        tick = controller.tick(q, DT * k, {TCP: [0.45, 0.1, 0.5]}, {"ball": ball})
        q = pin.integrate(robot.model, q, DT * tick.solution.v)
        yield tick


def ball():
    return Obstacle.at("ball", Sphere(radius=0.08), [1.3, 0.0, 0.6])


def test_budget_that_is_not_spent_changes_nothing(panda):
    """Poses are evaluated in portions, of the same trajectories."""
    clock = Clock()
    runs = [
        [tick.solution.v for tick in loop(make_controller(panda, [ball()], budget), panda, 250, clock, lambda k: False)]
        for budget in (None, Budget(1.0, clock))
    ]
    np.testing.assert_array_equal(*runs)


def test_without_a_backup_trajectory_a_spent_budget_is_a_stop(panda):
    clock = Clock()
    controller = make_controller(panda, [ball()], Budget(0.5, clock), look_ahead=False)
    stopped = 0
    for tick in loop(controller, panda, 250, clock, lambda k: True):
        solution = tick.solution
        reasons = [r for r in solution.reasons if r.kind is ReasonKind.BUDGET_SPENT]
        stopped += bool(reasons)
        if reasons:
            assert solution.status is Status.STOPPED and reasons[0].severity is Severity.ALARM
            assert reasons[0].subject in (("backup search",), ("relaxation",))
    assert stopped > 0


def test_search_goes_on_in_later_steps(panda):
    """Some poses are evaluated in every step, however late it is: a backup trajectory is found all the same."""
    clock = Clock()
    controller = make_controller(panda, [ball()], Budget(0.5, clock), look_ahead=False)
    lengths = [len(tick.backup) for tick in loop(controller, panda, 250, clock, lambda k: True)]
    first = next(k for k, length in enumerate(lengths) if length)
    assert 0 < first < 200


def test_with_a_kept_backup_trajectory_the_robot_follows_it_or_its_task(panda):
    clock, was_kept = Clock(), False
    controller = make_controller(panda, [ball()], Budget(0.5, clock), look_ahead=False)
    for tick in loop(controller, panda, 250, clock, lambda k: k > 60):
        searches = [r for r in tick.solution.reasons if r.subject == ("backup search",)]
        assert not (was_kept and len(tick.backup) and searches)
        was_kept = len(tick.backup) > 0
        assert not np.isnan(tick.solution.v).any()
        assert (tick.problem.lower - 1e-9 <= tick.solution.v).all()
        assert (tick.solution.v <= tick.problem.upper + 1e-9).all()


def test_look_ahead_that_is_cut_brakes(panda):
    """The tool moves towards a ball at rest, near enough that distances ahead are computed."""
    clock, seen = Clock(), set()
    controller = make_controller(
        panda, [Obstacle.at("ball", Sphere(radius=0.05), [0.5, 0.0, 0.35])], Budget(0.5, clock)
    )
    q = panda.home.copy()
    for k in range(200):
        clock.runs = k % 10 == 9
        tick = controller.tick(q, DT * k, {TCP: [0.6, 0.0, 0.2]})
        for reason in tick.solution.reasons:
            if reason.kind is ReasonKind.BUDGET_SPENT:
                seen.add(reason.subject)
                assert clock.runs and tick.solution.status is Status.STOPPED
                np.testing.assert_array_equal(tick.solution.v, tick.problem.v_stop)
        q = pin.integrate(panda.model, q, DT * tick.solution.v)
    assert ("stop look-ahead",) in seen


def test_relaxation_that_is_cut_brakes(panda):
    """Two balls that overlap the hand from both sides: no velocity meets their rows."""
    clock = Clock()
    data = panda.model.createData()
    pin.framesForwardKinematics(panda.model, data, panda.home)
    x = data.oMf[panda.model.getFrameId(TCP)].translation
    side = np.array([0.0, 0.11, 0.0])
    balls = [Obstacle.at(f"ball {s:+}", Sphere(radius=0.08), x + side * s) for s in (-1, 1)]
    closing = {f"ball {s:+}": Sample.at(x + side * s, linear=[0.0, -0.4 * s, 0.0]) for s in (-1, 1)}
    for runs, status in ((False, Status.RELAXED), (True, Status.STOPPED)):
        controller = make_controller(panda, balls, Budget(0.5, clock), backup=False, look_ahead=False)
        clock.runs = runs
        solution = controller.step(panda.home, 0.0, obstacles=closing)
        assert solution.status is status
        assert (("relaxation",) in {r.subject for r in solution.reasons if r.kind is ReasonKind.BUDGET_SPENT}) == runs


@pytest.mark.parametrize("budget", [0.0, -1.0, np.nan])
def test_budget_of_no_time_is_refused(panda, budget):
    with pytest.raises(ConfigError, match=r"budget: .*seconds"):
        make_controller(panda, [], budget)


def test_scenarios_may_have_a_budget():
    for field, spends in (("1e-9", True), ("null", False)):
        controller, q = Controller.from_scenario(load_scenario("panda_ball", [f"budget={field}"]))
        kinds = set()
        for k in range(300):
            solution = controller.step(q, k * controller.dt)
            kinds |= {reason.kind for reason in solution.reasons}
            q = pin.integrate(controller.scene.robot.model, q, controller.dt * solution.v)
        assert (ReasonKind.BUDGET_SPENT in kinds) == spends
    with pytest.raises(ConfigError, match=r"budget: .*greater than 0"):
        load_scenario("panda_ball", ["budget=-1"])
