"""A stalled task is reported, with what is in the way."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian, drive, make_controller, planar
from conftest import frames

from qpavoid import Avoidance, Controller, Obstacle, ReasonKind, Robot, Sample, Severity, build_scene, build_tasks
from qpavoid.config import Box, Capsule, ManipulabilityTask, PostureTask, Sphere, Task
from qpavoid.run.simulate import simulate

D1, GOAL = 0.03, np.array([0.6, 0.0, 0.0])
SHAPES = {
    "ball": Sphere(radius=0.1),
    "box": Box(size=(0.15, 0.3, 0.3)),
    "upright capsule": Capsule(radius=0.08, length=0.4),
}


def head_on(tmp_path, solver="qp", shape="ball", acceleration=None, **fields):
    """A tool whose J Jᵀ is the identity, so that any normal is an eigenvector, and an obstacle exactly in its way."""
    robot = cartesian(tmp_path, acceleration=acceleration, reach=fields.pop("reach", 5.0))
    return make_controller(
        robot, [Obstacle.at(shape, SHAPES[shape], [0.3, 0.0, 0.0])], "z", solver,
        avoidance=Avoidance(d1=D1, d2=0.12), task={"max_speed": 0.3}, **fields,
    )  # fmt: skip


def run_to(controller, steps, target=GOAL, obstacles=None):
    """Positions of the tool, what each step reports in the way, and the least distance."""
    q, reported, least = [], [], np.inf
    for tick in drive(controller, np.zeros(3), steps, target=target, obstacles=obstacles):
        q.append(tick.state.q)
        reported.append(tick.solution.stalled)
        least = min(least, tick.proximity.distance.min(initial=np.inf))
    return np.array(q), reported, least


@pytest.mark.parametrize("solver", ["eq10", "qp"])
@pytest.mark.parametrize("shape", SHAPES)
def test_stalled_names_the_obstacle_exactly_head_on(tmp_path, solver, shape):
    q, reported, _ = run_to(head_on(tmp_path, solver, shape), 1500)
    assert np.linalg.norm(q[-1] - GOAL) > 0.11 and np.abs(q[-1] - q[-300]).max() < 2e-3
    first = next(k for k, reasons in enumerate(reported) if reasons)
    assert 50 <= first < 350  # half a second without progress
    for (reason,) in reported[first:]:
        assert (reason.kind, reason.subject) == (ReasonKind.STALLED, ("tool", shape))
        assert reason.severity is Severity.WARNING
        if solver == "qp":  # nothing else holds it; eq10 has no rows whose forces could be compared
            assert reason.unit == "%" and reason.amount == pytest.approx(100.0)


def test_stalled_names_panda_bodies_and_obstacle(panda):
    """The target is the centre of a ball; the fingers come as near as they may."""
    ball = Obstacle.at("ball", Sphere(radius=0.08), [0.5, 0.1, 0.4])
    controller = make_controller(panda, [ball], "panda_hand_tcp", task={"max_speed": 0.3})
    ticks = list(drive(controller, panda.home, 900, target=[0.5, 0.1, 0.4]))
    blocking = [reason for reason in ticks[-1].solution.stalled if reason.kind is ReasonKind.STALLED]
    bodies = set(controller.scene.body_names)
    assert blocking and all(reason.subject[0] in bodies and reason.subject[1] == "ball" for reason in blocking)
    assert ticks[-1].proximity.distance.min() > 0.019


def test_stalled_names_a_joint_limit(tmp_path):
    controller = head_on(tmp_path, reach=0.2)
    q, reported, _ = run_to(controller, 600, np.array([0.0, 0.5, 0.0]))
    assert q[-1][1] == pytest.approx(0.2, abs=1e-3)
    (reason,) = reported[-1]
    assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.AT_UPPER_LIMIT, ("joint_y",), "%")
    assert reason.amount == pytest.approx(100.0)


def test_stalled_ends_once_the_obstacle_has_left(tmp_path):
    def updates(t):
        return {"ball": Sample.at([0.3, 0.0, 0.0] if t < 5.0 else [0.3, 2.0, 0.0])}

    q, reported, _ = run_to(head_on(tmp_path), 1200, obstacles=updates)
    assert [(reason.kind, reason.subject) for reason in reported[499]] == [(ReasonKind.STALLED, ("tool", "ball"))]
    assert not any(reported[520:]) and np.linalg.norm(q[-1] - GOAL) < 1e-4


@pytest.mark.parametrize(("scenario", "longest"), [("situation1", 2.5), ("situation2", 0.0), ("panda_line", 0.0)])
def test_stalled_raises_no_false_alarm(scenario, longest):
    """Slowed down or pushed aside is not stalled; in Situation 1 the tool waits 2.4 s for its target to return: errors
    show that from half a second on, where the velocity that was left showed it later.
    """
    metrics = simulate(scenario).metrics()
    assert metrics["time_blocked"] <= longest and metrics["arrived"]


# --- out of reach, singular ---------------------------------------------------------------------------------------


def rest_time(ticks, dt=0.01, speed=5e-3):
    """Time from which on no joint is faster than so much [s]."""
    moving = [k for k, tick in enumerate(ticks) if np.abs(tick.solution.v).max() > speed]
    return dt * (moving[-1] + 1 if moving else 0)


def test_target_beyond_reach_is_named_within_a_second_and_no_longer_once_it_comes_back(tmp_path):
    """Named with what is missing, after the arm has come to rest; a target within reach ends it at once."""
    robot, last = planar(tmp_path), np.array([0.5, 0.6, 0.0])

    def target(t):
        return last if t >= 6.0 else 1.4 * np.array([0.6, 0.8, 0.0])

    ticks = list(drive(make_controller(robot, frame="tip"), robot.home, 900, target=target))
    first = next(k for k, tick in enumerate(ticks) if tick.solution.stalled)
    assert 0.01 * first <= rest_time(ticks[:600]) + 1.0
    for tick in ticks[first:600]:
        (reason,) = tick.solution.stalled
        assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.OUT_OF_REACH, ("tip",), "m")
    assert reason.amount == pytest.approx(0.3, abs=5e-3) and "out of reach by 300" in str(reason)
    assert not any(tick.solution.stalled for tick in ticks[620:])
    (end,) = frames(robot, ["tip"], ticks[-1].state.q)
    assert np.linalg.norm(end.translation - last) < 2e-3


def test_straight_arm_that_has_to_bend_is_singular(tmp_path):
    """Exactly along the arm, no joint brings the tool nearer at first order: it rests there, and says so."""
    robot = planar(tmp_path, home=(0.0, 0.0, 0.0))
    ticks = list(drive(make_controller(robot, frame="tip"), robot.home, 120, target=[0.6, 0.0, 0.0]))
    assert np.abs([tick.solution.v for tick in ticks]).max() < 1e-6
    (reason,) = ticks[100].solution.stalled
    assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.SINGULAR, ("tip",), "m")
    assert reason.amount == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize(
    "side",
    [
        PostureTask(q={"panda_joint1": 1.0, "panda_joint4": -1.0}, weight=1e-6),
        ManipulabilityTask(frame="panda_hand_tcp", rows="pose", weight=1e-3),
    ],
    ids=["posture", "manipulability"],
)
def test_side_task_without_a_goal_is_not_stalled(panda, side):
    """The hand stays where it is; a posture or manipulability that it leaves no way to is no reason to complain."""
    tasks = build_tasks([Task(frame="panda_hand_tcp", type="pose"), side], panda, panda.home)
    ticks = list(drive(Controller(build_scene(panda), tasks), panda.home, 400))
    assert np.abs(ticks[-1].solution.v).max() < 0.05
    assert not any(tick.solution.stalled for tick in ticks)


def test_moving_target_is_followed_without_alarm(panda):
    """A lag is no stall: the target goes round at 0.2 m/s without a twist given."""
    (pose,) = frames(panda, ["panda_hand_tcp"], panda.home)

    def target(t):
        return pose.translation + 0.1 * np.array([0.0, np.sin(2.0 * t), np.cos(2.0 * t) - 1.0])

    ticks = list(drive(make_controller(panda, frame="panda_hand_tcp"), panda.home, 500, target=target))
    assert not any(tick.solution.stalled for tick in ticks)


@pytest.mark.parametrize("name", ["panda", "ur5", "baxter"])
def test_whatever_holds_a_task_is_named_in_time(name):
    """Random targets beyond reach or in a box: from 1 s after the error is within 2 mm of its last value on, there are
    reasons, shares of pairs and limits among 0 to 100 %; 0.2 s after the target has come back, there are none.
    """
    robot, rng, named = Robot.load(name), np.random.default_rng(8), 0
    frame = robot.end_effectors[0]
    (start,) = frames(robot, [frame], robot.home)
    for number in range(4):
        direction = rng.normal(size=3) * [1.0, 1.0, 0.3]
        direction /= np.linalg.norm(direction)
        box = Obstacle.at("box", Box(size=(0.2, 0.2, 0.2)), start.translation + 0.3 * direction)
        goal, obstacles = [(1.3, []), (0.3, [box])][number % 2]
        targets = start.translation + goal * direction, start.translation
        controller, q, e, said = make_controller(robot, obstacles, frame), robot.home, [], []
        for k in range(630):
            target = targets[k >= 600]
            solution = controller.step(q, targets={frame: Sample.at(target)})
            (pose,) = frames(robot, [frame], q)
            e.append(np.linalg.norm(pose.translation - target))
            said.append(solution.stalled)
            q = pin.integrate(robot.model, q, 0.01 * solution.v)
        moving = np.flatnonzero(np.abs(np.array(e[:600]) - e[599]) > 2e-3)
        at_rest = moving[-1] + 1 if len(moving) else 0
        assert not any(said[620:])
        if e[599] < 2e-3:  # on the other side of the base, and in reach
            assert not any(said)
            continue
        assert all(said[at_rest + 100 : 600])
        for reasons in said[at_rest + 100 : 600]:
            shares = [reason.amount for reason in reasons if reason.unit == "%"]
            assert all(0.0 < share <= 100.0 + 1e-9 for share in shares) and sum(shares) <= 100.0 + 1e-9
            assert shares or reasons[0].kind in (ReasonKind.OUT_OF_REACH, ReasonKind.SINGULAR)
            named += 1
    assert named > 300


def play_goal(panda, number, rng):
    """Errors and reasons of 8 s towards a random goal: within reach, beyond it, or behind a ball."""
    tool, bounds = "panda_hand_tcp", panda.bounds()
    kind, task = ("within", "beyond", "behind")[number % 3], "position" if number % 2 else "pose"
    (start,) = frames(panda, [tool], panda.home)
    while True:
        (goal,) = frames(panda, [tool], rng.uniform(bounds.lower, bounds.upper))
        if goal.translation[2] > 0.1 and np.linalg.norm(goal.translation[:2]) > 0.25:
            break
    place, obstacles = goal.translation.copy(), []
    if kind == "beyond":
        direction = np.abs(rng.normal(size=3)) * [rng.choice([-1.0, 1.0]), rng.choice([-1.0, 1.0]), 1.0]
        reach = 0.87 + rng.choice([0.02, 0.1, 0.4])
        place = np.array([0.0, 0.0, 0.333]) + reach * direction / np.linalg.norm(direction)
    if kind == "behind":
        ball = start.translation + 0.6 * (place - start.translation) if rng.random() < 0.5 else place + 0.02
        if np.linalg.norm(ball - start.translation) > 0.2:
            obstacles = [Obstacle.at("ball", Sphere(radius=0.07), ball)]
    tasks = build_tasks([Task(frame=tool, type=task)], panda, panda.home)
    controller, q = Controller(build_scene(panda, obstacles), tasks, dt=0.02), panda.home
    errors, said, target = [], [], {tool: Sample.at(place, goal.rotation)}
    for k in range(400):
        tick = controller.tick(q, 0.02 * k, target)
        errors.append(np.linalg.norm(tick.problem.tracking.b) / 2.0)
        said.append(tick.solution.stalled)
        q = pin.integrate(panda.model, q, 0.02 * tick.solution.v)
    return np.array(errors), said


@pytest.mark.parametrize("count", [24, pytest.param(201, marks=pytest.mark.slow)])
def test_goals_that_are_not_reached_are_named(panda, count):
    """Random goals of a Panda: at most 3 % of those where the arm rests short of them go without a reason; of those
    that it reaches, one in a hundred has one on the way, while it creeps along a limit by 1 % in half a second.
    """
    rng, short, missed, false = np.random.default_rng(5), 0, 0, 0
    for number in range(count):
        e, said = play_goal(panda, number, rng)
        if e[-1] < 2.5e-3:
            false += any(reasons and error > 5e-3 for reasons, error in zip(said, e, strict=True))
        elif abs(e[-40] - e[-1]) < max(0.5e-3, 0.01 * e[-1]):
            short += 1
            missed += not said[-1]
    assert short > count / 4 and missed <= 0.03 * short and false <= max(1, 0.01 * count)
