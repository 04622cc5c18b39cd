"""The laws on random problems: closed forms, optimality conditions, defined outcomes."""

import numpy as np
import pytest
import qpsolvers
from hypothesis import given, settings
from hypothesis import strategies as st

from qpavoid import (
    ConfigError,
    Controller,
    Problem,
    ReasonKind,
    Severity,
    Status,
    UnknownName,
    build_scene,
    kernels,
    load_scenario,
    make_solver,
)
from qpavoid.config import Eq10Solver
from qpavoid.errors import SolverNotInstalled
from qpavoid.problem import AvoidanceRows, Tracking, make_problem
from qpavoid.solvers.backends import make_backend


def alpha(d, d2):
    return np.array([kernels.alpha(x, d2) for x in d])


def beta(d, d1, d2):
    return np.array([kernels.beta(x, d1, d2) for x in d])


NV, D1, D2 = 7, 0.18, 0.36
seeds = st.integers(0, 2**32 - 1)
EXACT = ("daqp", "quadprog", "native")
BACKENDS = (*EXACT, "proxqp", "osqp")


def random_problem(seed: int, pairs: int = 3, rows: int = 3, limit: float = 2.0) -> Problem:
    rng = np.random.default_rng(seed)
    d = rng.uniform(0.12, D2, pairs)
    b = -5.0 * (d - 0.12) * rng.uniform(0, 1, pairs) + 0.05 * rng.normal(size=pairs)
    avoidance = AvoidanceRows(np.arange(pairs), d, rng.normal(size=(pairs, NV)), b, D1, D2, b - 10.0)
    A, task = rng.normal(size=(rows, NV)), 0.3 * rng.normal(size=rows)
    tracking = Tracking(A, task, task)
    names = [(f"body{i}", f"obstacle{i}") for i in range(pairs)]
    return make_problem(tracking, avoidance, np.full(NV, -limit), np.full(NV, limit), names)


def with_rows(problem: Problem, **fields) -> Problem:
    rows = problem.avoidance._replace(**fields)
    return make_problem(problem.tracking, rows, problem.lower, problem.upper, problem.pair_names)


def closest_row(problem: Problem) -> tuple[np.ndarray, float, float]:
    """J_d, α and β of the closest pair."""
    rows = problem.avoidance
    i = int(np.argmin(rows.d))
    return rows.J[i], float(alpha(rows.d, D2)[i]), float(beta(rows.d, D1, D2)[i])


# --- eq. 10 and its identities --------------------------------------------------------------------------------


@given(seeds)
def test_literal_law_takes_the_primary_motion_away_twice(seed):
    """J_d q̇ = (1 - α) u + β (ẋ0 - u), u = J_d J⁺ẋ, for an undamped (J_d N)⁺."""
    problem = random_problem(seed)
    J_d, a, b = closest_row(problem)
    u = J_d @ problem.v_tracking
    v = make_solver(Eq10Solver(name="eq10-literal", damping=0.0)).solve(problem).v
    assert J_d @ v == pytest.approx((1 - a) * u + b * (0.1 - u), abs=1e-10)


@given(seeds)
def test_consistent_law_blends_what_is_left_of_the_primary_motion_with_retreat(seed):
    """J_d q̇ = (1 - β)(1 - α) u + β ẋ0, with α only while u < 0."""
    problem = random_problem(seed)
    J_d, a, b = closest_row(problem)
    u = J_d @ problem.v_tracking
    a = a if u < 0 else 0.0
    v = make_solver(Eq10Solver(name="eq10", damping=0.0)).solve(problem).v
    assert J_d @ v == pytest.approx((1 - b) * (1 - a) * u + b * 0.1, abs=1e-10)


@given(seeds, st.sampled_from(["eq10", "eq10-literal"]), st.sampled_from([0.0, 0.05]))
def test_only_alpha_moves_the_tool_off_its_path(seed, name, damping):
    """J (J_d N)⁺ = 0: whatever β does, A q̇ = b - α u A J_d⁺."""
    problem = random_problem(seed)
    J_d, a, _ = closest_row(problem)
    u = J_d @ problem.v_tracking
    a = a if u < 0 or name == "eq10-literal" else 0.0
    v = make_solver(Eq10Solver(name=name, damping=damping)).solve(problem).v
    expected = problem.tracking.b - a * u * (problem.tracking.A @ J_d) / (J_d @ J_d)
    np.testing.assert_allclose(problem.tracking.A @ v, expected, atol=1e-10)


@given(seeds)
def test_key_point_at_the_tool_leaves_no_null_space_motion(seed):
    """With J_d a combination of the task's rows, J_d N = 0 and the law must not divide round-off by round-off."""
    problem = random_problem(seed, pairs=1)
    n = np.array([0.6, 0.0, 0.8])
    problem = with_rows(problem, J=(n @ problem.tracking.A)[None])
    primary = problem.v_tracking
    J_d, a, _ = closest_row(problem)
    a = a if J_d @ primary < 0 else 0.0
    v = make_solver(Eq10Solver(name="eq10", damping=0.0)).solve(problem).v
    np.testing.assert_allclose(v, primary - a * J_d * (J_d @ primary) / (J_d @ J_d), atol=1e-9)


def test_alpha_is_capped_in_contact():
    problem = random_problem(1)
    problem = with_rows(problem, d=np.array([-0.01, 0.0, 0.2]))
    for name in ("eq10", "eq10-literal"):
        assert np.isfinite(make_solver(Eq10Solver(name=name)).solve(problem).v).all()


# --- tracking -------------------------------------------------------------------------------------------------


@given(seeds)
def test_tracking_is_the_shortest_exact_velocity(seed):
    problem = random_problem(seed)
    tracking, v = problem.tracking, problem.v_tracking
    np.testing.assert_allclose(tracking.A @ v, tracking.b, atol=1e-10)
    np.testing.assert_allclose(v, np.linalg.lstsq(tracking.A, tracking.b, rcond=None)[0], atol=1e-10)


# --- QP -------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(seeds, st.sampled_from(BACKENDS), st.integers(0, 8))
def test_qp_meets_rows_and_bounds_and_is_optimal(seed, backend, pairs):
    """KKT by projection: no feasible direction towards v0 in the metric P is left."""
    problem = random_problem(seed, pairs=pairs)
    solution = make_solver(f"qp:{backend}").solve(problem)
    rows = problem.avoidance
    if solution.status is not Status.SOLVED:
        return
    slackness = rows.J @ solution.v - rows.b
    assert np.all(slackness > -1e-6)
    assert np.all((solution.v >= problem.lower) & (solution.v <= problem.upper))
    v_tracking, tracking = problem.v_tracking, problem.tracking
    P = tracking.A.T @ tracking.A + 1e-3 * np.eye(NV)
    reference = qpsolvers.solve_qp(
        P, -P @ v_tracking, -rows.J if pairs else None, -rows.b if pairs else None,
        lb=problem.lower, ub=problem.upper, solver="quadprog",
    )  # fmt: skip
    np.testing.assert_allclose(solution.v, reference, atol=1e-7 if backend in EXACT else 1e-4)


@given(seeds)
def test_qp_returns_the_tracking_velocity_bit_for_bit_when_that_is_safe(seed):
    problem = random_problem(seed, limit=np.inf)
    rows = problem.avoidance
    v_tracking = problem.v_tracking
    problem = with_rows(problem, b=rows.J @ v_tracking - 1e-9)
    assert np.array_equal(make_solver("qp").solve(problem).v, v_tracking)


XI = 5.0


def threatened(J: np.ndarray, d: np.ndarray, feedforward: float = 0.0, free: float = 2.0) -> Problem:
    """Damper rows at distances d, with accelerations that leave `free` of a speed limit of 2."""
    b = np.minimum(XI * (D1 - d), 0.2) - feedforward
    rows = AvoidanceRows(np.arange(len(d)), d, J, b, D1, D2, np.minimum(-XI * d - feedforward, b))
    base = random_problem(5, pairs=len(d))
    bounds = np.full(NV, -free), np.full(NV, free)
    return make_problem(base.tracking, rows, *bounds, base.pair_names, (base.lower, base.upper))


def squeezed(d: tuple[float, float]) -> Problem:
    """One coordinate between two threats."""
    J = np.zeros((2, NV))
    J[0, 0], J[1, 0] = 1.0, -1.0
    return threatened(J, np.array(d))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("d", "v"), [((0.145, 0.175), 0.175), ((0.175, 0.145), -0.175), ((0.15, 0.15), 0.0), ((0.0, 0.02), 0.1)]
)
def test_contradicting_rows_relax_the_nearer_pair_less(backend, d, v):
    """Nothing, in fact, unless the other pair would touch for it; threats of the same depth share."""
    problem = squeezed(d)
    rows, solution = problem.avoidance, make_solver(f"qp:{backend}").solve(problem)
    assert solution.status is Status.RELAXED
    assert solution.v[0] == pytest.approx(v, abs=1e-4)
    np.testing.assert_allclose(solution.slack, np.maximum(rows.b - rows.J @ solution.v, 0.0), atol=1e-9)
    assert np.all(rows.J @ solution.v >= rows.b_contact - 1e-5)
    given = [i for i in np.argsort(d, kind="stable") if solution.slack[i] > 5e-6]
    named = [reason for reason in solution.reasons if reason.kind is ReasonKind.ROW_RELAXED]
    assert [reason.subject for reason in named] == [(f"body{i}", f"obstacle{i}") for i in given]
    np.testing.assert_array_equal([reason.amount for reason in named], solution.slack[given])


@pytest.mark.parametrize("backend", EXACT)  # proxqp and osqp are not exact enough to find the least excess
@pytest.mark.parametrize(("feedforward", "v"), [(0.0, 0.1), (-1.0, 0.95), (-4.0, 2.0)])
def test_acceleration_limits_relax_before_contact_and_other_limits_never(backend, feedforward, v):
    """Accelerations leave 0.1, speeds 2. An obstacle at rest costs margin only; from one at 1 m/s the arm
    retreats just fast enough to avoid contact, 1 - ξ d; from one at 4 m/s as fast as it can."""
    J = np.zeros((1, NV))
    J[0, 2] = 1.0
    solution = make_solver(f"qp:{backend}").solve(threatened(J, np.array([0.01]), feedforward, free=0.1))
    assert solution.status is Status.RELAXED
    assert solution.v[2] == pytest.approx(v, abs=1e-4)
    hurried = [reason for reason in solution.reasons if reason.kind is ReasonKind.ACCELERATION_RELAXED]
    excess = {reason.subject: reason.amount for reason in hurried}
    if v == 0.1:
        assert not excess
    else:
        assert excess[("joint3",)] == pytest.approx(v - 0.1, abs=1e-4)
    contact = feedforward == -4.0  # at full speed, and still not enough
    assert solution.severity is (Severity.ALARM if contact else Severity.WARNING)
    assert np.all(np.abs(solution.v) <= 2.0)
    assert solution.slack[0] == pytest.approx(0.2 - feedforward - v, abs=1e-4)


def test_unknown_and_missing_solvers_are_named():
    with pytest.raises(UnknownName, match="did you mean 'eq10'"):
        make_solver("eq1O")
    with pytest.raises(UnknownName, match="usable are daqp"):
        make_solver("qp:nope")
    with pytest.raises(SolverNotInstalled, match="pip install 'qpsolvers\\[gurobi\\]'"):
        make_backend("gurobi")


def test_solver_is_given_as_in_a_file(panda):
    """By name, or as the mapping that a scenario may have; errors are one line that names the field."""
    block = {"name": "qp", "backend": "daqp", "regularization": 0.01}
    law = make_solver(block)
    assert law.label == "qp:daqp" and law.config.regularization == 0.01
    controller = Controller(build_scene(panda), [], block)
    assert controller.solver.label == "qp:daqp"
    controller.solver = {"name": "eq10", "damping": 0.1}
    assert controller.solver.label == "eq10" and controller.solver.config.damping == 0.1
    for block, said in (
        ({"name": "qq"}, r"^solver: unknown name 'qq'; did you mean '\w*qp'\?$"),
        ({"backend": "daqp"}, r"^solver: `name` is missing; valid are eq10, "),
        ({"name": "qp", "regularisation": 0.01}, r"^solver.regularisation: unknown key; did you mean 'regularization'"),
        ({"name": "qp", "regularization": -1}, r"^solver.regularization: .*greater than 0"),
    ):
        for make in (make_solver, lambda law: Controller(build_scene(panda), [], law)):
            with pytest.raises(ConfigError, match=said):
                make(block)
    with pytest.raises(ConfigError, match=r"^solver: NoneType is none; give a name"):
        make_solver(None)
    with pytest.raises(ConfigError, match=r"^solver 'hpq': solver: unknown name 'hpq'; did you mean 'hqp'\?$"):
        load_scenario("situation1", solver="hpq")
