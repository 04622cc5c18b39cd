"""A stalled task is reported, with what is in the way."""

import numpy as np
import pytest
from closed_loop import cartesian, drive, make_controller

from qpavoid import Avoidance, Obstacle, ReasonKind, Sample, Severity
from qpavoid.config import Box, Capsule, Sphere
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
        assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.STALLED, ("tool", shape), "m/s")
        # v_tracking has the task's full speed; the row is zero at d1, where qp rests, and allows 50 mm/s farther out
        assert reason.amount == pytest.approx(0.3, abs=0.02) or (solver == "eq10" and 0.25 < reason.amount < 0.3)
        assert reason.severity is Severity.WARNING


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
    assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.AT_UPPER_LIMIT, ("joint_y",), "m/s")
    assert reason.amount == pytest.approx(0.0, abs=1e-3)  # at the limit


def test_stalled_ends_once_the_obstacle_has_left(tmp_path):
    def updates(t):
        return {"ball": Sample.at([0.3, 0.0, 0.0] if t < 5.0 else [0.3, 2.0, 0.0])}

    q, reported, _ = run_to(head_on(tmp_path), 1200, obstacles=updates)
    assert [(reason.kind, reason.subject) for reason in reported[499]] == [(ReasonKind.STALLED, ("tool", "ball"))]
    assert not any(reported[505:]) and np.linalg.norm(q[-1] - GOAL) < 1e-4


@pytest.mark.parametrize(("scenario", "longest"), [("situation1", 4.0), ("situation2", 0.0), ("panda_line", 0.0)])
def test_stalled_raises_no_false_alarm(scenario, longest):
    """Slowed down or pushed aside is not stalled; in Situation 1 the tool waits for its target to return."""
    metrics = simulate(scenario).metrics()
    assert metrics["time_blocked"] <= longest and metrics["arrived"]
