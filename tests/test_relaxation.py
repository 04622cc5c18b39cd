"""What is relaxed, and by how much: margins, then accelerations, then contact, and among pairs the deepest last.

Checked against sequences of linear programs by scipy's HiGHS and a quadratic program by quadprog.
"""

import numpy as np
import pytest
import qpsolvers
from closed_loop import cartesian, make_controller
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from qpavoid import Avoidance, Obstacle, ReasonKind, Severity, Status, make_solver
from qpavoid.config import Beta, Box
from qpavoid.problem import AvoidanceRows, Tracking, make_problem

NV, PAIRS, SAFE, GAIN = 5, 4, 0.05, 5.0


def random_problem(seed):
    """Rows of distinct depths and bounds that contradict each other as often as not."""
    rng = np.random.default_rng(seed)
    d = rng.permutation(np.linspace(-0.03, 0.12, 12))[:PAIRS] + rng.uniform(-1e-3, 1e-3, PAIRS)
    feedforward = rng.choice([0.0, 1.0], PAIRS) * rng.uniform(-0.4, 0.1, PAIRS)
    b = np.minimum(GAIN * (SAFE - d), 0.2) - feedforward
    touch = np.minimum(np.minimum(-GAIN * d, 0.2) - feedforward, b)
    rows = AvoidanceRows(np.arange(PAIRS), d, 0.5 * rng.normal(size=(PAIRS, NV)), b, SAFE, 0.2, touch)
    hard = rng.uniform(-1.0, 0.0, NV), rng.uniform(0.0, 1.0, NV)
    last, step = rng.uniform(*hard), rng.uniform(0.03, 0.4, NV)
    soft = np.maximum(hard[0], last - step), np.minimum(hard[1], last + step)
    A, task = rng.normal(size=(3, NV)), rng.normal(size=3)
    tracking = Tracking(A, task, task)
    names = [(f"body{i}", f"obstacle{i}") for i in range(PAIRS)]
    return make_problem(tracking, rows, *soft, names, hard, np.clip(0.9 * last, *soft))


def feasible(J, b, lower, upper):
    return linprog(np.zeros(NV), -J, -b, bounds=np.column_stack((lower, upper))).status == 0


def least_slack(rows, b, floor, lower, upper):
    """From the deepest row on: the least slack of each, with those before it at theirs."""
    slack, bound = np.zeros(PAIRS), floor.copy()
    for i in np.argsort(rows.d):
        lifted = np.where(np.arange(PAIRS) == i, 1.0, 0.0)[:, None]
        asked = np.where(np.arange(PAIRS) == i, b, bound)
        use = np.isfinite(asked)
        if np.isfinite(floor[i]):  # the floor itself may always be kept
            J, asked = np.vstack((np.hstack((rows.J, lifted))[use], np.r_[rows.J[i], 0.0])), np.r_[asked[use], floor[i]]
        else:
            J, asked = np.hstack((rows.J, lifted))[use], asked[use]
        limits = [*zip(lower, upper, strict=True), (0.0, None)]
        found = linprog(np.r_[np.zeros(NV), 1.0], -J, -asked + 1e-9, bounds=limits)
        slack[i] = found.x[-1]
        bound[i] = b[i] - slack[i]
    return slack


@settings(derandomize=True, deadline=None, max_examples=250)
@given(st.integers(0, 2**32 - 1))
def test_relaxation_takes_margins_then_accelerations_then_contact(seed):
    x = random_problem(seed)
    rows, s = x.avoidance, make_solver("qp").solve(x)
    assert (s.v >= x.hard_lower - 2e-6).all() and (s.v <= x.hard_upper + 2e-6).all()
    within = (s.v >= x.lower - 5e-6).all() and (s.v <= x.upper + 5e-6).all()
    met = feasible(rows.J, rows.b, x.lower, x.upper)
    assert (s.status is Status.SOLVED) == met
    if met:
        assert within and (rows.J @ s.v >= rows.b - 2e-6).all() and s.reasons == ()
        return
    assert s.status is Status.RELAXED and s.reasons
    no_floor = np.full(PAIRS, -np.inf)
    if feasible(rows.J, rows.b_contact, x.lower, x.upper):
        assert within  # margins come before accelerations
        expected = least_slack(rows, rows.b, rows.b_contact, x.lower, x.upper)
        np.testing.assert_allclose(s.slack, expected, atol=1e-3)
        return
    contact = least_slack(rows, rows.b_contact, no_floor, x.hard_lower, x.hard_upper)
    assert (rows.J @ s.v >= rows.b_contact - contact - 1e-4).all()
    assert not within
    excess = np.maximum(np.maximum(s.v - x.upper, x.lower - s.v), 0.0)
    assert np.sum((excess / (x.upper - x.lower)) ** 2) < 1.05 * least_excess(x, rows.b_contact - contact) + 1e-4


def least_excess(x, least):
    """Least sum of squares of the excess over acceleration limits, in units of their widths."""
    eye, zero = np.eye(NV), np.zeros((PAIRS, NV))
    P = np.diag(np.r_[np.full(NV, 1e-8), 2.0 / (x.upper - x.lower) ** 2])
    G = -np.block([[x.avoidance.J, zero], [eye, eye], [-eye, eye]])
    h = -np.r_[least - 1e-6, x.lower, -x.upper]
    lower, upper = np.r_[x.hard_lower, np.zeros(NV)], np.r_[x.hard_upper, np.full(NV, 10.0)]
    found = qpsolvers.solve_qp(P, np.zeros(2 * NV), G, h, lb=lower, ub=upper, solver="quadprog")
    return np.sum((found[NV:] / (x.upper - x.lower)) ** 2)


def test_random_problems_need_every_level_of_relaxation():
    """So that the test above covers every branch."""
    kinds = {"met": 0, "margins": 0, "accelerations": 0, "contact": 0}
    for seed in range(150):
        x = random_problem(seed)
        rows = x.avoidance
        cases = (("met", rows.b, x.lower, x.upper), ("margins", rows.b_contact, x.lower, x.upper),
                 ("accelerations", rows.b_contact, x.hard_lower, x.hard_upper))  # fmt: skip
        kinds[next((name for name, *case in cases if feasible(rows.J, *case)), "contact")] += 1
    assert min(kinds.values()) >= 5, kinds


@pytest.mark.parametrize("off", [0.004, -0.004])
def test_relaxation_between_two_walls_favours_the_nearer(tmp_path, off):
    """Walls 50 mm from a tool that wants 60 mm on both sides; 4 mm off the middle."""
    robot = cartesian(tmp_path, acceleration=None)
    walls = [Obstacle.at(n, Box(size=(0.1, 1, 1)), [x, 0, 0]) for n, x in (("left", -0.15), ("right", 0.15))]
    controller = make_controller(
        robot, walls, "z", avoidance=Avoidance(d1=0.06, d2=0.1, row=Beta(gain=5.0, near_speed=10))
    )
    s = controller.step([off, 0.0, 0.0])
    assert s.status is Status.RELAXED
    far = "left" if off > 0.0 else "right"
    # 46 mm and 54 mm: the nearer asks for 5 1/s times 14 mm = 70 mm/s and gets it, the other for 30 and loses 100
    np.testing.assert_allclose(s.v, [-np.sign(off) * 0.07, 0.0, 0.0], atol=1e-5)
    row, distance, nearer = s.reasons
    assert (nearer.kind, nearer.amount) == (ReasonKind.BELOW_SAFETY_DISTANCE, pytest.approx(0.014, abs=1e-9))
    assert (row.kind, row.subject, row.unit) == (ReasonKind.ROW_RELAXED, ("tool", far), "m/s")
    assert row.amount == pytest.approx(0.1, abs=1e-5) and s.slack.max() == pytest.approx(0.1, abs=1e-5)
    assert (distance.kind, distance.subject, distance.unit) == (ReasonKind.BELOW_SAFETY_DISTANCE, ("tool", far), "m")
    assert distance.amount == pytest.approx(0.006, abs=1e-9)
    assert {reason.severity for reason in s.reasons} == {Severity.WARNING}  # a margin, and no contact
