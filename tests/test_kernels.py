"""The array work of a tick, by plain definitions (`oracle_kernels` and here), by hand, and without the compiler."""

import os
import subprocess
import sys

import numpy as np
import oracle_kernels as oracle
import pinocchio as pin
import pytest
from conftest import make_layout

from qpavoid import kernels
from qpavoid.kernels.packing import compiled

SEEDS = range(8)
OF_PAIRS = ("near_pairs", "closest", "J", "feedforward", "d", "rhs", "rhs_contact")
"""Outputs of which only what belongs to near pairs counts."""


def run(name, x, *args):
    """Packs a layout and calls a kernel with it."""
    return getattr(kernels, name)(kernels.pack(x), *args)


def assert_same(found, expected, k):
    """Compare two layouts, of pairs the first k."""
    for name in set(kernels.RowLayout._fields) - {"unfolded_row"}:
        a, b = getattr(found, name), getattr(expected, name)
        if name in OF_PAIRS:
            a, b = a[:k], b[:k]
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12, err_msg=name)


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


def random_layout(seed, frames=2, turns=(1,), pairs=9, nv=7, obstacles=3, joints=4, views=True, plain=False, **fields):
    """Memory of a control step of no existing robot: any number in any place that the layout allows.

    Args:
        seed: of the random numbers.
        frames: number of tracked frames, of two more that the robot has.
        turns: which of them have an orientation to follow.
        pairs: number of them.
        nv: number of velocity coordinates.
        obstacles: number of them.
        joints: number of joints, the world among them.
        views: whether poses and results stand in memory with gaps, as those of Pinocchio and coal do.
        plain: whether every coordinate has a position limit and the same place in q and v; else two do not.
        fields: in place of the random ones.
    """
    rng = np.random.default_rng(seed)
    rows, capped = 3 * (frames + len(turns)), frames + len(turns)
    scale = rng.uniform(0.5, 2.0, rows)
    results = rng.normal(size=(pairs, 10))
    results[:, 1:4] /= np.linalg.norm(results[:, 1:4], axis=1, keepdims=True)
    poses = poses_of(rotations(rng, frames + 2), rng.normal(size=(frames + 2, 3)), 14 if views else 12)
    targets = np.hstack(
        (rotations(rng, frames).reshape(-1, 9), rng.normal(size=(frames, 3)), rng.normal(size=(frames, 6)))
    )
    limited = np.arange(nv) if plain else np.delete(np.arange(nv), [0, nv // 2][: nv - 1])
    q_lower = rng.uniform(-2.0, 0.0, len(limited))
    v_step = np.where(rng.random(nv) < 0.7, rng.uniform(0.01, 0.5, nv), np.inf)
    random = {
        "J_world": np.asfortranarray(rng.normal(size=(6, nv))),
        "frame_poses": poses if views else np.array(poses),
        "frame_ids": rng.permutation(frames + 2)[:frames],
        "targets": targets,
        "gain": rng.uniform(0.5, 3.0, frames),
        "cap": np.where(rng.random(capped) < 0.5, rng.uniform(0.1, 2.0, capped), np.inf),
        "scale": scale,
        "task_support": scale[:, None] * rng.integers(0, 2, (rows, nv)),
        "results": gaps(results, 17) if views and pairs > 1 else results,
        "support": rng.integers(-1, 2, (pairs, nv)).astype(float),
        "twists": np.vstack((rng.normal(size=(obstacles, 6)), np.zeros(6))),
        "twist_row": rng.integers(0, obstacles + 1, pairs),
        "margin": np.append(rng.choice([0.0, 0.02, 0.1], obstacles), 0.0),
        "joint_poses": poses_of(rotations(rng, joints), rng.normal(size=(joints, 3)), 14 if views else 12),
        "parents": np.array([0, *(rng.integers(0, joint) for joint in range(1, joints))], dtype=np.intp),
        "column_joints": np.sort(rng.integers(1, joints, nv)),
        "joint_radius": rng.uniform(0.0, 0.5, joints),
        "moved_by": np.sort(rng.permuted(np.tile(np.arange(joints + obstacles), (pairs, 1)), axis=1)[:, :2], axis=1),
        "bodies": rng.integers(0, 6, (pairs, 2)),
        "body_poses": poses_of(rotations(rng, 6), rng.normal(size=(6, 3)), 14 if views else 12),
        "boxes": rng.uniform(0.02, 0.2, (6, 6)),
        "convex": rng.random(pairs) < 0.8,
        "chain_rotation": rng.integers(0, 2, (2, nv)).astype(float),
        "chain_translation": rng.integers(0, 2, (2, nv)).astype(float),
        "lever_arm": 0.8,
        "speeds": np.append(np.full(joints, np.nan), rng.uniform(0.0, 0.5, obstacles)),
        "q_index": limited + (0 if plain else 1),
        "v_index": limited,
        "q_lower": np.where(rng.random(len(limited)) < 0.2, -np.inf, q_lower),
        "q_upper": np.where(rng.random(len(limited)) < 0.2, np.inf, q_lower + rng.uniform(0.5, 3.0, len(limited))),
        "v_max": np.where(rng.random(nv) < 0.8, rng.uniform(0.1, 5.0, nv), np.inf),
        "v_step": v_step,
        "v_prev": rng.uniform(-5.0, 5.0, nv),
        "dv_prev": rng.uniform(-1.0, 1.0, nv) * np.minimum(v_step, 1.0),
        "acceleration_limited": bool(np.isfinite(v_step).any()),
        "damping": 0.1,
        "offset": 0.03,
    }
    return make_layout(nv, frames, turns, pairs, obstacles, joints, **{**random, **fields})


NO_LIMIT = {"v_step": np.full(7, np.inf), "acceleration_limited": False}


def jerk(seed, nv=7, all_of_them=False):
    """Limits of the jerk of some coordinates, or of all."""
    rng = np.random.default_rng(seed)
    step = rng.uniform(0.01, 0.5, nv)
    some = np.array([all_of_them, True])[(rng.random(nv) < 0.7).astype(int)]
    return {"v_step": step, "dv_step": np.where(some, 10.0 ** -rng.uniform(0.0, 2.0, nv) * step, np.inf),
            "dv_prev": rng.uniform(-1.0, 1.0, nv) * step, "acceleration_limited": True,
            "jerk_limited": True}  # fmt: skip


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
    within = np.where(pair_of >= 0, touching**2, -1.0)
    left = centers.copy()
    left[:bodies, [0, 1, 2, 4]] = np.nan  # to be overwritten
    found = np.full(len(combinations), -7)
    return [poses_of(R, p, columns), local, left, within, pair_of, found], expected, centers


def found_by(args):
    """The pairs that `candidates` gives; it leaves the rest of their array alone."""
    count, found = kernels.candidates(*args), args[-1]
    assert (found[count:] == -7).all()
    return found[:count].tolist()


@pytest.mark.parametrize("seed", SEEDS)
def test_candidates_are_the_pairs_whose_spheres_are_near(seed):
    args, expected, centers = spheres(seed)
    assert 0 < len(expected) < (args[4] >= 0).sum()
    assert found_by(args) == expected
    np.testing.assert_allclose(args[2], centers, rtol=0, atol=1e-14)


def test_candidates_none_one_and_all():
    assert found_by(spheres(0, size=0.0)[0]) == []
    args, _, _ = spheres(1)
    args[3][args[4] >= 0] = np.inf
    assert found_by(args) == list(range((args[4] >= 0).sum()))
    args, _, _ = spheres(1)
    args[4][:] = np.where(args[4] == 3, 0, -1)
    args[3][:] = np.where(args[4] >= 0, np.inf, -1.0)
    assert found_by(args) == [0]


def test_candidates_include_spheres_that_just_touch():
    """3-4-5 triangles: 25e-2 is within 25e-2 (1 + 1e-9), and not within 25e-2 (1 - 1e-9)."""
    world = np.array([[0.0, 0, 0], [0.3, 0.4, 0], [0, -0.3, 0.4], [0.4, 0, -0.3]])
    poses = poses_of(np.array([np.eye(3)] * 4), world)
    for sign, expected in ((1, [0, 1, 2]), (-1, [])):
        centers = np.hstack((world, np.ones((4, 1)), -np.sum(world**2, axis=1, keepdims=True)))
        within = np.array([[-1.0, *[0.25 * (1 + sign * 1e-9)] * 3]])
        pair_of, found = np.array([[-1, 0, 1, 2]]), np.full(3, -7)
        args = [poses, np.zeros((4, 3)), centers, within, pair_of, found]
        assert found_by(args) == expected


@pytest.mark.parametrize("seed", SEEDS)
def test_candidates_of_few_and_many_bodies(seed):
    for size in (0.0, 0.5, 1.0, 100.0):
        args, expected, _ = spheres(seed, bodies=1 + 3 * seed, geometries=2 + 8 * seed, size=size, columns=12 + seed)
        assert found_by(args) == expected


def test_sorted_setxor_is_the_symmetric_difference():
    rng = np.random.default_rng(0)
    for _ in range(100):
        a, b = (np.flatnonzero(rng.random(rng.integers(0, 30)) < rng.random()) for _ in range(2))
        assert kernels.sorted_setxor(a, b).tolist() == sorted({*a.tolist()} ^ {*b.tolist()})


# --- distances ---------------------------------------------------------------------------------------------------


def chosen(pairs, seed=0):
    """Some of the pairs."""
    return np.flatnonzero(np.random.default_rng(seed).random(pairs) < 0.7)


@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("seed", SEEDS)
def test_rate_of_a_distance_is_that_of_the_witness_points_along_the_normal(seed, moving):
    """ḋ = n·(ṗ_b - ṗ_a), each point carried by the joints that move its body, and by its obstacle."""
    x, pairs = random_layout(seed, pairs=40), chosen(40, seed)
    if not moving:
        x.twists[:] = 0.0
    k = run("distance_rows", x, pairs, 0.5, moving)
    expected = [i for i in pairs if x.results[i, 0] < 0.5]
    assert 0 < len(expected) < len(pairs) < 40
    assert x.near_pairs[:k].tolist() == expected
    np.testing.assert_array_equal(x.closest[:k], x.results[expected])
    for j, i in enumerate(expected):
        n, p = x.results[i, 1:4], x.results[i, 4:7]

        def speed(twist, n=n, p=p):
            return n @ (twist[:3] + np.cross(twist[3:], p))

        np.testing.assert_allclose(x.J[j], [speed(twist) for twist in x.J_world.T] * x.support[i], rtol=0, atol=1e-13)
        assert x.feedforward[j] == pytest.approx(speed(x.twists[x.twist_row[i]]), abs=1e-13)


def test_distance_rows_exclude_a_pair_at_the_influence_distance():
    results = np.random.default_rng(0).normal(size=(3, 10))
    results[:, 0] = 0.5, np.nextafter(0.5, 0.0), -0.5
    x = random_layout(0, pairs=3, results=gaps(results, 17))
    assert run("distance_rows", x, np.arange(3), 0.5, True) == 2
    assert x.near_pairs[:2].tolist() == [1, 2]


def test_distance_rows_include_a_nan_distance():
    """And no bound is made up for it: what is left is NaN, which no velocity meets."""
    results = np.random.default_rng(0).normal(size=(3, 10))
    results[:, 0] = 9.0, np.nan, 0.2
    for fields in (NO_LIMIT, {}):
        x = random_layout(0, pairs=3, results=gaps(results, 17), **fields)
        k, worst, clear, _ = run("assemble", x, np.zeros(8), np.arange(3), 0.5, True)
        assert x.near_pairs[:k].tolist() == [1, 2]
        assert np.isnan(x.rhs[:k]).tolist() == [True, False] and np.isnan(worst) and not clear


@pytest.mark.parametrize("views", [True, False])
def test_no_pair_near(views):
    x = random_layout(0, views=views)
    assert run("distance_rows", x, np.arange(9), -np.inf, True) == 0
    assert run("distance_rows", x, np.arange(0), np.inf, True) == 0


def test_distance_rows_have_no_feedforward_of_an_obstacle_at_rest():
    x = random_layout(0)
    packed = kernels.pack(x)
    drifts = []
    for moving in (False, True, False):
        x.twists[:-1] = float(moving)
        assert kernels.distance_rows(packed, np.arange(9), np.inf, moving) == 9
        drifts.append(np.abs(x.feedforward).max())
    assert drifts[0] == drifts[2] == 0.0 < drifts[1]


@pytest.mark.parametrize("views", [True, False])
@pytest.mark.parametrize("pairs", [0, 1, 2, 50])
def test_distance_rows_by_their_definition(pairs, views):
    for seed in SEEDS:
        for among, reach in ((chosen(pairs, seed), 0.5), (np.arange(pairs), np.inf), (np.arange(pairs), 0.0)):
            x = random_layout(seed, pairs=pairs, nv=2 + seed, views=views)
            k = run("distance_rows", x, among, reach, True)
            near, J, feedforward = oracle.distance_rows(x, among, reach)
            np.testing.assert_array_equal(x.near_pairs[:k], near)
            np.testing.assert_allclose(x.J[:k], J, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(x.feedforward[:k], feedforward, rtol=1e-12, atol=1e-12)


# --- bounds of rows ----------------------------------------------------------------------------------------------


def rows_at(d, **fields):
    """Memory in which rows of all pairs are made, at distances d."""
    count = len(d)
    closest = np.zeros((count, 10))
    closest[:, 0] = d
    given = {
        "closest": closest,
        "near_pairs": np.arange(count),
        "feedforward": np.zeros(count),
        "J": np.ones((count, 7)),
    }
    bounds = {"lower": np.full(7, -np.inf), "upper": np.full(7, np.inf), "v_stop": np.zeros(7)}
    return make_layout(7, pairs=count, obstacles=2, **{**given, **bounds, **fields})


@pytest.mark.parametrize("weighted", [True, False])
def test_closing_speed_bound_by_its_definition(weighted):
    """-(1 - β) ξ (d - d1) outside d1, ξ (d1 - d) up to the cap inside it; d = d1 and d = d2 exactly as well."""
    d1, d2, gain = 0.1, 0.3, 5.0
    d = np.array([-1.0, 0.05, 0.08, d1, 0.15, 0.2, d2, 0.5])
    beta = np.array([1.0, 1.0, 1.0, 1.0, 0.5 + 0.25 * np.sqrt(2.0), 0.5, 0.0, 0.0])
    for cap in (0.2, np.inf):
        raw = gain * (d1 - d)
        expected = np.minimum(np.where(raw > 0.0, raw, (1.0 - beta) * raw) if weighted else raw, cap)
        x = rows_at(d, row_gain=gain, recovery_speed=cap, beta=weighted)
        run("row_bounds", x, len(d), False)
        np.testing.assert_allclose(x.rhs, expected, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(x.d, d)


def test_row_bounds_with_offset_margin_and_feedforward():
    """The offset widens all distances, the margin of an obstacle narrows those to it, its drift counts as motion."""
    closest, margin, of = np.array([0.20, 0.20, 0.20, 0.02]), np.array([0.01, 0.04, 0.0]), np.array([0, 1, 2, 1])
    feedforward = np.array([0.1, -0.2, 0.0, 0.3])
    x = rows_at(closest, offset=0.05, margin=margin, twist_row=of, feedforward=feedforward, beta=False)
    run("row_bounds", x, 4, True)
    np.testing.assert_allclose(x.d, [0.24, 0.21, 0.25, 0.03], rtol=0, atol=1e-15)
    np.testing.assert_allclose(x.rhs, [-0.7 - 0.1, -0.55 + 0.2, -0.75, 0.2 - 0.3], rtol=0, atol=1e-14)


def test_slack_moves_the_safety_distance_of_a_pair():
    """A pair with slack s has the row of one that is s farther away, but touches where it touches."""
    d, slack = np.array([0.02, 0.06, 0.2]), np.array([0.09, 0.0, 0.05])
    fields = {"offset": 0.01, "beta": False, "row_gain": 5.0, "safety_distance": 0.1}
    x, y = rows_at(d, distance_allowance=slack, **fields), rows_at(d + slack, **fields)
    z = rows_at(d, **fields)
    for layout in (x, y, z):
        run("row_bounds", layout, 3, False)
    np.testing.assert_allclose(x.d, y.d, rtol=0, atol=1e-15)
    np.testing.assert_allclose(x.rhs, y.rhs, rtol=0, atol=1e-15)
    np.testing.assert_allclose(x.rhs_contact, np.minimum(5.0 * (0.0 - d), x.rhs), rtol=0, atol=1e-14)
    assert x.rhs[0] < z.rhs[0] and x.rhs[1] == z.rhs[1]


def test_margins_are_those_of_the_near_pairs():
    """Row i belongs to pair near[i], not to pair i."""
    x = rows_at(np.full(2, 0.2), beta=False)
    y = make_layout(7, pairs=4, obstacles=2, **{
        **{name: np.concatenate((getattr(x, name),) * 2) for name in ("closest", "feedforward", "J")},
        "near_pairs": np.array([1, 3, -1, -1]), "twist_row": np.array([0, 1, 0, 2]),
        "margin": np.array([9.0, 0.05, 0.0]),
        "lower": x.lower, "upper": x.upper, "v_stop": x.v_stop, "beta": False,
    })  # fmt: skip
    run("row_bounds", y, 2, True)
    np.testing.assert_allclose(y.d[:2], [0.15, 0.2], rtol=0, atol=1e-15)


def filled(seed, pairs=30, **fields):
    """Memory with all that `row_bounds` reads."""
    x = random_layout(seed, pairs=pairs, **fields)
    packed = kernels.pack(x)
    kernels.velocity_bounds(packed, np.random.default_rng(seed).uniform(-3, 3, 8))
    kernels.stop_velocity(packed)
    assert kernels.distance_rows(packed, np.arange(pairs), np.inf, True) == pairs
    return x


def largest(row, lower, upper):
    """Largest J v within bounds, coordinate by coordinate."""
    return sum(max(a * low, a * high) for a, low, high in zip(row, lower, upper, strict=True) if a != 0.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_row_bounds_are_feasible(seed):
    """To part at most as fast as the bounds allow; not to close no sooner than a stop would end it."""
    x = filled(seed)
    run("row_bounds", x, 30, True)
    parting, receding = x.d < x.safety_distance, x.feedforward >= 0.0
    assert x.acceleration_limited and (parting & receding).any() and (~parting & receding).any()
    assert (x.J @ x.v_stop >= x.rhs - 1e-9)[~parting & receding].all()
    most = np.array([largest(row, x.lower, x.upper) for row in x.J])
    assert (most >= x.rhs - 1e-9)[parting & receding].all()
    assert (np.maximum(most, -x.feedforward) >= x.rhs - 1e-9)[parting].all()


@pytest.mark.parametrize("seed", SEEDS)
def test_row_bounds_by_their_definition(seed):
    """The beta row, closing at half of the accelerations at most, less the feed-forward; rhs_contact at d = 0."""
    x = filled(seed)
    run("row_bounds", x, 30, True)
    raw = x.row_gain * (x.safety_distance - x.d)
    weight = 0.5 - 0.5 * np.cos(np.pi * np.clip((x.d - x.d1) / (x.d2 - x.d1), 0.0, 1.0))
    for i in range(30):
        J, feedforward = x.J[i], x.feedforward[i]
        if raw[i] > 0.0:
            most = largest(J, x.lower, x.upper)
            expected = min(
                min(raw[i], x.recovery_speed) - feedforward, most if feedforward >= 0.0 else max(most, -feedforward)
            )
        else:
            half = 0.25 * np.sum(np.abs(J[J != 0.0]) * x.v_step[J != 0.0])
            brake = (
                half - np.sqrt(half**2 + 4.0 * half * (x.d[i] - x.safety_distance) / x.dt) if half < np.inf else -np.inf
            )
            expected = max(weight[i] * raw[i], brake) - feedforward
            expected = expected if feedforward < 0.0 else min(expected, J @ x.v_stop)
        assert x.rhs[i] == pytest.approx(expected, rel=1e-12, abs=1e-13)
        assert x.rhs_contact[i] == pytest.approx(
            min(x.row_gain * (x.offset - x.d[i]) - feedforward, expected), rel=1e-12, abs=1e-13
        )


def test_row_bounds_brake_a_pair_at_the_safety_distance():
    """Each tick closes as fast as its row allows, slowed by half of the acceleration, at the end by a bit more."""
    step, d, v = np.array([0.1, 0.2]), np.array([0.9]), 0.0
    way = []
    for _ in range(400):
        x = rows_at(
            d, J=np.array([[0.5, -1.0]]), v_step=step, acceleration_limited=True, v_stop=np.array([0.0, -1e3]),
            beta=False, row_gain=100.0, lower=-np.ones(2), upper=np.ones(2),
        )  # fmt: skip
        run("row_bounds", x, 1, False)
        slower = x.rhs[0] - v
        v = x.rhs[0]
        d = d + x.dt * v
        way.append((d[0], slower))
    distances, changes = np.array(way[1:]).T
    half = 0.5 * (0.05 + 0.2)
    assert (changes[:-1] <= 1.25 * half).all() and np.isclose(changes, half).sum() > 25
    assert distances.min() >= x.safety_distance - 1e-9 and distances[-1] == pytest.approx(x.safety_distance, abs=1e-3)


RATES = np.zeros(7)
"""Velocity of a robot at rest: its paths have no curvature."""


# --- looking ahead -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_joint_speeds_bound_the_speed_of_every_point(seed):
    """Nor is the bound a loose one: at most √2 too large, and exact for a joint that does not turn."""
    rng, x = np.random.default_rng(seed), filled(seed)
    v = rng.normal(size=7)
    run("joint_speeds", x, v)
    twists = np.zeros((4, 6))
    for joint in range(1, 4):
        own = x.column_joints == joint
        twists[joint] = twists[x.parents[joint]] + x.J_world[:, own] @ v[own]
    for twist, pose, reach, speed in zip(twists, x.joint_poses, x.joint_radius, x.speeds[:4], strict=True):
        points = rng.normal(size=(2000, 3))
        points *= reach / np.linalg.norm(points, axis=1, keepdims=True)
        speeds = np.linalg.norm(twist[:3] + np.cross(twist[3:], pose[9:] + points), axis=1)
        assert speeds.max() <= speed <= 1.01 * np.sqrt(2.0) * speeds.max()
    J = np.asfortranarray(np.vstack((x.J_world[:3], np.zeros((3, 7)))))
    y = x._replace(J_world=J)
    run("joint_speeds", y, v)
    np.testing.assert_allclose(y.speeds[:4], np.linalg.norm(twists[:, :3], axis=1), rtol=1e-13)


def test_joint_speeds_with_mimic_joints():
    """One coordinate moves several columns of the Jacobian: as many as have its number."""
    for seed in SEEDS:
        rng, x = np.random.default_rng(seed), filled(seed)
        columns, v = np.append(np.arange(5), [1, 3]), rng.normal(size=5)
        run("joint_speeds", x, v[columns])
        y = random_layout(seed, pairs=30, columns=columns, has_mimics=True)
        run("joint_speeds", y, v)
        np.testing.assert_allclose(y.speeds[:4], x.speeds[:4], rtol=1e-12)


@pytest.mark.parametrize("near", [0, 1, 30])
@pytest.mark.parametrize("horizon", [0.0, 0.01, 0.1])
def test_clearance_lower_bound_with_the_fastest_points(near, horizon):
    """Of the near pairs at their own distances, of all others at the influence distance, less the curvature."""
    for seed in SEEDS:
        x = filled(seed, convex=np.zeros(30, dtype=bool))
        rates = np.random.default_rng(seed).uniform(-1.0, 1.0, x.A.shape[1])
        turning, sliding = ((chain @ np.abs(rates)).max() for chain in (x.chain_rotation, x.chain_translation))
        bend = horizon**2 * (turning**2 * x.lever_arm + 2.0 * turning * sliding)
        x.d[:] = np.random.default_rng(seed).uniform(0.05, 0.5, 30)
        found = run("clearance_lower_bound", x, rates, near, 0.5, horizon)
        left = [x.d[i] - x.safety_distance - horizon * x.speeds[x.moved_by[i]].sum() for i in range(near)]
        others = 0.5 + x.offset - x.safety_distance - horizon * (x.speeds[:4].max() + x.speeds.max())
        exact = min([others, *left]) - bend
        assert found <= exact + 1e-14 and (found > 0.0) == (exact > 0.0)
        assert exact > 0.0 or found == pytest.approx(exact, abs=1e-14)


def closing_along_normal(x, v, i, horizon, bend):
    """Closing distance of a near pair along its normal: the witness points, and the farthest corner of each box."""
    pair, found = x.near_pairs[i], x.closest[i]
    n, approach, bent = found[1:4], x.J[i] @ v, 0.0
    closing = (abs(approach) if x.jerk_limited else max(-approach, 0.0)) + max(-x.feedforward[i], 0.0)
    for side, sign in ((0, 1.0), (1, -1.0)):
        carrier, body = x.moved_by[pair, side], x.bodies[pair, side]
        spin = np.vstack((x.omega, x.twists[:, 3:]))[carrier]
        R, p = x.body_poses[body, :9].reshape(3, 3).T, x.body_poses[body, 9:]
        center, half = np.split(x.boxes[body], 2)
        signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
        corners = (center + signs * half) @ R.T + p
        speeds = np.cross(spin, corners - found[4 + 3 * side : 7 + 3 * side])
        closing += max((sign * speeds @ n).max(), 0.0)
        bent += 0.5 * horizon**2 * np.linalg.norm(spin) * x.speeds[carrier] if carrier >= 4 else 0.5 * bend
    return horizon * closing + bent


@pytest.mark.parametrize("fields", [{}, {"jerk_limited": True}, {"views": False}])
@pytest.mark.parametrize("horizon", [0.01, 0.1])
def test_clearance_lower_bound_of_convex_bodies_along_the_normal(horizon, fields):
    """Where the fastest points would use up a distance, it may be that they go another way."""
    better = 0
    for seed in range(20):
        x = filled(seed, **fields)
        v = np.random.default_rng(seed).uniform(-0.3, 0.3, 7)
        turning, sliding = ((chain @ np.abs(v)).max() for chain in (x.chain_rotation, x.chain_translation))
        bend = horizon**2 * (turning**2 * x.lever_arm + 2.0 * turning * sliding)
        x.d[:] = x.safety_distance + horizon * np.random.default_rng(seed).uniform(0.0, 2.0, 30)
        found = run("clearance_lower_bound", x, v, 30, 9.0, horizon)
        least = np.inf
        for i in range(30):
            fastest = left = x.d[i] - x.safety_distance - horizon * x.speeds[x.moved_by[x.near_pairs[i]]].sum() - bend
            if left <= 0.0 and x.convex[x.near_pairs[i]]:
                left = max(left, x.d[i] - x.safety_distance - closing_along_normal(x, v, i, horizon, bend))
            better += left > fastest
            least = min(least, left)
        assert found == pytest.approx(least, rel=1e-12, abs=1e-13)
    assert better > 20


def test_leaves_position_limits_by_hand():
    """Coordinate 1 of v is number 2 of q: 0.5 rad/s for 0.3 s is 0.15 rad; 0.1 rad of room are left on either side."""
    x = make_layout(3, q_index=np.array([2]), v_index=np.array([1]), q_lower=np.array([-0.1]), q_upper=np.array([0.1]))
    q = np.array([9.0, 9.0, 0.0, 9.0])
    for v, horizon, bent in ((0.5, 0.3, True), (-0.5, 0.3, True), (0.5, 0.19, False), (-0.5, 0.19, False)):
        assert run("leaves_position_limits", x, q, np.array([9.0, v, 9.0]), horizon) == bent


@pytest.mark.parametrize("near", [0, 1, 30])
def test_clearance_lower_bound_preserves_nan(near):
    for column in range(7):
        x = filled(0)
        x.J_world[column % 6, column] = np.nan
        x.d[:] = 0.2
        assert np.isnan(run("clearance_lower_bound", x, np.ones(7), near, 0.5, 0.1))
    for i in range(near):
        x = filled(0)
        x.d[:] = 0.2
        x.d[i] = np.nan
        assert np.isnan(run("clearance_lower_bound", x, RATES, near, 0.5, 0.1))


@pytest.mark.parametrize("fields", [{}, NO_LIMIT])
def test_is_tracking_clear_by_the_clearance_bound_until_its_stop(fields):
    clear = 0
    for seed in range(40):
        x = filled(seed, 30, **fields)
        x.v_tracking[:] = 10.0 ** -(seed % 4) * np.random.default_rng(seed).normal(size=7)
        x.d[:] = np.random.default_rng(seed).uniform(0.1, 0.5, 30)
        ticks = 1.0 + 0.5 * np.max(np.abs(x.v_tracking) / x.v_step)
        q = np.random.default_rng(seed).uniform(-1.0, 1.0, 8)
        expected = run("clearance_lower_bound", x, x.v_tracking, 30, 0.5, x.dt * ticks) > -2e-4
        expected &= not (x.acceleration_limited and run("leaves_position_limits", x, q, x.v_tracking, x.dt * ticks))
        assert run("is_tracking_clear", x, q, 30, 0.5) == expected
        clear += expected
    assert 0 < clear < 40


@pytest.mark.parametrize("fields", [{}, {"jerk_limited": True}, {"views": False}])
@pytest.mark.parametrize("near", [0, 1, 30])
def test_clearance_lower_bound_by_its_definition(near, fields):
    """From far below to far above nothing left, with rates at which the ways of points curve."""
    left = []
    for seed in range(20):
        x, rng = filled(seed, **fields), np.random.default_rng(seed)
        x.d[:] = x.safety_distance + rng.uniform(0.0, 0.5, 30)
        v, horizon = rng.uniform(-0.5, 0.5, 7), 10.0 ** rng.uniform(-3.0, -0.5)
        left.append(oracle.clearance_lower_bound(x, v, near, 0.8, horizon))
        assert run("clearance_lower_bound", x, v, near, 0.8, horizon) == pytest.approx(left[-1], rel=1e-12, abs=1e-13)
        twists = oracle.joint_twists(x, v)
        np.testing.assert_allclose(x.omega, twists[:, 3:], rtol=1e-12, atol=1e-12)
    assert min(left) < 0.0 < max(left)


# --- frames ------------------------------------------------------------------------------------------------------

FRAMES = [(1, []), (1, [0]), (2, [1]), (4, []), (4, [0, 2]), (4, [0, 1, 2, 3])]


@pytest.mark.parametrize(("count", "turns"), FRAMES)
def test_frame_rows_by_their_definition(count, turns):
    """Velocity of a point p of a body: J_v + J_ω × p; b = v_ref + K (x_ref - x), with log(R_ref Rᵀ) for turns.

    A command faster than its cap is shortened to it; then everything is scaled.
    """
    x = random_layout(count, frames=count, turns=turns)
    expected_A, expected_b = [], []
    for f, pose in enumerate(x.frame_poses[x.frame_ids]):
        expected_A += list(x.J_world[:3] + np.array([np.cross(twist[3:], pose[9:]) for twist in x.J_world.T]).T)
        expected_b += [x.targets[f, 12:15] + x.gain[f] * (x.targets[f, 9:12] - pose[9:])]
    for f in turns:
        R = x.frame_poses[x.frame_ids[f], :9].reshape(3, 3).T
        expected_A += list(x.J_world[3:])
        expected_b += [x.targets[f, 15:] + x.gain[f] * pin.log3(x.targets[f, :9].reshape(3, 3).T @ R.T)]
    expected_b = [b * min(1.0, cap / np.linalg.norm(b)) for b, cap in zip(expected_b, x.cap, strict=True)]
    packed = kernels.pack(x)
    for _ in range(2):  # what the first call leaves in `row_wrenches` does not show in the second
        kernels.frame_rows(packed)
        np.testing.assert_allclose(x.A, np.array(expected_A) * x.task_support, rtol=0, atol=1e-13)
        np.testing.assert_allclose(x.b, np.concatenate(expected_b) * x.scale, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(x.poses, x.frame_poses[x.frame_ids])


def test_frame_rows_at_the_edges_of_caps():
    """A command at rest stays at rest, one just at its cap is left alone, and NaN is not capped away."""
    for speed, expected in ((0.0, 0.0), (0.5, 0.5), (2.0, 0.5), (np.nan, np.nan)):
        targets = np.zeros((1, 18))
        targets[0, :9] = np.eye(3).ravel()
        targets[0, 12] = speed
        x = make_layout(7, frames=1, targets=targets, frame_poses=np.zeros((1, 12)), cap=np.array([0.5]))
        run("frame_rows", x)
        np.testing.assert_allclose(x.b[0], expected, rtol=1e-15)


AXES = [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 0), (1, -2, 3), (-3, 1e-9, 1e-5)]


@pytest.mark.parametrize("seed", SEEDS)
def test_rows_add_up_the_columns_of_a_mimicked_joint(seed):
    """Against rows of a robot whose joints all move on their own."""
    columns = np.array([0, 1, 2, 2, 3, 4, 5, 1, 6])
    fold = np.eye(7)[columns]
    alone = random_layout(seed, nv=9, plain=True)
    own = {f: getattr(random_layout(seed, nv=7), f) for f in ("q_index", "v_index", "q_lower", "q_upper", "v_max")}
    shared = {
        f: getattr(alone, f)
        for f in ("J_world", "task_support", "support", "targets", "frame_poses", "frame_ids", "gain", "cap", "scale",
                  "results", "twists", "twist_row", "margin")
    }  # fmt: skip

    x = random_layout(seed, nv=7, columns=columns, has_mimics=True, unfolded_row=np.zeros(9), **{**own, **shared})
    for layout in (alone, x):
        run("frame_rows", layout)
    np.testing.assert_allclose(x.A, alone.A @ fold, atol=1e-12)
    k = run("distance_rows", alone, np.arange(9), 0.5, True)
    assert run("distance_rows", x, np.arange(9), 0.5, True) == k > 0
    np.testing.assert_allclose(x.J[:k], alone.J[:k] @ fold, atol=1e-12)
    np.testing.assert_allclose(x.J[:k], oracle.distance_rows(x, np.arange(9), 0.5)[1], atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_frame_rows_of_orientations_alone_keep_other_rows(seed):
    """Of three frames the last one only turns; three rows after those of the frames are left as they are."""
    whole = random_layout(seed, frames=3, turns=(0, 2))
    kept = np.r_[0:6, 9:15]

    parts = {f: getattr(whole, f)[kept].copy() for f in ("scale", "task_support", "row_wrenches")}
    outputs = {"A": np.full((15, 7), 5.0), "b": np.full(15, 6.0)}
    x = random_layout(seed, frames=3, turns=(0, 2), cap=np.delete(whole.cap, 2), **parts, **outputs)
    run("frame_rows", x)
    run("frame_rows", whole)
    np.testing.assert_allclose(x.A[:12], whole.A[kept], atol=1e-12)
    np.testing.assert_allclose(x.b[:12], whole.b[kept], atol=1e-12)
    assert (x.A[12:] == 5.0).all() and (x.b[12:] == 6.0).all()


@pytest.mark.parametrize("rotation_vector", [kernels.rotation_vector, compiled(kernels.rotation_vector)])
@pytest.mark.parametrize("axis", AXES)
def test_rotation_vector_at_all_angles(axis, rotation_vector):
    """Angle and axis come back, in tiny turns to the last digit; at half a turn either of the two axes."""
    axis = np.array(axis) / np.linalg.norm(axis)
    for angle in (0.0, 1e-15, 1e-12, 1e-9, 1e-5, 0.1, 1.0, np.pi / 2, 2.0, 2.1, 3.0, np.pi - 1e-5, np.pi - 1e-9):
        found = rotation_vector(pin.exp3(angle * axis))
        np.testing.assert_allclose(found, angle * axis, rtol=0, atol=1e-15 + 1e-14 * angle / (np.pi - angle) ** 0.1)
    half = 2.0 * np.outer(axis, axis) - np.eye(3)
    found = np.array(rotation_vector(half))
    assert np.linalg.norm(found) == pytest.approx(np.pi, abs=1e-12)
    assert abs(found @ axis) == pytest.approx(np.pi, abs=1e-12)


# --- joint limits ------------------------------------------------------------------------------------------------


def test_velocity_bounds_by_hand():
    """dt = 0.01 s and half of what is left: 50 (q_lim - q), but not beyond v_max = 2, 3, 4, ∞, ∞ and 5.

    In turn: room on both sides; 0.01 rad below the upper limit; 0.02 rad beyond it; no position limit; no speed
    limit; far below the lower limit, which returns at full speed.
    """
    inf = np.inf
    q = np.array([9.0, 0.0, 0.99, 1.02, 9.0, 9.0, 0.3, -4.0])  # q[0], q[4] and q[5] have no limits in this chart
    x = make_layout(
        6, q_index=np.array([1, 2, 3, 6, 7]), v_index=np.array([0, 1, 2, 4, 5]),
        q_lower=np.array([-1.0, -1, -1, -inf, -1]), q_upper=np.array([1.0, 1, 1, 1, 1]),
        v_max=np.array([2.0, 3.0, 4.0, inf, inf, 5.0]), position_rate=50.0,
    )  # fmt: skip
    assert run("velocity_bounds", x, q) == -3.0
    np.testing.assert_allclose(x.lower, [-2.0, -3.0, -4.0, -inf, -inf, 5.0])
    np.testing.assert_allclose(x.upper, [2.0, 0.5, -1.0, inf, 35.0, 5.0])


@pytest.mark.parametrize("plain", [True, False])
@pytest.mark.parametrize("seed", SEEDS)
def test_velocity_bounds_by_their_definition(seed, plain):
    """They never cross, and those with acceleration limits are never outside those without, from any state."""
    for nv in (2, 5, 30):
        q = np.random.default_rng(seed).uniform(-3, 3, nv + 1)
        for fields in (
            {},
            {"v_step": np.full(nv, np.inf), "acceleration_limited": False},
            jerk(seed, nv),
            jerk(seed, nv, True),
        ):
            x = random_layout(seed, nv=nv, plain=plain, **fields)
            names = "v_max", "v_step", "v_prev", "dv_step", "dv_prev", "acceleration_limited", "jerk_limited"
            without = make_layout(nv, **{name: getattr(x, name) for name in names})
            for layout, at in ((x, q[:nv] if plain else q), (without, q)):
                *expected, room = oracle.velocity_bounds(layout, at)
                assert run("velocity_bounds", layout, at) == pytest.approx(room)
                found = layout.hard_lower, layout.hard_upper, layout.lower, layout.upper
                if not layout.acceleration_limited:
                    expected[:2] = expected[2:]
                np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
            assert (x.hard_lower <= x.lower).all() and (x.lower <= x.upper).all() and (x.upper <= x.hard_upper).all()
            assert (np.maximum(np.abs(x.lower), np.abs(x.upper)) <= x.v_max).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_stop_velocity_is_the_fastest_by_one_factor(seed):
    """v_stop = s v_prev, the largest change being exactly one step of its coordinate; 0 once that is possible."""
    x = random_layout(seed, plain=True)
    x.lower[:], x.upper[:] = -np.inf, np.inf
    run("stop_velocity", x)
    share = x.v_stop / x.v_prev
    np.testing.assert_allclose(share, share[0], rtol=1e-13)
    assert 0.0 < share[0] < 1.0
    assert np.max(np.abs(x.v_prev - x.v_stop) / x.v_step) == pytest.approx(1.0, rel=1e-12)
    y = random_layout(seed, plain=True, v_prev=0.5 * np.minimum(x.v_step, 1.0))
    y.lower[:], y.upper[:] = -np.inf, np.inf
    y.lower[1], y.upper[2] = 0.2, -0.3  # a coordinate that returns to its limits goes on moving
    run("stop_velocity", y)
    np.testing.assert_array_equal(y.v_stop, [0.0, 0.2, -0.3, 0.0, 0.0, 0.0, 0.0])


def test_stop_velocity_without_acceleration_limits_is_a_standstill():
    x = random_layout(0, **NO_LIMIT)
    x.lower[:], x.upper[:] = -1.0, 1.0
    x.lower[1], x.upper[2] = 0.2, -0.3
    run("stop_velocity", x)
    np.testing.assert_array_equal(x.v_stop, [0.0, 0.2, -0.3, 0.0, 0.0, 0.0, 0.0])


# --- solutions ---------------------------------------------------------------------------------------------------


def rows(seed, count, nv=14, damping=0.1):
    """Memory with random task rows."""
    rng = np.random.default_rng(seed)
    x = make_layout(nv, frames=count // 3, damping=damping)
    x.A[:], x.b[:] = rng.normal(size=(count, nv)), rng.normal(size=count)
    return x


def damped_solution(x):
    v = np.full(x.A.shape[1], 9.0)
    run("damped_solution", x, v)
    return v


@pytest.mark.parametrize("damping", [0.0, 0.01, 0.5])
@pytest.mark.parametrize("count", [0, 3, 6, 9])
def test_damped_solution_by_singular_values(count, damping):
    """Each singular value s becomes s / (s² + λ²)."""
    for seed in SEEDS:
        x = rows(seed, count, damping=damping)
        U, s, Vt = np.linalg.svd(x.A, full_matrices=False)
        expected = Vt.T @ (s / (s**2 + damping**2) * (U.T @ x.b))
        np.testing.assert_allclose(damped_solution(x), expected, rtol=0, atol=1e-12)


def test_damped_solution_minimises_error_and_effort():
    """More rows than joints, and repeated ones: ‖A v - b‖² + λ² ‖v‖² is stationary."""
    for count, nv in ((9, 7), (6, 3)):
        x = rows(0, count, nv)
        x.A[-1], x.b[-1] = x.A[0], 1.0 - x.b[0]
        v = damped_solution(x)
        np.testing.assert_allclose(x.A.T @ (x.A @ v - x.b) + 0.01 * v, 0.0, rtol=0, atol=1e-11)


@pytest.mark.parametrize("shrink", [0.0, 1e-12, 1e-8, 1e-4])
@pytest.mark.parametrize("which", [0, 1, -1])
def test_damped_solution_of_nearly_dependent_rows_is_nan(shrink, which):
    """Pivots of A Aᵀ that differ by more than 1e6; with damping there always is a solution."""
    for count in (3, 6, 9):
        for damping in (0.0, 0.1):
            x = rows(count, count, damping=damping)
            x.A[which] = shrink * x.A[which] + x.A[which - 1]
            v = damped_solution(x)
            assert np.isfinite(v).all() if damping else np.isnan(v).all()
    for third, solvable in ((1e-2, True), (1e-4, False)):
        x = rows(0, 3, damping=0.0)
        x.A[:], x.b[:] = np.diag([1.0, 1.0, third]) @ np.eye(3, 14), 1.0
        v = damped_solution(x)
        assert np.isfinite(v).all() if solvable else np.isnan(v).all()


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_damped_solution_preserves_nan(damping):
    for count in (3, 6):
        for i in range(count):
            x = rows(0, count, damping=damping)
            x.b[i] = np.nan
            assert np.isnan(damped_solution(x)).all()
            x = rows(0, count, damping=damping)
            x.A[i, 5] = np.nan
            assert np.isnan(damped_solution(x)).all()


def constraints(seed, pairs, nv=7):
    rng = np.random.default_rng(seed)
    lower, upper = -rng.uniform(0.5, 3.0, nv), rng.uniform(0.5, 3.0, nv)
    return [rng.normal(size=nv), rng.normal(size=(pairs, nv)), rng.normal(size=pairs), lower, upper]


@pytest.mark.parametrize("pairs", [0, 1, 20])
def test_violation_is_the_largest_of_rows_and_bounds(pairs):
    for seed in SEEDS:
        v, J, b, lower, upper = args = constraints(seed, pairs)
        upper[2] = np.inf
        lower[3] = -np.inf
        violations = [b[k] - J[k] @ v for k in range(pairs)]
        violations += [v[i] - upper[i] for i in range(7)] + [lower[i] - v[i] for i in range(7)]
        assert kernels.violation(*args) == pytest.approx(max(violations), abs=1e-13)
    v, J = np.zeros(7), np.ones((pairs, 7))
    assert kernels.violation(v, J, np.full(pairs, -9.0), np.full(7, -1.0), np.full(7, 2.0)) == -1.0
    assert kernels.violation(v, J, np.full(pairs, -9.0), np.full(7, -np.inf), np.full(7, np.inf)) == (
        -9.0 if pairs else -np.inf
    )


@pytest.mark.parametrize("pairs", [0, 1, 20])
@pytest.mark.parametrize("argument", ["v", "J", "b", "lower", "upper"])
def test_violation_preserves_nan(argument, pairs):
    """Wherever it stands: in the first, a middle or the last entry."""
    index = ["v", "J", "b", "lower", "upper"].index(argument)
    for place in (0, -1, 3):
        args = constraints(0, pairs)
        flat = args[index].reshape(-1)
        if not -len(flat) <= place < len(flat):
            continue
        flat[place] = np.nan
        assert np.isnan(kernels.violation(*args)), place


@pytest.mark.parametrize("near", [0, 1, 5])
def test_tracking_violation_is_that_of_the_near_rows(near):
    for seed in SEEDS:
        v, J, least, lower, upper = constraints(seed, 8)

        def make(v=v, J=J, rhs=least, lower=lower, upper=upper):
            return make_layout(7, pairs=8, v_tracking=v, J=J, rhs=rhs, lower=lower, upper=upper)._replace(
                lower=lower, upper=upper
            )

        expected = kernels.violation(v, J[:near], least[:near], lower, upper)
        assert run("tracking_violation", make(), near) == pytest.approx(expected, abs=1e-15)
        v[3] = np.nan
        assert np.isnan(run("tracking_violation", make(), near))


@pytest.mark.parametrize("count", [3, 6, 9])
def test_projection_cost_is_smallest_at_the_velocity_it_is_made_for(count):
    """½ vᵀP v + qᵀv + const = ½ ‖A (v - v0)‖² + ½ λ ‖v - v0‖²."""
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        A, v_tracking = rng.normal(size=(count, 7)), rng.normal(size=7)
        P, q = kernels.projection_cost(A, 1e-3, v_tracking)
        np.testing.assert_array_equal(P, P.T)
        np.testing.assert_allclose(np.linalg.solve(P, -q), v_tracking, rtol=0, atol=1e-10)
        for v in rng.normal(size=(5, 7)):
            found = 0.5 * v @ P @ v + q @ v - (0.5 * v_tracking @ P @ v_tracking + q @ v_tracking)
            expected = 0.5 * np.sum((A @ (v - v_tracking)) ** 2) + 0.5e-3 * np.sum((v - v_tracking) ** 2)
            assert found == pytest.approx(expected, abs=1e-11)


# --- whole ticks -------------------------------------------------------------------------------------------------


def moments(seed, x, ticks=6):
    """Arguments of `assemble` in a row of ticks: pairs come and go, obstacles move and rest."""
    rng, pairs = np.random.default_rng(seed), len(x.results)
    for tick in range(ticks):
        q = rng.uniform(-3, 3, x.A.shape[1] + 1)
        chosen = [np.arange(pairs), np.flatnonzero(rng.random(pairs) < 0.5), np.arange(0)][tick % 3]
        yield q, chosen, float(rng.choice([0.0, 0.3, np.inf])), tick % 2 == 0


@pytest.mark.parametrize("fields", [{}, NO_LIMIT, {"plain": True}, {"views": False, "damping": 0.0}])
@pytest.mark.parametrize("seed", SEEDS)
def test_assemble_is_the_sum_of_its_parts(seed, fields):
    """Whatever the ticks before have left in memory."""
    x = random_layout(seed, pairs=40, **fields)
    packed = kernels.pack(x)
    for q, pairs, reach, moving in moments(seed, x):
        y = random_layout(seed, pairs=40, **fields)
        x.v_prev[:] = y.v_prev[:] = np.random.default_rng(seed).uniform(-1, 1, 7)
        x.margin[:-1] = y.margin[:-1] = 0.05 * moving
        apart = kernels.pack(y)
        kernels.frame_rows(apart)
        room = kernels.velocity_bounds(apart, q[:7] if "plain" in fields else q)
        kernels.stop_velocity(apart)
        kernels.damped_solution(apart, y.v_tracking)
        k = kernels.distance_rows(apart, pairs, reach, moving)
        kernels.row_bounds(apart, k, moving)
        worst = kernels.tracking_violation(apart, k)
        found = kernels.assemble(packed, q[:7] if "plain" in fields else q, pairs, reach, moving)
        clear = worst <= 0.0 and kernels.is_tracking_clear(apart, q[:7] if "plain" in fields else q, k, reach)
        np.testing.assert_array_equal(found, (k, worst, clear, room))
        assert_same(x, y, k)


@pytest.mark.parametrize("fields", [{}, NO_LIMIT, {"plain": True}, {"views": False}])
@pytest.mark.parametrize("seed", SEEDS)
def test_assemble_tracking_velocity_is_optimal(seed, fields):
    counts = []
    for q, pairs, reach, moving in moments(seed, random_layout(seed, pairs=40)):
        x = random_layout(seed, pairs=40, frames=3, turns=(0, 2), **fields)
        x.margin[:-1] *= moving
        counts.append(run("assemble", x, q[:7] if "plain" in fields else q, pairs, reach, moving)[0])
        np.testing.assert_allclose(
            x.A.T @ (x.A @ x.v_tracking - x.b) + x.damping**2 * x.v_tracking, 0.0, rtol=0, atol=1e-9
        )
    assert min(counts) == 0 and len(set(counts)) > 2


RUN = """
import sys

import numba
import numpy as np
import pinocchio as pin

from qpavoid import Controller, load_scenario

found = {"plain": numba.config.DISABLE_JIT}
for scenario in sys.argv[2:]:
    controller, q = Controller.from_scenario(load_scenario(scenario))
    model, v = controller.scene.robot.model, []
    for k in range(60):
        solution = controller.step(q, 3.0 + k * controller.dt)
        v.append(solution.v)
        q = pin.integrate(model, q, controller.dt * solution.v)
    problem = controller.tick(q, 3.0).problem
    found[scenario] = np.array(v)
    found[scenario + " rows"] = np.concatenate((problem.avoidance.J.ravel(), problem.avoidance.b))
    found[scenario + " bounds"] = np.array((problem.lower, problem.upper))
np.savez(sys.argv[1], **found)
"""


def test_plain_python_gives_the_velocities_of_the_compiled_kernels(tmp_path):
    """`NUMBA_DISABLE_JIT=1` runs the same loops: all that differs is the order in which sums are taken."""
    scenarios, runs = ("situation1", "moving_sphere", "panda_line"), []
    for plain in ("0", "1"):
        path = tmp_path / f"{plain}.npz"
        command = [sys.executable, "-c", RUN, str(path), *scenarios]
        subprocess.run(command, env={**os.environ, "NUMBA_DISABLE_JIT": plain}, check=True, timeout=300)
        with np.load(path) as saved:
            runs.append(dict(saved))
    fast, plain = runs
    assert plain.pop("plain") and not fast.pop("plain") and fast.keys() == plain.keys()
    for name, values in fast.items():
        np.testing.assert_allclose(plain[name], values, rtol=0, atol=1e-10, err_msg=name)
    assert all(np.abs(fast[name]).max() > 0.1 for name in scenarios)
    assert sum(fast[name + " rows"].size for name in scenarios) > 0


# --- backup trajectories -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_backup_rows_are_those_of_enabled_pairs_without_contact(seed):
    rng = np.random.default_rng(seed)
    x, pairs = random_layout(seed, pairs=40), chosen(40, seed)
    watched = rng.random(40) < 0.7
    before, distance = watched.copy(), x.results[:, 0]
    touch, reach = np.quantile(distance[pairs], [0.2, 0.8])
    near = [i for i in pairs.tolist() if distance[i] < reach and before[i]]
    kept = [i for i in near if distance[i] >= touch]
    q = rng.normal(size=x.q_index.max(initial=0) + 1)
    k, touching, nearest, rest = run("backup_rows", x, q, pairs, reach, True, watched, touch)
    assert x.near_pairs[:k].tolist() == kept and 0 < k < len(pairs)
    assert touching == len(near) - len(kept) > 0
    np.testing.assert_array_equal(x.closest[:k], x.results[kept])
    assert nearest == min(distance[near]) and rest == min(distance[kept])
    assert np.flatnonzero(before & ~watched).tolist() == [i for i in near if i not in kept]
    whole = random_layout(seed, pairs=40)
    run("distance_rows", whole, np.array(kept), np.inf, True)
    np.testing.assert_allclose(x.J[:k], whole.J[:k], rtol=0, atol=1e-14)
    np.testing.assert_allclose(x.feedforward[:k], whole.feedforward[:k], rtol=0, atol=1e-14)
    run("velocity_bounds", whole, q)
    np.testing.assert_array_equal([x.lower, x.upper], [whole.lower, whole.upper])


def test_backup_rows_take_nan_for_contact():
    results = np.random.default_rng(0).normal(size=(3, 10))
    results[1, 0] = np.nan
    x = random_layout(0, pairs=3, results=gaps(results, 17))
    watched, q = np.ones(3, dtype=bool), np.zeros(x.q_index.max(initial=0) + 1)
    k, touching, nearest, _ = run("backup_rows", x, q, np.arange(3), np.inf, False, watched, -np.inf)
    assert (k, touching) == (2, 1) and np.isnan(nearest) and watched.tolist() == [True, False, True]


@pytest.mark.parametrize("seed", SEEDS)
def test_closes_below_by_its_definition(seed):
    rng = np.random.default_rng(seed)
    k = 5 * seed
    closest, J, feedforward, v = (
        rng.normal(size=(k, 10)),
        rng.normal(size=(k, 4)),
        rng.normal(size=k),
        rng.normal(size=4),
    )
    least = min((closest[i, 0] + 0.3 * (J[i] @ v + feedforward[i]) for i in range(k)), default=np.inf)
    for safe, near in ((least - 1e-9, False), (least + 1e-9, k > 0)):
        assert kernels.closes_below(closest, J, feedforward, v, 0.3, safe) == near


@pytest.mark.parametrize("meets", [False, True])
def test_rate_limit_keeps_to_the_largest_change(meets):
    wanted = np.array([[0.35, -0.1, 5.0]] * 6)
    rate_limit = kernels.rate_limit(np.zeros(3), wanted, np.array([0.1, 0.1, np.inf]), meets)
    expected = [[min(0.1 * (i + 1), 0.35), -0.1, 5.0] for i in range(4 if meets else 6)]
    np.testing.assert_allclose(rate_limit, expected, rtol=0, atol=1e-15)
    assert len(kernels.rate_limit(np.zeros(3), wanted[:0], np.ones(3), meets)) == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_rate_limit_and_min_sphere_distance_by_their_definitions(seed):
    rng = np.random.default_rng(seed)
    v, wanted, step = rng.normal(size=5), rng.normal(size=(9, 5)), rng.uniform(0.1, 2.0, 5)
    found = kernels.rate_limit(v, wanted, step, False)
    for got, target in zip(found, wanted, strict=True):
        v = np.clip(target, v - step, v + step)
        np.testing.assert_allclose(got, v, rtol=0, atol=1e-14)
    paths, centers, sizes = rng.normal(size=(7, seed, 3)), rng.normal(size=(4, 3)), rng.uniform(0.0, 1.0, (seed, 4))
    least = kernels.min_sphere_distance(paths, centers, sizes)
    brute = [
        np.linalg.norm(paths[t, o] - centers[b]) - sizes[o, b]
        for t in range(7) for o in range(seed) for b in range(4)
    ]  # fmt: skip
    assert least == pytest.approx(min(brute, default=np.inf))


def test_min_sphere_distance_preserves_nan():
    paths = np.array([[[3.0, 0.0, 0.0]], [[np.nan, 0.0, 0.0]], [[4.0, 0.0, 0.0]]])
    assert not kernels.min_sphere_distance(paths, np.zeros((1, 3)), np.ones((1, 1))) > 0.0
