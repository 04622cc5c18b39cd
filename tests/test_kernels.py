"""Array work of a control step: by plain definitions, by hand, and without the compiler."""

import gc
import os
import subprocess
import sys
import weakref

import numpy as np
import oracle_kernels as oracle
import pinocchio as pin
import pytest
from conftest import BOX, CAPSULE, CYLINDER, SPHERE, lay_out_step, make_layout, random_q, random_scene

from qpavoid import kernels
from qpavoid.control.estimates import MeasuredStates
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.control.trajectories import TrajectoryBatch
from qpavoid.kernels.packing import compiled

SEEDS = range(8)
ROBOTS = ["paper", "panda", "solo"]


def run(name, x, *args):
    """Packs a layout and calls a kernel with it."""
    return getattr(kernels, name)(kernels.pack(x), *args)


class Step:
    """Memory of a control step of a robot among moving obstacles, kinematics and distances of one configuration."""

    def __init__(self, robot, seed, **fields):
        self.rng, self.robot = np.random.default_rng(seed), robot
        scene = random_scene(robot, self.rng, [SPHERE, CAPSULE, BOX, CYLINDER] * 2)
        x, kinematics, query = lay_out_step(scene)
        starts = [obstacle.motion.sample(0.0) for obstacle in scene.obstacles]
        twists = self.rng.uniform(-0.5, 0.5, (len(starts), 2, 3))
        samples = [
            s._replace(linear=linear, angular=angular) for s, (linear, angular) in zip(starts, twists, strict=True)
        ]
        query.place(ObstacleStates.of(samples))
        self.q, self.pairs = random_q(robot, self.rng), np.arange(len(scene.pairs))
        kinematics.compute(self.q)
        query.compute(kinematics.joint_poses, np.inf)
        self.x = x._replace(**fields)
        x.margin[:-1] = self.rng.choice([0.0, 0.02, 0.1], len(scene.obstacles))
        self.keep = scene, kinematics, query  # owners of the memory

    def rows(self, influence_distance=np.inf):
        """Compute all rows and bounds; return the number of near pairs."""
        x = self.x
        x.v_prev[:] = self.rng.uniform(-1.0, 1.0, len(x.v_prev))
        run("velocity_bounds", x, self.q)
        run("stop_velocity", x)
        near = run("distance_rows", x, self.pairs, influence_distance, True)
        run("row_bounds", x, near, True)
        return near


@pytest.fixture(params=ROBOTS)
def robot(request):
    return request.getfixturevalue(request.param)


# --- candidates --------------------------------------------------------------------------------------------------


def spheres(seed, bodies=5, geometries=12, size=1.0):
    """Random bounding spheres: arguments of `candidates`, and the pairs that a look at each combination finds."""
    rng = np.random.default_rng(seed)
    R = np.array([pin.exp3(rng.uniform(-3, 3, 3)) for _ in range(geometries)])
    p, local = rng.uniform(-1, 1, (geometries, 3)), rng.uniform(-0.3, 0.3, (geometries, 3))
    touching = size * rng.uniform(0.2, 1.5, (bodies, geometries))
    world = np.einsum("gij,gj->gi", R, local) + p
    pair_of = np.full((bodies, geometries), -1)
    combinations = [(i, j) for i in range(bodies) for j in range(i + 1, geometries) if rng.random() < 0.8]
    for k, combination in enumerate(combinations):
        pair_of[combination] = k
    centers = np.column_stack((world, np.ones(geometries), -np.sum(world**2, axis=1)))
    centers[:bodies, [0, 1, 2, 4]] = np.nan  # to be overwritten
    expected = sorted(pair_of[i, j] for i, j in combinations if np.linalg.norm(world[i] - world[j]) <= touching[i, j])
    within, found = np.where(pair_of >= 0, touching**2, -1.0), np.full(len(combinations), -7)
    poses = np.hstack((R.swapaxes(1, 2).reshape(-1, 9), p))
    return [poses, local, centers, within, pair_of, np.ones(len(combinations), dtype=bool), found], expected


def found_by(args):
    """The pairs that `candidates` gives; it leaves the rest of their array alone."""
    count, found = kernels.candidates(*args), args[-1]
    assert (found[count:] == -7).all()
    return found[:count].tolist()


@pytest.mark.parametrize("seed", SEEDS)
def test_candidates_are_the_pairs_whose_spheres_are_near(seed):
    for size in (0.0, 0.5, 1.0, 100.0):
        args, expected = spheres(seed, bodies=1 + 3 * seed, geometries=2 + 8 * seed, size=size)
        assert found_by(args) == expected
        assert len(expected) == {0.0: 0, 100.0: (args[4] >= 0).sum()}.get(size, len(expected))


def test_candidates_include_spheres_that_just_touch():
    """3-4-5 triangles: 25e-2 is within 25e-2 (1 + 1e-9), and not within 25e-2 (1 - 1e-9)."""
    world = np.array([[0.0, 0, 0], [0.3, 0.4, 0], [0, -0.3, 0.4], [0.4, 0, -0.3]])
    poses = np.hstack((np.tile(np.eye(3).ravel(), (4, 1)), world))
    for sign, expected in ((1, [0, 1, 2]), (-1, [])):
        centers = np.hstack((world, np.ones((4, 1)), -np.sum(world**2, axis=1, keepdims=True)))
        within = np.array([[-1.0, *[0.25 * (1 + sign * 1e-9)] * 3]])
        args = [
            poses,
            np.zeros((4, 3)),
            centers,
            within,
            np.array([[-1, 0, 1, 2]]),
            np.ones(3, dtype=bool),
            np.full(3, -7),
        ]
        assert found_by(args) == expected


def test_sorted_setxor_is_the_symmetric_difference():
    rng = np.random.default_rng(0)
    for _ in range(100):
        a, b = (np.flatnonzero(rng.random(rng.integers(0, 30)) < rng.random()) for _ in range(2))
        assert kernels.sorted_setxor(a, b).tolist() == sorted({*a.tolist()} ^ {*b.tolist()})


# --- rows of distances -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_distance_rows_are_rates_of_the_witness_points(robot, seed):
    """ḋ = n·(ṗ_b - ṗ_a), each point moved by the joints that move its body, and by its obstacle."""
    step = Step(robot, seed)
    x, some = step.x, np.flatnonzero(step.rng.random(len(step.pairs)) < 0.7)
    for pairs, distance in ((some, 0.3), (step.pairs, np.inf), (step.pairs, 0.0), (some[:0], 1.0)):
        k = run("distance_rows", x, pairs, distance, True)
        near = pairs[x.results[pairs, 0] - x.margin[x.twist_row[pairs]] < distance]
        np.testing.assert_array_equal(x.near_pairs[:k], near)
        np.testing.assert_array_equal(x.closest[:k], x.results[near])
        among, J, rates = oracle.distance_rows(x, pairs, distance)
        np.testing.assert_array_equal(among, near)
        np.testing.assert_allclose(x.J[:k], J, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(x.feedforward[:k], rates, rtol=1e-12, atol=1e-12)
    run("distance_rows", x, step.pairs, np.inf, False)
    assert not x.feedforward.any()


def test_distance_rows_include_a_nan_distance(panda):
    """No bound is made up for it: what is left is NaN, which no velocity meets. A pair at the border is not near."""
    step = Step(panda, 0)
    results = np.array(step.x.results)
    results[:4, 0] = 0.5, np.nextafter(0.5, 0.0), np.nan, -0.5
    x = step.x._replace(results=results)
    pairs = np.arange(4)
    assert run("distance_rows", x, pairs, 0.5, True) == 3
    assert x.near_pairs[:3].tolist() == [1, 2, 3]
    k, worst, clear, *_ = run("assemble", x, step.q, pairs, 0.5, True, True)
    assert np.isnan(x.rhs[:k]).tolist() == [False, True, False] and np.isnan(worst) and not clear


# --- bounds of rows ----------------------------------------------------------------------------------------------


def rows_at(d, **fields):
    """Memory in which rows of all pairs are made, at distances d, of a robot that may move at any velocity."""
    closest = np.zeros((len(d), 10))
    closest[:, 0] = d
    bounds = {"lower": np.full(7, -np.inf), "upper": np.full(7, np.inf), "v_stop": np.zeros(7)}
    return make_layout(7, len(d), obstacles=2, **{"closest": closest, **bounds, **fields})


@pytest.mark.parametrize("near_speed", [0.0, 0.1, np.inf])
def test_row_bounds_by_hand(near_speed):
    """-(1 - β) ξ (d - d1) outside d1, or the near speed up to ξ (d - d1); ξ (d1 - d) up to the cap inside it."""
    d1, d2, gain = 0.1, 0.3, 5.0
    d = np.array([-1.0, 0.05, 0.08, d1, 0.15, 0.2, d2, 0.5])
    beta = np.array([1.0, 1.0, 1.0, 1.0, 0.5 + 0.25 * np.sqrt(2.0), 0.5, 0.0, 0.0])
    for cap in (0.2, np.inf):
        raw = gain * (d1 - d)
        closing = np.minimum((1.0 - beta) * raw, np.maximum(raw, -near_speed))
        expected = np.minimum(np.where(raw > 0.0, raw, closing), cap)
        x = rows_at(d, row_gain=gain, recovery_speed=cap, near_speed=near_speed)
        run("row_bounds", x, len(d), False)
        np.testing.assert_allclose(x.rhs, expected, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(x.d, d)


def test_row_bounds_with_offset_margin_and_feedforward():
    """The offset widens all distances, the margin of an obstacle narrows those to it, its drift counts as motion.

    Row i belongs to pair near[i], not to pair i.
    """
    near, of = np.array([1, 2, 4, 5]), np.array([9, 0, 1, 9, 2, 1])
    d, feedforward = np.zeros(6), np.zeros(6)
    d[:4], feedforward[:4] = [0.20, 0.20, 0.20, 0.02], [0.1, -0.2, 0.0, 0.3]
    x = rows_at(
        d, near_pairs=np.append(near, [-1, -1]), offset=0.05, margin=np.array([0.01, 0.04, 0.0]), twist_row=of,
        feedforward=feedforward, near_speed=np.inf,
    )  # fmt: skip
    run("row_bounds", x, 4, True)
    np.testing.assert_allclose(x.d[:4], [0.24, 0.21, 0.25, 0.03], rtol=0, atol=1e-15)
    np.testing.assert_allclose(x.rhs[:4], [-0.7 - 0.1, -0.55 + 0.2, -0.75, 0.2 - 0.3], rtol=0, atol=1e-14)


def test_distance_allowance_moves_the_safety_distance_of_a_pair():
    """A pair with an allowance s has the row of one that is s farther away, but touches where it touches."""
    d, allowance = np.array([0.02, 0.06, 0.2]), np.array([0.09, 0.0, 0.05])
    fields = {"offset": 0.01, "near_speed": np.inf, "row_gain": 5.0, "d1": 0.1}
    x, y = rows_at(d, distance_allowance=allowance, **fields), rows_at(d + allowance, **fields)
    for layout in (x, y):
        run("row_bounds", layout, 3, False)
    np.testing.assert_allclose(x.d, y.d, rtol=0, atol=1e-15)
    np.testing.assert_allclose(x.rhs, y.rhs, rtol=0, atol=1e-15)
    np.testing.assert_allclose(x.rhs_contact, np.minimum(5.0 * (0.0 - d), x.rhs), rtol=0, atol=1e-14)


def largest(row, lower, upper):
    """Largest J v within bounds, coordinate by coordinate."""
    return sum(max(a * low, a * high) for a, low, high in zip(row, lower, upper, strict=True) if a != 0.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_row_bounds_within_accelerations(paper, seed):
    """The beta row, closing at half of the accelerations at most, less the feed-forward; rhs_contact at d = 0.

    Rows are feasible: to part at most as fast as the bounds allow; not to close no sooner than a stop would end it.
    """
    x = Step(paper, seed, near_speed=0.2, offset=0.03, d1=0.1, d2=0.3).x
    rng, n = np.random.default_rng(seed), 30
    x = x._replace(v_step=rng.uniform(0.01, 0.5, 14))
    run("velocity_bounds", x, np.zeros(14))
    run("stop_velocity", x)
    x.closest[:n, 0], x.J[:n] = rng.uniform(-0.1, 0.5, n), rng.normal(size=(n, 14)) * rng.integers(0, 2, (n, 14))
    x.feedforward[:n], x.near_pairs[:n] = rng.normal(size=n), np.arange(n)
    run("row_bounds", x, n, True)
    raw = x.row_gain * (x.d1 - x.d)
    weight = 0.5 - 0.5 * np.cos(np.pi * np.clip((x.d - x.d1) / (x.d2 - x.d1), 0.0, 1.0))
    for i in range(n):
        J, feedforward = x.J[i], x.feedforward[i]
        if raw[i] > 0.0:
            most = largest(J, x.lower, x.upper)
            most = most if feedforward >= 0.0 else max(most, -feedforward)
            expected = min(min(raw[i], x.recovery_speed) - feedforward, most)
        else:
            half = 0.25 * np.abs(J) @ x.v_step
            brake = half - np.sqrt(half**2 + 4.0 * half * (x.d[i] - x.d1) / x.dt)
            expected = max(min(weight[i] * raw[i], max(raw[i], -0.2)), brake) - feedforward
            expected = expected if feedforward < 0.0 else min(expected, J @ x.v_stop)
        contact = min(x.row_gain * (x.offset - x.d[i]) - feedforward, expected)
        assert x.rhs[i] == pytest.approx(expected, rel=1e-12, abs=1e-13)
        assert x.rhs_contact[i] == pytest.approx(contact, rel=1e-12, abs=1e-13)
    assert (raw[:n] > 0.0).any() and (raw[:n] < 0.0).any()


def test_row_bounds_brake_a_pair_at_the_safety_distance():
    """Each step closes as fast as its row allows, slowed by half of the acceleration, at the end by a bit more."""
    step, d, v = np.array([0.1, 0.2]), np.array([0.9]), 0.0
    trace = []
    for _ in range(400):
        x = rows_at(
            d, J=np.array([[0.5, -1.0]]), v_step=step, acceleration_limited=True, v_stop=np.array([0.0, -1e3]),
            near_speed=np.inf, row_gain=100.0, lower=-np.ones(2), upper=np.ones(2),
        )  # fmt: skip
        run("row_bounds", x, 1, False)
        change, v = x.rhs[0] - v, x.rhs[0]
        d = d + x.dt * v
        trace.append((d[0], change))
    distances, changes = np.array(trace[1:]).T
    half = 0.5 * (0.05 + 0.2)
    assert (changes[:-1] <= 1.25 * half).all() and np.isclose(changes, half).sum() > 25
    assert distances.min() >= x.d1 - 1e-9 and distances[-1] == pytest.approx(x.d1, abs=1e-3)


# --- clearance ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_joint_speeds_bound_the_speed_of_every_point(robot, seed):
    """Nor is the bound a loose one: at most √2 too large."""
    step = Step(robot, seed)
    x, v = step.x, step.rng.normal(size=robot.model.nv)
    run("joint_speeds", x, v)
    twists = np.zeros((len(x.joint_poses), 6))
    for joint in range(1, len(twists)):
        own = x.column_joints == joint
        twists[joint] = twists[x.parents[joint]] + x.J_world[:, own] @ v[own]
    np.testing.assert_allclose(x.omega, twists[:, 3:], rtol=1e-12, atol=1e-12)
    for twist, pose, radius, speed in zip(twists, x.joint_poses, x.joint_radius, x.speeds, strict=False):
        points = step.rng.normal(size=(2000, 3))
        points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
        fastest = np.linalg.norm(twist[:3] + np.cross(twist[3:], pose[9:] + points), axis=1).max()
        assert fastest - 1e-12 <= speed <= 1.01 * np.sqrt(2.0) * fastest + 1e-12


@pytest.mark.parametrize("near", [0, 1, 30])
@pytest.mark.parametrize("jerks", [False, True])
def test_clearance_lower_bound_by_its_definition(robot, near, jerks):
    """From far below to far above nothing, at speeds at which the paths of points curve."""
    bounds = []
    for seed in range(10):
        step = Step(robot, seed)
        step.x = x = step.x._replace(jerk_limited=jerks)
        near = min(near, step.rows())
        x.d[:] = x.d1 + step.rng.uniform(0.05 * (seed % 2 - 0.5), 0.5, len(x.d))
        v, horizon = step.rng.uniform(-1.0, 1.0, robot.model.nv), 10.0 ** step.rng.uniform(-3.0, 0.0)
        bounds.append(run("clearance_lower_bound", x, v, near, 0.8, horizon))
        expected = oracle.clearance_lower_bound(x, v, near, 0.8, horizon)
        assert bounds[-1] == pytest.approx(expected, rel=1e-9, abs=1e-10)
    assert min(bounds) < 0.0 < max(bounds) or near < 30


def test_clearance_lower_bound_preserves_nan(paper):
    step = Step(paper, 0)
    x, v = step.x, np.zeros(14)
    step.rows()
    for near in (1, 30):
        for i in range(near):
            x.d[:] = 0.2
            x.d[i] = np.nan
            assert np.isnan(run("clearance_lower_bound", x, v, near, 0.5, 0.1))
    x.d[:] = 0.2
    for near in (0, 30):
        assert np.isnan(run("clearance_lower_bound", x, np.full(14, np.nan), near, 0.5, 0.1))


def test_leaves_position_limits_by_hand():
    """Coordinate 1 of v is number 2 of q: 0.5 rad/s for 0.3 s is 0.15 rad; 0.1 rad are left on either side."""
    x = make_layout(3, q_index=np.array([2]), v_index=np.array([1]), q_lower=np.array([-0.1]), q_upper=np.array([0.1]))
    q = np.array([9.0, 9.0, 0.0, 9.0])
    for v, horizon, leaves in ((0.5, 0.3, True), (-0.5, 0.3, True), (0.5, 0.19, False), (-0.5, 0.19, False)):
        assert run("leaves_position_limits", x, q, np.array([9.0, v, 9.0]), horizon) == leaves


@pytest.mark.parametrize("accelerations", [True, False])
def test_is_clear_by_the_clearance_bound_until_its_stop(paper, accelerations):
    clear = 0
    for seed in range(40):
        step = Step(paper, seed)
        if not accelerations:
            step.x = step.x._replace(v_step=np.full(14, np.inf), acceleration_limited=False)
        x = step.x
        step.rows()
        v = 10.0 ** (1 - seed % 4) * step.rng.normal(size=14)
        x.d[:] = step.rng.uniform(0.1, 0.5, len(x.d))
        horizon = x.dt * (1.0 + 0.5 * np.max(np.abs(v) / x.v_step))
        expected = run("clearance_lower_bound", x, v, 30, 0.5, horizon) > -kernels.TOLERANCE
        expected &= not (accelerations and run("leaves_position_limits", x, step.q, v, horizon))
        assert run("is_clear", x, step.q, v, 30, 0.5) == expected
        clear += expected
    assert 0 < clear < 40


# --- rotations ---------------------------------------------------------------------------------------------------

AXES = [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 0), (1, -2, 3), (-3, 1e-9, 1e-5)]


@pytest.mark.parametrize("rotation_vector", [kernels.rotation_vector, compiled(kernels.rotation_vector)])
@pytest.mark.parametrize("axis", AXES)
def test_rotation_vector_at_all_angles(axis, rotation_vector):
    """Angle and axis come back, in tiny turns to the last digit; at half a turn either of the two axes."""
    axis = np.array(axis) / np.linalg.norm(axis)
    for angle in (0.0, 1e-15, 1e-12, 1e-9, 1e-5, 0.1, 1.0, np.pi / 2, 2.0, 2.1, 3.0, np.pi - 1e-5, np.pi - 1e-9):
        found = rotation_vector(pin.exp3(angle * axis))
        np.testing.assert_allclose(found, angle * axis, rtol=0, atol=1e-15 + 1e-14 * angle / (np.pi - angle) ** 0.1)
    found = np.array(rotation_vector(2.0 * np.outer(axis, axis) - np.eye(3)))
    assert np.linalg.norm(found) == pytest.approx(np.pi, abs=1e-12)
    assert abs(found @ axis) == pytest.approx(np.pi, abs=1e-12)


# --- joint limits ------------------------------------------------------------------------------------------------


def test_velocity_bounds_by_hand():
    """dt = 0.01 s and half of what is left: 50 (q_lim - q), but not beyond v_max = 2, 3, 4, ∞, ∞ and 5.

    In turn: a margin on both sides; 0.01 rad below the upper limit; 0.02 rad beyond it; no position limit; no speed
    limit; far below the lower limit. From outside, `v_recovery` is asked for.
    """
    inf = np.inf
    q = np.array([9.0, 0.0, 0.99, 1.02, 9.0, 9.0, 0.3, -4.0])  # q[0], q[4] and q[5] have no limits in this chart
    x = make_layout(
        6, q_index=np.array([1, 2, 3, 6, 7]), v_index=np.array([0, 1, 2, 4, 5]),
        q_lower=np.array([-1.0, -1, -1, -inf, -1]), q_upper=np.array([1.0, 1, 1, 1, 1]),
        v_max=np.array([2.0, 3.0, 4.0, inf, inf, 5.0]), v_recovery=np.full(6, 0.2), position_rate=50.0,
    )  # fmt: skip
    assert run("velocity_bounds", x, q) == -3.0
    np.testing.assert_allclose(x.lower, [-2.0, -3.0, -4.0, -inf, -inf, 0.2])
    np.testing.assert_allclose(x.upper, [2.0, 0.5, -0.2, inf, 35.0, 5.0])
    np.testing.assert_allclose(x.centering, [0.0, -0.99, -1.0, 0.0, 0.0, 1.0])


def random_limits(rng, nv, jerks):
    """Limits of most coordinates, none of some; jerks: none, "some" or "all"."""
    limited = np.delete(np.arange(nv), [0, nv // 2])
    lower = rng.uniform(-2.0, 0.0, len(limited))
    v_step = rng.uniform(0.01, 0.5, nv)
    jerk_limited = np.full(nv, jerks == "all") | (rng.random(nv) < 0.7) if jerks else np.zeros(nv, dtype=bool)
    v_step = np.where(bool(jerks) | (rng.random(nv) < 0.7), v_step, np.inf)
    return {
        "q_index": limited + 1, "v_index": limited,
        "q_lower": np.where(rng.random(len(limited)) < 0.2, -np.inf, lower),
        "q_upper": np.where(rng.random(len(limited)) < 0.2, np.inf, lower + rng.uniform(0.5, 3.0, len(limited))),
        "v_max": np.where(rng.random(nv) < 0.8, rng.uniform(0.1, 5.0, nv), np.inf), "v_step": v_step,
        "v_prev": rng.uniform(-5.0, 5.0, nv), "dv_prev": rng.uniform(-1.0, 1.0, nv) * np.minimum(v_step, 1.0),
        "dv_step": np.where(jerk_limited, 10.0 ** -rng.uniform(0.0, 2.0, nv) * v_step, np.inf),
        "acceleration_limited": bool(np.isfinite(v_step).any()), "jerk_limited": bool(jerk_limited.any()),
    }  # fmt: skip


@pytest.mark.parametrize("jerks", ["", "some", "all"])
@pytest.mark.parametrize("seed", SEEDS)
def test_velocity_bounds_are_nested_from_any_state(seed, jerks):
    """Those with acceleration and jerk limits are never outside those of position and velocity."""
    rng = np.random.default_rng(seed)
    for nv in (3, 7, 30):
        x, q = make_layout(nv, **random_limits(rng, nv, jerks)), rng.uniform(-3, 3, nv + 1)
        at = q[x.q_index]
        margin = np.minimum(at - x.q_lower, x.q_upper - at).min(initial=np.inf)
        *expected, least = oracle.velocity_bounds(x, q)
        assert run("velocity_bounds", x, q) == pytest.approx(margin) == pytest.approx(least)
        if not x.acceleration_limited:
            expected[:2] = expected[2:]
        bounds = x.hard_lower, x.hard_upper, x.lower, x.upper
        np.testing.assert_allclose(bounds, expected, rtol=1e-9, atol=1e-9)
        assert (x.hard_lower <= x.lower).all() and (x.lower <= x.upper).all() and (x.upper <= x.hard_upper).all()
        assert (np.maximum(np.abs(x.lower), np.abs(x.upper)) <= x.v_max).all()
        free = np.ones(nv, dtype=bool)
        free[x.v_index] = False  # without position limits: as near to v_prev ± v_step as the speed limit allows
        near = free & np.isinf(x.dv_step)
        assert (x.lower[near] == np.clip(x.v_prev - x.v_step, -x.v_max, x.v_max)[near]).all()
        assert (x.upper[near] == np.clip(x.v_prev + x.v_step, -x.v_max, x.v_max)[near]).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_stop_velocity_is_the_fastest_by_one_factor(seed):
    """v_stop = s v_prev, the largest change being exactly one step of its coordinate; 0 once that is possible."""
    rng = np.random.default_rng(seed)
    v_step = rng.uniform(0.01, 0.5, 7)
    free = {"lower": np.full(7, -np.inf), "upper": np.full(7, np.inf)}
    fields = {"v_step": v_step, "acceleration_limited": True}
    x = make_layout(7, **fields, **free, v_prev=rng.uniform(-5.0, 5.0, 7))
    run("stop_velocity", x)
    factor = x.v_stop / x.v_prev
    np.testing.assert_allclose(factor, factor[0], rtol=1e-13)
    assert 0.0 < factor[0] < 1.0
    assert np.max(np.abs(x.v_prev - x.v_stop) / v_step) == pytest.approx(1.0, rel=1e-12)
    free["lower"][1], free["upper"][2] = 0.2, -0.3  # a coordinate that returns to its limits goes on moving
    for slow in (make_layout(7, **fields, **free, v_prev=0.5 * v_step), make_layout(7, **free, v_prev=x.v_prev)):
        run("stop_velocity", slow)
        np.testing.assert_array_equal(slow.v_stop, [0.0, 0.2, -0.3, 0.0, 0.0, 0.0, 0.0])


# --- solutions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pairs", [0, 1, 20])
def test_violation_is_the_largest_of_rows_and_bounds(pairs):
    """Of the rows of near pairs alone; NaN wherever one stands."""
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        v, J, b = rng.normal(size=7), rng.normal(size=(pairs + 3, 7)), rng.normal(size=pairs + 3)
        lower, upper = -rng.uniform(0.5, 3.0, 7), rng.uniform(0.5, 3.0, 7)
        upper[2], lower[3] = np.inf, -np.inf
        expected = max([*(b - J @ v)[:pairs], *(v - upper), *(lower - v)])
        args = v, J[:pairs], b[:pairs], lower, upper
        x = make_layout(7, pairs + 3, v_tracking=v, J=J, rhs=b)._replace(lower=lower, upper=upper)
        assert kernels.violation(*args) == pytest.approx(expected, abs=1e-13)
        assert run("tracking_violation", x, pairs) == pytest.approx(expected, abs=1e-13)
        for array in args:
            for place in (0, -1, 3):
                flat = array.reshape(-1)
                if -len(flat) <= place < len(flat):
                    kept, flat[place] = flat[place], np.nan
                    assert np.isnan(kernels.violation(*args)) and np.isnan(run("tracking_violation", x, pairs))
                    flat[place] = kept


@pytest.mark.parametrize("count", [3, 6, 9])
def test_projection_cost_is_smallest_at_the_velocity_it_is_made_for(count):
    """½ vᵀP v + qᵀv + const = ½ ‖A (v - v0)‖² + ½ λ ‖v - v0‖²."""
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        A, v_tracking = rng.normal(size=(count, 7)), rng.normal(size=7)
        P, q = kernels.projection_cost(A, 1e-3, v_tracking)
        np.testing.assert_array_equal(P, P.T)
        for v in rng.normal(size=(5, 7)):
            found = 0.5 * v @ P @ v + q @ v - (0.5 * v_tracking @ P @ v_tracking + q @ v_tracking)
            expected = 0.5 * np.sum((A @ (v - v_tracking)) ** 2) + 0.5e-3 * np.sum((v - v_tracking) ** 2)
            assert found == pytest.approx(expected, abs=1e-11)


# --- without the compiler ----------------------------------------------------------------------------------------

RUN = """
import sys

import numba
import numpy as np
import pinocchio as pin

from qpavoid import Controller, load_scenario

controller, q = Controller.from_scenario(load_scenario("situation1"))
v = []
for k in range(40):
    v.append(controller.step(q, 3.0 + k * controller.dt).v)
    q = pin.integrate(controller.scene.robot.model, q, controller.dt * v[-1])
problem = controller.tick(q).problem
np.savez(sys.argv[1], plain=numba.config.DISABLE_JIT, v=v, J=problem.avoidance.J, b=problem.avoidance.b,
         lower=problem.lower, upper=problem.upper)
"""


def test_kernels_give_the_same_velocities_in_plain_python(tmp_path):
    """`NUMBA_DISABLE_JIT=1` runs the same loops: all that differs is the order in which sums are taken."""
    runs = []
    for plain in ("0", "1"):
        path = tmp_path / f"{plain}.npz"
        environment = {**os.environ, "NUMBA_DISABLE_JIT": plain}
        subprocess.run([sys.executable, "-c", RUN, str(path)], env=environment, check=True, timeout=600)
        with np.load(path) as saved:
            runs.append(dict(saved))
    fast, plain = runs
    assert plain.pop("plain") and not fast.pop("plain") and fast.keys() == plain.keys()
    for name, values in fast.items():
        np.testing.assert_allclose(plain[name], values, rtol=0, atol=1e-10, err_msg=name)
    assert np.abs(fast["v"]).max() > 0.1 and fast["J"].size


# --- backup trajectories -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_backup_rows_are_those_of_enabled_pairs_without_contact(paper, seed):
    step = Step(paper, seed)
    x, rng = step.x, step.rng
    pairs = np.flatnonzero(rng.random(len(step.pairs)) < 0.7)
    enabled = rng.random(len(step.pairs)) < 0.7
    before, margin = enabled.copy(), x.margin[x.twist_row]
    distance = x.results[:, 0] - margin
    contact, influence = np.quantile(distance[pairs], [0.2, 0.8])
    near = [i for i in pairs.tolist() if distance[i] < influence and before[i]]
    kept = [i for i in near if distance[i] >= contact]
    bounds = np.full(len(step.pairs), np.inf)
    k, touching, nearest, second = run("backup_rows", x, step.q, pairs, bounds, influence, True, enabled, contact)
    assert x.near_pairs[:k].tolist() == kept and 0 < k < len(pairs)
    assert touching == len(near) - len(kept) > 0
    assert nearest == min(distance[near]) and second == min(distance[kept])
    assert np.flatnonzero(before & ~enabled).tolist() == [i for i in near if i not in kept]
    found = [array.copy() for array in (x.closest[:k], x.J[:k], x.feedforward[:k], x.lower, x.upper)]
    run("distance_rows", x, np.array(kept), np.inf, True)
    run("velocity_bounds", x, step.q)
    x.closest[:k, 0] -= margin[kept]
    for a, b in zip(found, (x.closest[:k], x.J[:k], x.feedforward[:k], x.lower, x.upper), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)


def test_backup_rows_take_nan_for_contact(paper):
    step = Step(paper, 0)
    results, pairs, enabled = np.array(step.x.results), np.arange(3), np.ones(len(step.pairs), dtype=bool)
    results[:3, 0] = 0.1, np.nan, 0.2
    x = step.x._replace(results=results)
    bounds = np.full(len(step.pairs), np.inf)
    k, touching, nearest, _ = run("backup_rows", x, step.q, pairs, bounds, np.inf, False, enabled, -np.inf)
    assert (k, touching) == (2, 1) and np.isnan(nearest) and enabled[:3].tolist() == [True, False, True]


def test_backup_rows_take_the_lower_bound_as_clearance_and_the_result_as_distance(paper):
    step = Step(paper, 0)
    results, pairs, bounds = np.array(step.x.results), np.arange(3), np.full(len(step.pairs), np.inf)
    results[:3, 0], bounds[1] = [0.4, 0.3, 0.5], 0.25
    x = step.x._replace(results=results)
    margin, allowance = (x.margin[x.twist_row[:3]], x.distance_allowance[:3])
    everything = np.ones(len(step.pairs), dtype=bool)
    k, _, nearest, second = run("backup_rows", x, step.q, pairs, bounds, np.inf, False, everything, 0.0)
    assert k == 3 and nearest == second == min([0.4, 0.25, 0.5] - margin + allowance)
    np.testing.assert_array_equal(x.closest[:3, 0], [0.4, 0.3, 0.5] - margin)


@pytest.mark.parametrize("seed", SEEDS)
def test_closes_below_by_its_definition(seed):
    rng, k = np.random.default_rng(seed), 5 * seed
    closest, J = rng.normal(size=(k, 10)), rng.normal(size=(k, 4))
    feedforward, v = rng.normal(size=k), rng.normal(size=4)
    least = (closest[:, 0] + 0.3 * (J @ v + feedforward)).min(initial=np.inf)
    for safe, closes in ((least - 1e-9, False), (least + 1e-9, k > 0)):
        assert kernels.closes_below(closest, J, feedforward, v, 0.3, safe) == closes


def test_ramp_keeps_to_the_largest_change():
    rng = np.random.default_rng(0)

    def follow(v, targets, step, stop_when_met):
        none = np.full(len(step), 1e9)
        return kernels.follow_ramp(
            kernels.RampLimits(step, none, none, False), v, 0.0 * v, targets, False, stop_when_met
        )

    v, wanted, step = rng.normal(size=5), rng.normal(size=(9, 5)), rng.uniform(0.1, 2.0, 5)
    for found, target in zip(follow(v, wanted, step, False), wanted, strict=True):
        v = np.clip(target, v - step, v + step)
        np.testing.assert_allclose(found, v, rtol=0, atol=1e-14)
    constant, step = np.array([[0.35, -0.1, 5.0]] * 6), np.array([0.1, 0.1, np.inf])
    for meets in (False, True):  # or ends where the wanted velocity is met
        found = follow(np.zeros(3), constant, step, meets)
        expected = [[min(0.1 * (i + 1), 0.35), -0.1, 5.0] for i in range(4 if meets else 6)]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
        assert len(follow(np.zeros(3), constant[:0], np.ones(3), meets)) == 0


def test_a_structure_keeps_its_arrays_through_all_calls_and_gives_them_back_with_itself():
    """Code that looks into the arrays of a structure neither frees one of them nor holds on to it."""
    measured = MeasuredStates(TrajectoryBatch({}).pieces, 3, dt=0.01)
    fields = {name: getattr(measured.arrays, name).copy() for name in ("states", "last", "updates", "stamps", "fits")}
    owned = {name: weakref.ref(array) for name, array in fields.items()}
    packed, which = kernels.pack(measured.arrays._replace(**fields)), np.arange(3)
    del fields
    gc.collect()
    row = np.r_[np.eye(3).ravel(), 1.0, 2.0, 3.0, np.zeros(6)]
    counts = []
    for k in range(50):
        assert kernels.check_updates(packed, which, np.tile(row, (3, 1)), np.zeros(3, np.intp)) == 0
        assert kernels.observe(packed, 0.01 * k, which, np.zeros(3, np.intp), np.full(3, 0.01 * k), which) == (0, 0)
        counts.append([sys.getrefcount(array()) for array in owned.values()])
    assert counts[0] == counts[-1]
    assert (owned["states"]() == row).all()
    del packed
    gc.collect()
    assert [name for name, array in owned.items() if array() is not None] == []
