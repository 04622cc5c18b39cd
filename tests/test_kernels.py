"""The array work of a tick: both versions by plain definitions, against each other, and in a closed loop."""

import os
import subprocess
import sys
from importlib import import_module

import numpy as np
import pinocchio as pin
import pytest

SEEDS = range(8)
NAMES = (
    *("candidates", "closing_speed_bound", "damped_solution", "distance_rows", "frame_rows", "projection_cost"),
    *("shortfall", "tracking_shortfall", "velocity_bounds"),
)


def version(name):
    if name == "compiled":
        pytest.importorskip("numba")
    return import_module(f"qpavoid.kernels.{name}")


@pytest.fixture(params=["vectorised", "compiled"])
def kernels(request):
    """Each version in turn."""
    return version(request.param)


def call(function, args):
    """Everything that a call returns, and its arguments as it leaves them."""
    # order "K" turns views with gaps into whole arrays: those are passed as they are, they are read-only
    args = [a.copy(order="K") if isinstance(a, np.ndarray) and a.flags.writeable else a for a in args]
    results = function(*args)
    return [*(results if isinstance(results, tuple) else (results,)), *(a for a in args if isinstance(a, np.ndarray))]


def check_parity(name, *args):
    """Both versions return the same and leave their arguments in the same state; gives what they return."""
    found = call(getattr(version("compiled"), name), args)
    expected = call(getattr(version("vectorised"), name), args)
    for a, b in zip(found, expected, strict=True):
        assert np.shape(a) == np.shape(b) and np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    return expected


def gaps(array, columns):
    """The same as a read-only view into rows of `columns` doubles, as coal and Pinocchio hold them in memory."""
    buffer = np.full((len(array), columns), np.nan)
    buffer[:, : array.shape[1]] = array
    view = np.lib.stride_tricks.as_strided(buffer, array.shape, buffer.strides, writeable=False)
    np.testing.assert_array_equal(view, array)
    return view


def rotations(rng, count):
    return np.array([pin.exp3(rng.uniform(-3, 3, 3)) for _ in range(count)]).reshape(-1, 3, 3)


def poses_of(R, p, columns=12):
    """Rotations by columns, then positions."""
    return gaps(np.hstack((R.swapaxes(1, 2).reshape(-1, 9), p)), columns)


def test_there_are_two_versions_of_everything():
    import qpavoid.kernels as used

    assert set(NAMES) == set(used.__all__) - {"ACCELERATED"}
    for name in NAMES:
        assert getattr(used, name) is getattr(version("compiled" if used.ACCELERATED else "vectorised"), name)


# --- candidates --------------------------------------------------------------------------------------------------


def spheres(seed, bodies=5, geometries=12, size=1.0, columns=12):
    """Random bounding spheres: arguments of `candidates`, and the pairs that a look at each combination finds."""
    rng = np.random.default_rng(seed)
    R, p = rotations(rng, geometries), rng.uniform(-1, 1, (geometries, 3))
    local, touching = rng.uniform(-0.3, 0.3, (geometries, 3)), size * rng.uniform(0.2, 1.5, (bodies, geometries))
    world = np.array([R[i] @ local[i] + p[i] for i in range(geometries)])
    pair_of = np.full((bodies, geometries), -1)
    combinations = [(i, j) for i in range(bodies) for j in range(i + 1, geometries) if rng.random() < 0.8]
    for k, combination in enumerate(combinations):
        pair_of[combination] = k
    centers = np.ones((geometries, 5))
    centers[:, :3] = world
    centers[:, 4] = -np.sum(world**2, axis=1)
    expected = sorted(pair_of[i, j] for i, j in combinations if np.linalg.norm(world[i] - world[j]) <= touching[i, j])
    left = centers.copy()
    left[:bodies, [0, 1, 2, 4]] = np.nan  # to be overwritten
    within = np.where(pair_of >= 0, touching**2, -1.0)
    return (poses_of(R, p, columns), local, left, within, pair_of), expected, centers


@pytest.mark.parametrize("seed", SEEDS)
def test_candidates_are_the_pairs_whose_spheres_are_within_reach(kernels, seed):
    args, expected, centers = spheres(seed)
    assert 0 < len(expected) < (args[4] >= 0).sum()
    found = kernels.candidates(*args)
    assert found.dtype == np.intp and found.tolist() == expected
    np.testing.assert_allclose(args[2], centers, rtol=0, atol=1e-14)


def test_candidates_none_one_and_all(kernels):
    assert kernels.candidates(*spheres(0, size=0.0)[0]).tolist() == []
    args, _, _ = spheres(1)
    args[3][args[4] >= 0] = np.inf
    assert kernels.candidates(*args).tolist() == list(range((args[4] >= 0).sum()))
    args[4][:] = np.where(args[4] == 3, 0, -1)
    args[3][args[4] < 0] = -1.0
    assert kernels.candidates(*args).tolist() == [0]


def test_candidates_include_spheres_that_just_touch(kernels):
    """3-4-5 triangles: 25e-2 is within 25e-2 (1 + 1e-9), and not within 25e-2 (1 - 1e-9)."""
    world = np.array([[0.0, 0, 0], [0.3, 0.4, 0], [0, -0.3, 0.4], [0.4, 0, -0.3]])
    poses = poses_of(np.array([np.eye(3)] * 4), world)
    for sign, expected in ((1, [0, 1, 2]), (-1, [])):
        centers = np.hstack((world, np.ones((4, 1)), -np.sum(world**2, axis=1, keepdims=True)))
        within = np.array([[-1.0, *[0.25 * (1 + sign * 1e-9)] * 3]])
        pair_of = np.array([[-1, 0, 1, 2]])
        assert kernels.candidates(poses, np.zeros((4, 3)), centers, within, pair_of).tolist() == expected


@pytest.mark.parametrize("seed", SEEDS)
def test_candidates_of_both_versions(seed):
    for size in (0.0, 0.5, 1.0, 100.0):
        args, expected, _ = spheres(seed, bodies=1 + 3 * seed, geometries=2 + 8 * seed, size=size, columns=12 + seed)
        assert check_parity("candidates", *args)[0].tolist() == expected


# --- distances ---------------------------------------------------------------------------------------------------


def distances(seed, pairs=9, nv=7, obstacles=3, columns=17):
    """Random arguments of `distance_rows`: every other pair is looked at, some of these are near."""
    rng = np.random.default_rng(seed)
    results = rng.normal(size=(pairs, 10))
    results[:, 1:4] /= np.linalg.norm(results[:, 1:4], axis=1, keepdims=True)
    chosen = np.flatnonzero(rng.random(pairs) < 0.7)
    twists = np.vstack((rng.normal(size=(obstacles, 6)), np.zeros(6)))
    support = rng.integers(-1, 2, (pairs, nv)).astype(float)
    J = np.asfortranarray(rng.normal(size=(6, nv)))
    return [gaps(results, columns), chosen, 0.5, J, support, twists, rng.integers(0, obstacles + 1, pairs), True]


@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("seed", SEEDS)
def test_rate_of_a_distance_is_that_of_the_witness_points_along_the_normal(kernels, seed, moving):
    """ḋ = n·(ṗ_b - ṗ_a), each point carried by the joints that move its body, and by its obstacle."""
    args = distances(seed, pairs=40)
    results, chosen, reach, J_world, support, twists, twist_row, _ = args
    args[-1] = moving
    if not moving:
        twists[:] = 0.0
    near, closest, J, drift = kernels.distance_rows(*args)
    expected = [i for i in chosen if results[i, 0] < reach]
    assert len(expected) < len(chosen) < len(results)
    assert near.dtype == np.intp and near.tolist() == expected
    np.testing.assert_array_equal(closest, results[expected])
    for k, i in enumerate(expected):
        n, p = results[i, 1:4], results[i, 4:7]

        def speed(twist, n=n, p=p):
            return n @ (twist[:3] + np.cross(twist[3:], p))

        np.testing.assert_allclose(J[k], [speed(twist) for twist in J_world.T] * support[i], rtol=0, atol=1e-13)
        assert drift[k] == pytest.approx(speed(twists[twist_row[i]]), abs=1e-13)


def test_a_pair_exactly_at_the_reach_is_not_near(kernels):
    args = distances(0, pairs=3)
    results = np.array(args[0])
    results[:, 0] = 0.5, np.nextafter(0.5, 0.0), -0.5
    args[0], args[1] = gaps(results, 17), np.arange(3)
    assert kernels.distance_rows(*args)[0].tolist() == [1, 2]


@pytest.mark.parametrize("columns", [10, 17])
def test_no_pair_near(kernels, columns):
    args = distances(0, columns=columns)
    for chosen, reach in ((args[1], -np.inf), (args[1][:0], np.inf)):
        near, closest, J, drift = kernels.distance_rows(args[0], chosen, reach, *args[3:])
        assert (near.shape, closest.shape, J.shape, drift.shape) == ((0,), (0, 10), (0, 7), (0,))
        assert near.dtype == np.intp


@pytest.mark.parametrize("columns", [10, 13, 17])
@pytest.mark.parametrize("pairs", [0, 1, 2, 50])
def test_distance_rows_of_both_versions(pairs, columns):
    for seed in SEEDS:
        args = distances(seed, pairs=pairs, nv=1 + seed, columns=columns)
        check_parity("distance_rows", *args)
        every = np.arange(pairs)
        assert len(check_parity("distance_rows", args[0], every, np.inf, *args[3:])[0]) == pairs
        check_parity("distance_rows", args[0], every, 0.0, np.ascontiguousarray(args[3]), *args[4:-1], False)


# --- bounds of rows ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("switching", [True, False])
def test_closing_speed_bound_by_its_definition(kernels, switching):
    """-(1 - β) ξ (d - d1) outside d1, ξ (d1 - d) up to the cap inside it; d = d1 and d = d2 exactly as well."""
    d1, d2, gain = 0.1, 0.3, 5.0
    d = np.array([-1.0, 0.05, 0.08, d1, 0.15, 0.2, d2, 0.5])
    beta = np.array([1.0, 1.0, 1.0, 1.0, 0.5 + 0.25 * np.sqrt(2.0), 0.5, 0.0, 0.0])
    for cap in (0.2, np.inf):
        raw = gain * (d1 - d)
        expected = np.minimum(np.where(raw > 0.0, raw, (1.0 - beta) * raw) if switching else raw, cap)
        found = kernels.closing_speed_bound(d, d1, gain, cap, switching, d1, d2)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("pairs", [0, 1, 100])
def test_closing_speed_bounds_of_both_versions(pairs):
    d = np.random.default_rng(0).uniform(-0.2, 0.5, pairs)
    for switching in (True, False):
        for cap in (0.2, np.inf):
            check_parity("closing_speed_bound", d, 0.1, 5.0, cap, switching, 0.1, 0.3)
    check_parity("closing_speed_bound", d, 0.2, 5.0, 0.2, False, 0.1, 0.3)


# --- frames ------------------------------------------------------------------------------------------------------


def frames(seed, count, turns, nv=7):
    """Random arguments of `frame_rows` for frames of which `turns` have orientations."""
    rng = np.random.default_rng(seed)
    turns = np.array(turns, dtype=np.intp)
    rows = 3 * (count + len(turns))
    screws = np.zeros((rows, 6))
    screws[: 3 * count, :3] = np.tile(np.eye(3), (count, 1))
    screws[3 * count :, 3:] = np.tile(np.eye(3), (len(turns), 1))
    poses = np.array(poses_of(rotations(rng, count), rng.normal(size=(count, 3))))
    scale = rng.uniform(0.5, 2.0, rows)
    support = scale[:, None] * rng.integers(0, 2, (rows, nv))
    position, linear, angular = rng.normal(size=(3, count, 3))
    J = np.asfortranarray(rng.normal(size=(6, nv)))
    gain = rng.uniform(0.5, 3.0, (count, 1))
    return [screws, turns, poses, position, rotations(rng, count), linear, angular, gain, scale, J, support]


FRAMES = [(1, []), (1, [0]), (2, [1]), (4, []), (4, [0, 2]), (4, [0, 1, 2, 3])]


@pytest.mark.parametrize(("count", "turns"), FRAMES)
def test_rows_of_frames_by_their_definition(kernels, count, turns):
    """Velocity of a point p of a body: J_v + J_ω × p; b = v_ref + K (x_ref - x), with log(R_ref Rᵀ) for turns."""
    args = frames(count, count, turns)
    _, _, poses, position, rotation, linear, angular, gain, scale, J, support = args
    expected_A, expected_b = [], []
    for f in range(count):
        expected_A += list(J[:3] + np.array([np.cross(twist[3:], poses[f, 9:]) for twist in J.T]).T)
        expected_b += list(linear[f] + gain[f] * (position[f] - poses[f, 9:]))
    for f in turns:
        R = poses[f, :9].reshape(3, 3).T
        expected_A += list(J[3:])
        expected_b += list(angular[f] + gain[f] * pin.log3(rotation[f] @ R.T))
    for _ in range(2):  # what the first call leaves in `screws` does not show in the second
        A, b = kernels.frame_rows(*args)
        np.testing.assert_allclose(A, np.array(expected_A) * support, rtol=0, atol=1e-13)
        np.testing.assert_allclose(b, np.array(expected_b) * scale, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("count", "turns"), FRAMES)
def test_frame_rows_of_both_versions(count, turns):
    for seed in SEEDS:
        args = frames(seed, count, turns, nv=1 + 2 * seed)
        check_parity("frame_rows", *args)


AXES = [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 0), (1, -2, 3), (-3, 1e-9, 1e-5)]


@pytest.mark.parametrize("axis", AXES)
def test_rotation_vector_at_all_angles(kernels, axis):
    """Angle and axis come back, in tiny turns to the last digit; at half a turn either of the two axes."""
    axis = np.array(axis) / np.linalg.norm(axis)
    rotation_vector = getattr(kernels, "rotation_vector", None) or kernels._rotation_vector
    for angle in (0.0, 1e-15, 1e-12, 1e-9, 1e-5, 0.1, 1.0, np.pi / 2, 2.0, 2.1, 3.0, np.pi - 1e-5, np.pi - 1e-9):
        found = rotation_vector(pin.exp3(angle * axis))
        np.testing.assert_allclose(found, angle * axis, rtol=0, atol=1e-15 + 1e-14 * angle / (np.pi - angle) ** 0.1)
    half = 2.0 * np.outer(axis, axis) - np.eye(3)
    found = np.array(rotation_vector(half))
    assert np.linalg.norm(found) == pytest.approx(np.pi, abs=1e-12)
    assert abs(found @ axis) == pytest.approx(np.pi, abs=1e-12)


# --- joint limits ------------------------------------------------------------------------------------------------


def test_velocity_bounds_by_hand(kernels):
    """dt = 0.01 s and half of what is left: 50 (q_lim - q), but not beyond v_max = 2, 3, 4, ∞, ∞ and 5.

    In turn: room on both sides; 0.01 rad short of the upper limit; 0.02 rad beyond it; no position limit; no speed
    limit; far below the lower limit, sent back at full speed.
    """
    inf = np.inf
    q = np.array([9.0, 0.0, 0.99, 1.02, 9.0, 9.0, 0.3, -4.0])  # q[0], q[4] and q[5] have no limits in this chart
    q_index, v_index = np.array([1, 2, 3, 6, 7]), np.array([0, 1, 2, 4, 5])
    lower, upper = kernels.velocity_bounds(
        q, q_index, v_index, np.array([-1.0, -1, -1, -inf, -1]), np.array([1.0, 1, 1, 1, 1]),
        np.array([2.0, 3.0, 4.0, inf, inf, 5.0]), 50.0,
    )  # fmt: skip
    np.testing.assert_allclose(lower, [-2.0, -3.0, -4.0, -inf, -inf, 5.0])
    np.testing.assert_allclose(upper, [2.0, 0.5, -1.0, inf, 35.0, 5.0])


@pytest.mark.parametrize("seed", SEEDS)
def test_velocity_bounds_of_both_versions(seed):
    rng = np.random.default_rng(seed)
    nv = 1 + 3 * seed
    limited = np.flatnonzero(rng.random(nv) < 0.7)
    q_lower, q_upper = rng.uniform(-2, 0, len(limited)), rng.uniform(0, 2, len(limited))
    v_max = rng.uniform(0.1, 5.0, nv)
    v_max[rng.random(nv) < 0.2] = np.inf
    q_lower[rng.random(len(limited)) < 0.2] = -np.inf
    q_upper[rng.random(len(limited)) < 0.2] = np.inf
    q = rng.uniform(-3, 3, nv + 1)
    lower, upper, *_ = check_parity("velocity_bounds", q, limited + 1, limited, q_lower, q_upper, v_max, 50.0)
    assert (lower <= upper).all()
    check_parity("velocity_bounds", q, limited[:0], limited[:0], q_lower[:0], q_upper[:0], v_max, 50.0)


# --- solutions ---------------------------------------------------------------------------------------------------


def rows(seed, count, nv=14):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, nv)), rng.normal(size=count)


@pytest.mark.parametrize("damping", [0.0, 0.01, 0.5])
@pytest.mark.parametrize("count", [1, 3, 6, 9])
def test_damped_solution_by_singular_values(kernels, count, damping):
    """Each singular value s becomes s / (s² + λ²)."""
    for seed in SEEDS:
        A, b = rows(seed, count)
        U, s, Vt = np.linalg.svd(A, full_matrices=False)
        expected = Vt.T @ (s / (s**2 + damping**2) * (U.T @ b))
        np.testing.assert_allclose(kernels.damped_solution(A, b, damping), expected, rtol=0, atol=1e-12)


def test_damped_solution_minimises_error_and_effort(kernels):
    """More rows than joints, and repeated ones: ‖A v - b‖² + λ² ‖v‖² is stationary."""
    for count, nv in ((9, 7), (6, 3)):
        A, b = rows(0, count, nv)
        A[-1], b[-1] = A[0], 1.0 - b[0]
        v = kernels.damped_solution(A, b, 0.1)
        np.testing.assert_allclose(A.T @ (A @ v - b) + 0.01 * v, 0.0, rtol=0, atol=1e-11)


@pytest.mark.parametrize("count", [1, 3, 6, 9])
def test_damped_solutions_of_both_versions(count):
    for seed in SEEDS:
        A, b = rows(seed, count)
        for damping in (0.0, 0.01, 0.5):
            check_parity("damped_solution", A, b, damping)
        check_parity("damped_solution", A[:, :7], b, 0.3)  # not contiguous; for 9 rows, singular but for the damping


@pytest.mark.parametrize("shrink", [0.0, 1e-12, 1e-8, 1e-4])
@pytest.mark.parametrize("which", [0, 1, -1])
def test_rows_that_are_nearly_dependent_have_no_undamped_solution(shrink, which):
    """Pivots of A Aᵀ that differ by more than 1e6; with damping there always is a solution."""
    for count in (3, 6, 9):
        A, b = rows(count, count)
        A[which] = shrink * A[which] + A[which - 1]
        assert np.isnan(check_parity("damped_solution", A, b, 0.0)[0]).all()
        assert np.isfinite(version("compiled").damped_solution(A, b, 0.1)).all()
    small = np.diag([1.0, 1.0, 1e-2]) @ np.eye(3, 14)
    assert np.isfinite(check_parity("damped_solution", small, np.ones(3), 0.0)[0]).all()
    small[2] *= 1e-2
    assert np.isnan(check_parity("damped_solution", small, np.ones(3), 0.0)[0]).all()


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_damped_solution_does_not_lose_nan(kernels, damping):
    for count in (1, 3, 6):
        for i in range(count):
            A, b = rows(0, count)
            b[i] = np.nan
            assert np.isnan(kernels.damped_solution(A, b, damping)).all()
            A, b = rows(0, count)
            A[i, 5] = np.nan
            assert np.isnan(kernels.damped_solution(A, b, damping)).all()


def constraints(seed, pairs, nv=7):
    rng = np.random.default_rng(seed)
    lower, upper = -rng.uniform(0.5, 3.0, nv), rng.uniform(0.5, 3.0, nv)
    return [rng.normal(size=nv), rng.normal(size=(pairs, nv)), rng.normal(size=pairs), lower, upper]


@pytest.mark.parametrize("pairs", [0, 1, 20])
def test_shortfall_is_the_largest_violation(kernels, pairs):
    for seed in SEEDS:
        v, J, b, lower, upper = args = constraints(seed, pairs)
        upper[2] = np.inf
        lower[3] = -np.inf
        violations = [b[k] - J[k] @ v for k in range(pairs)]
        violations += [v[i] - upper[i] for i in range(7)] + [lower[i] - v[i] for i in range(7)]
        assert kernels.shortfall(*args) == pytest.approx(max(violations), abs=1e-13)
        check_parity("shortfall", *args)
    v, J = np.zeros(7), np.ones((pairs, 7))
    assert kernels.shortfall(v, J, np.full(pairs, -9.0), np.full(7, -1.0), np.full(7, 2.0)) == -1.0
    assert kernels.shortfall(v, J, np.full(pairs, -9.0), np.full(7, -np.inf), np.full(7, np.inf)) == (
        -9.0 if pairs else -np.inf
    )


@pytest.mark.parametrize("pairs", [0, 1, 20])
@pytest.mark.parametrize("argument", ["v", "J", "b", "lower", "upper"])
def test_shortfall_does_not_lose_nan(kernels, argument, pairs):
    """Wherever it stands: in the first, a middle or the last entry."""
    index = ["v", "J", "b", "lower", "upper"].index(argument)
    for place in (0, -1, 3):
        args = constraints(0, pairs)
        flat = args[index].reshape(-1)
        if not -len(flat) <= place < len(flat):
            continue
        flat[place] = np.nan
        assert np.isnan(kernels.shortfall(*args)), place


def test_tracking_shortfall_is_both_in_one(kernels):
    for seed in SEEDS:
        A, b = rows(seed, 6, 7)
        _, J, least, lower, upper = constraints(seed, 5)
        v, worst = kernels.tracking_shortfall(A, b, 0.1, J, least, lower, upper)
        np.testing.assert_array_equal(v, kernels.damped_solution(A, b, 0.1))
        assert worst == kernels.shortfall(v, J, least, lower, upper)
        check_parity("tracking_shortfall", A, b, 0.1, J, least, lower, upper)
        A[1] = A[0]
        v, worst = kernels.tracking_shortfall(A, b, 0.0, J, least, lower, upper)
        assert np.isnan(v).all() and np.isnan(worst)


@pytest.mark.parametrize("count", [3, 6, 9])
def test_projection_cost_is_smallest_at_the_velocity_it_is_made_for(kernels, count):
    """½ vᵀP v + qᵀv + const = ½ ‖A (v - v0)‖² + ½ λ ‖v - v0‖²."""
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        A, v0 = rng.normal(size=(count, 7)), rng.normal(size=7)
        P, q = kernels.projection_cost(A, 1e-3, v0)
        np.testing.assert_array_equal(P, P.T)
        np.testing.assert_allclose(np.linalg.solve(P, -q), v0, rtol=0, atol=1e-10)
        for v in rng.normal(size=(5, 7)):
            found = 0.5 * v @ P @ v + q @ v - (0.5 * v0 @ P @ v0 + q @ v0)
            expected = 0.5 * np.sum((A @ (v - v0)) ** 2) + 0.5e-3 * np.sum((v - v0) ** 2)
            assert found == pytest.approx(expected, abs=1e-11)
        check_parity("projection_cost", A, 1e-3, v0)


# --- whole ticks -------------------------------------------------------------------------------------------------

RUN = """
import sys

import numpy as np
import pinocchio as pin

from qpavoid import Controller, kernels, load_scenario

path, scenario, ticks = sys.argv[1], sys.argv[2], int(sys.argv[3])
controller, start = Controller.from_scenario(load_scenario(scenario, solver="qp:daqp"))
model, q, v, active = controller.scene.robot.model, start, [], 0
for k in range(ticks):
    v.append(controller.step(q, k * controller.dt).v)
    q = pin.integrate(model, q, controller.dt * v[-1])

rng, problems = np.random.default_rng(0), []
for k in range(200):  # the same configurations for both
    q = pin.integrate(model, start, rng.uniform(-0.8, 0.8, model.nv))
    problems.append(controller.tick(q, 0.05 * k).problem)
parts = {"v": v, "lower": [p.lower for p in problems], "upper": [p.upper for p in problems]}
for name in ("A", "b"):
    parts["tracking " + name] = [getattr(p.tracking, name) for p in problems]
for name in ("pair", "d", "J", "b"):
    parts["avoidance " + name] = [getattr(p.avoidance, name) for p in problems]
np.savez(path, accelerated=kernels.ACCELERATED, **{name: np.concatenate(part) for name, part in parts.items()})
"""


@pytest.mark.parametrize(("scenario", "ticks"), [("panda_line", 1201), ("situation2", 1101)])
def test_a_run_is_the_same_with_and_without_numba(tmp_path, scenario, ticks):
    """The whole scenario in closed loop, in which what differs adds up; and rows at the same configurations."""
    pytest.importorskip("numba")
    runs = []
    for numba in ("0", "1"):
        path = tmp_path / f"{numba}.npz"
        command = [sys.executable, "-c", RUN, str(path), scenario, str(ticks)]
        subprocess.run(command, env={**os.environ, "QPAVOID_NUMBA": numba}, check=True, timeout=300)
        with np.load(path) as saved:
            runs.append(dict(saved))
    plain, fast = runs
    assert not plain["accelerated"] and fast["accelerated"]
    np.testing.assert_allclose(fast["v"], plain["v"], rtol=0, atol=1e-9)
    assert len(plain["avoidance d"]) > 50 and np.abs(plain["v"]).max() > 0.1
    for name in plain.keys() - {"v", "accelerated"}:
        np.testing.assert_allclose(fast[name], plain[name], rtol=1e-12, atol=1e-12, err_msg=name)
