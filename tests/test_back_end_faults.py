"""Fault injection: a QP back end or a user's own law that fails, lies or dawdles leaves a defined tick behind."""

import time

import numpy as np
import pytest
from test_faults import NAN, panda_controller, up

from qpavoid import Reason, ReasonKind, Sample, Severity, Solution, Status, make_solver


def raising(*_):
    raise RuntimeError("out of licences")


def slow(P, q, *_):
    time.sleep(0.005)
    return None


BACKENDS = {
    "raises": raising,
    "none": lambda *_: None,
    "nan": lambda P, q, *_: np.full(len(q), NAN),
    "wrong shape": lambda P, q, *_: np.zeros(len(q) + 1),
    "no array": lambda P, q, *_: "solved",
    "garbage": lambda P, q, *_: np.full(len(q), 1e3),
    "slow": slow,
}


def hard_tick(panda, backend=None):
    """A controller, and a tick whose velocity needs the QP; optionally with another back end."""
    controller = panda_controller(panda, "qp:daqp")
    if backend is not None:
        controller.solver._backend = backend
    near = {"ball": Sample.at([0.45, 0.0, 0.60], linear=[-0.02, 0.0, 0.0])}
    return controller, lambda c: c.tick(panda.home, 0.0, up(panda), near)


@pytest.mark.parametrize("fault", BACKENDS)
def test_a_back_end_that_fails_is_replaced_for_that_tick(panda, fault):
    controller, tick = hard_tick(panda)
    expected = tick(controller)
    rows = expected.problem.avoidance
    assert np.min(rows.J @ expected.solution.v - rows.b) < 1e-9 and expected.solution.status is Status.SOLVED
    broken, tick = hard_tick(panda, BACKENDS[fault])
    got = tick(broken)
    assert got.solution.status is expected.solution.status
    np.testing.assert_allclose(got.solution.v, expected.solution.v, atol=1e-9)


@pytest.mark.parametrize("fault", BACKENDS)
def test_when_every_back_end_fails_the_robot_brakes_and_recovers(panda, fault, monkeypatch):
    controller, tick = hard_tick(panda, BACKENDS[fault])
    good, _ = hard_tick(panda)
    moving = np.full(7, 0.5)
    with monkeypatch.context() as patch:
        patch.setattr("qpavoid.solvers.qp.solve_daqp", BACKENDS[fault])
        controller.reset(moving)
        failed = tick(controller)
    assert failed.solution.status is Status.STOPPED
    (reason,) = failed.solution.reasons
    assert (reason.kind, reason.severity) == (ReasonKind.SOLVER_FAILED, Severity.ALARM)
    np.testing.assert_allclose(failed.solution.v, 0.85 * moving, atol=1e-12)  # joint2: 0.075 rad/s a tick
    controller.solver._backend = good.solver._backend
    for each in (controller, good):
        each.reset()
    np.testing.assert_allclose(tick(controller).solution.v, tick(good).solution.v, atol=1e-12)


def test_a_wrong_optimum_is_safe(panda):
    """Whatever a back end returns as solved was checked against every row and bound."""
    honest, tick = hard_tick(panda)
    rng = np.random.default_rng(0)

    def lying(P, q, G, h, lower, upper):
        v = honest.solver._backend(P, np.asarray(q) * rng.uniform(-2.0, 2.0), G, h, lower, upper)
        return v if rng.random() < 0.5 or v is None else v + rng.normal(size=len(v))

    controller, tick = hard_tick(panda, lying)
    for _ in range(50):
        controller.reset()
        x, s = (got := tick(controller)).problem, got.solution
        assert s.status is not Status.STOPPED
        assert (s.v <= x.upper + 1e-9).all() and (s.v >= x.lower - 1e-9).all()
        short = x.avoidance.b - x.avoidance.J @ s.v - (0.0 if s.slack is None else s.slack)
        assert short.max() <= 2e-6


class Law:
    """A solver of a user's own that fails on command."""

    bounded = True

    def __init__(self):
        self.fault, self._qp = None, make_solver("qp")

    def solve(self, problem):
        return self._qp.solve(problem) if self.fault is None else self.fault(problem)


@pytest.mark.parametrize(
    "fault",
    [
        raising,
        lambda p: None,
        lambda p: Solution(np.full(7, NAN)),
        lambda p: Solution(np.zeros(6)),
        lambda p: Solution(np.zeros(7, dtype=complex)),
        lambda p: Solution(np.full(7, NAN), reasons=(Reason.of(ReasonKind.ROW_RELAXED, "a", "b"),)),
    ],
)
def test_a_failing_user_solver_stops_the_robot_with_the_reason(panda, fault):
    law = Law()
    controller = panda_controller(panda, law)
    vs = []
    for k in range(90):
        law.fault = fault if 30 <= k < 60 else None
        solution = controller.step(panda.home, 0.01 * k, up(panda))
        assert (solution.status is Status.STOPPED) == (law.fault is not None)
        if law.fault:
            failed = solution.reasons[-1]
            assert (failed.kind, failed.severity) == (ReasonKind.SOLVER_FAILED, Severity.ALARM)
            # what a law raised is there to read
            assert fault is not raising or failed.detail.endswith("RuntimeError: out of licences")
        vs.append(solution.v)
    assert np.abs(vs[29]).max() > 0.1 and not vs[59].any() and np.abs(vs[89]).max() > 0.1
    assert (np.abs(np.diff(vs, axis=0)) <= 0.01 * panda.bounds().acceleration + 1e-9).all()


def test_a_user_solver_never_passes_the_limits(panda):
    law = Law()
    controller = panda_controller(panda, law)
    law.fault = lambda p: Solution(np.full(7, 1e6))
    solution = controller.step(panda.home)
    assert (np.abs(solution.v) <= 0.01 * panda.bounds().acceleration + 1e-12).all()
    assert solution.saturation > 1e5
