"""Being stuck is said, with what is in the way, and a bounded way round is tried where it is asked for."""

import numpy as np
import pytest
from closed_loop import cartesian, drive, make_controller

from qpavoid import Avoidance, Obstacle, ReasonKind, Sample, Severity
from qpavoid.config import Box, Capsule, Detour, Progress, Sphere
from qpavoid.run.simulate import simulate

D1, GOAL = 0.03, np.array([0.6, 0.0, 0.0])
SHAPES = {
    "ball": Sphere(radius=0.1),
    "box": Box(size=(0.15, 0.3, 0.3)),
    "upright capsule": Capsule(radius=0.08, length=0.4),
}


def head_on(tmp_path, solver="qp", shape="ball", acceleration=None, detour=None, **fields):
    """A tool whose J Jᵀ is the identity, so that any normal is an eigenvector, and an obstacle exactly in its way."""
    robot = cartesian(tmp_path, acceleration=acceleration, reach=fields.pop("reach", 5.0))
    return make_controller(
        robot, [Obstacle.at(shape, SHAPES[shape], [0.3, 0.0, 0.0])], "z", solver,
        avoidance=Avoidance(d1=D1, d2=0.12), progress=Progress(detour=detour), task={"max_speed": 0.3}, **fields,
    )  # fmt: skip


def watched(controller, ticks, target=GOAL, obstacles=None):
    """Where each tick finds the tool, what it says is in the way, and its distance."""
    q, said, least = [], [], np.inf
    for tick in drive(controller, np.zeros(3), ticks, target=target, obstacles=obstacles):
        q.append(tick.state.q)
        said.append(tick.solution.stalled)
        least = min(least, tick.proximity.distance.min(initial=np.inf))
    return np.array(q), said, least


@pytest.mark.parametrize("solver", ["eq10", "qp"])
@pytest.mark.parametrize("shape", SHAPES)
def test_exactly_head_on_it_stalls_for_good_and_names_the_culprit(tmp_path, solver, shape):
    q, said, _ = watched(head_on(tmp_path, solver, shape), 1500)
    assert np.linalg.norm(q[-1] - GOAL) > 0.11 and np.abs(q[-1] - q[-300]).max() < 2e-3
    first = next(k for k, reasons in enumerate(said) if reasons)
    assert 100 <= first < 400  # a second without progress
    for (reason,) in said[first:]:
        assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.STALLED, ("tool", shape), "m/s")
        # v0 goes at the task's full speed; the row is zero at d1, where qp rests, and lets 50 mm/s pass farther out
        assert reason.amount == pytest.approx(0.3, abs=5e-3) or (solver == "eq10" and 0.25 < reason.amount < 0.3)
        assert reason.severity is Severity.WARNING


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("acceleration", [None, 4.0])
def test_the_detour_gets_past_and_keeps_its_distance(tmp_path, shape, acceleration):
    controller = head_on(tmp_path, "qp", shape, acceleration, Detour())
    q, said, least = watched(controller, 1200)
    assert np.linalg.norm(q[-1] - GOAL) < 1e-3
    arrived = np.argmax(np.linalg.norm(q - GOAL, axis=1) < 5e-3)
    assert arrived < 1000  # ten seconds, where there is no end without it
    assert least > D1 - 5e-4
    assert said[-1] == () and any(said)
    off = np.linalg.norm(q[:, 1:], axis=1).max()
    assert 0.05 < off < 0.4  # it went round, and no farther than it had to


@pytest.mark.parametrize("course", [(1, 1, 0), (0, 0, 1), (1, 2, 3)])
def test_the_detour_in_any_direction(tmp_path, course):
    way = 0.6 * np.array(course) / np.linalg.norm(course)
    robot = cartesian(tmp_path)
    controller = make_controller(
        robot, [Obstacle.at("ball", Sphere(radius=0.1), 0.5 * way)], "z",
        avoidance=Avoidance(d1=D1, d2=0.12), progress=Progress(detour=Detour()), task={"max_speed": 0.3},
    )  # fmt: skip
    q, _, least = watched(controller, 1200, way)
    assert np.linalg.norm(q[-1] - way) < 1e-3 and least > D1 - 5e-4


def test_a_panda_that_cannot_come_nearer_says_what_keeps_it(panda):
    """The target is the centre of a ball; the fingers come as near as they may."""
    ball = Obstacle.at("ball", Sphere(radius=0.08), [0.5, 0.1, 0.4])
    controller = make_controller(panda, [ball], "panda_hand_tcp", task={"max_speed": 0.3})
    ticks = list(drive(controller, panda.home, 900, target=[0.5, 0.1, 0.4]))
    culprits = [reason for reason in ticks[-1].solution.stalled if reason.kind is ReasonKind.STALLED]
    bodies = set(controller.scene.body_names)
    assert culprits and all(reason.subject[0] in bodies and reason.subject[1] == "ball" for reason in culprits)
    assert ticks[-1].proximity.distance.min() > 0.019


def test_a_joint_limit_in_the_way_is_named(tmp_path):
    controller = head_on(tmp_path, reach=0.2)
    q, said, _ = watched(controller, 600, np.array([0.0, 0.5, 0.0]))
    assert q[-1][1] == pytest.approx(0.2, abs=1e-3)
    (reason,) = said[-1]
    assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.AT_UPPER_LIMIT, ("joint_y",), "m/s")
    assert reason.amount == pytest.approx(0.0, abs=1e-3)  # what is left of its way


def test_it_is_no_longer_said_once_the_obstacle_has_left(tmp_path):
    def gone(t):
        return {"ball": Sample.at([0.3, 0.0, 0.0] if t < 5.0 else [0.3, 2.0, 0.0])}

    q, said, _ = watched(head_on(tmp_path), 1200, obstacles=gone)
    assert [(reason.kind, reason.subject) for reason in said[499]] == [(ReasonKind.STALLED, ("tool", "ball"))]
    assert not any(said[505:]) and np.linalg.norm(q[-1] - GOAL) < 1e-4


@pytest.mark.parametrize(("scenario", "longest"), [("situation1", 2.0), ("situation2", 0.0), ("panda_line", 0.0)])
def test_no_false_alarm(scenario, longest):
    """Slowed down or pushed aside is not blocked; in Situation 1 the tool waits for its target to come round."""
    metrics = simulate(scenario).metrics()
    assert metrics["time_blocked"] <= longest and metrics["arrived"]


def test_a_detour_changes_nothing_where_nothing_blocks(tmp_path):
    loops = []
    for detour in (None, Detour()):
        controller = head_on(tmp_path, detour=detour)
        loops.append(watched(controller, 400, np.array([0.6, 0.3, 0.1]))[0])
    np.testing.assert_array_equal(*loops)
