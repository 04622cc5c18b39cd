"""Limits of position, velocity, acceleration and jerk as one viable set, and stops within them.

The stop of one coordinate is computed step by step here, by its definition; the kernels have it in closed form.
"""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_layout
from hypothesis import given, settings
from hypothesis import strategies as st
from test_limits import Axes, random_joints

from qpavoid import kernels
from qpavoid.kernels.braking_bounds import stopping_distance
from qpavoid.model.limits import JointBounds, limit_layout

SAFE = 0.02


# --- the stop of one coordinate ----------------------------------------------------------------------------------


def largest_change(v):
    """σ(v): largest b for which b + (b - 1) + … is at most v."""
    n = max(np.ceil(0.5 * np.sqrt(1.0 + 8.0 * v) - 0.5), 1.0)
    return v / n + 0.5 * (n - 1.0)


def stop_speeds(v, w, most):
    """Speeds of a stop, from v on, in the units of `kernels.braking_bounds`."""
    speeds = [v]
    while abs(v) > 1e-9 or abs(w) > 1.0:
        target = -np.sign(v) * min(largest_change(abs(v)), most)
        w = min(max(target, w - 1.0), w + 1.0)
        v += w
        speeds.append(v)
        assert len(speeds) < 10_000
    return np.array(speeds)


@st.composite
def moving(draw):
    """v, w and the largest w, some of them whole numbers, at which the phases of a stop change."""
    most = 10.0 ** draw(st.floats(-1.0, 1.5))
    w = draw(st.floats(-1.0, 1.0)) * most
    v = draw(st.sampled_from([-1.0, 1.0])) * 10.0 ** draw(st.floats(-3.0, 2.5))
    if draw(st.booleans()):
        most = max(np.round(most), 1.0)
        v, w = np.round(v), np.clip(np.round(w), -most, most)
    return v, w, most


many = settings(max_examples=400, deadline=None)


@many
@given(moving())
def test_way_to_stop_agrees_with_the_stop_step_by_step(state):
    v, w, most = state
    expected = np.max(np.cumsum(stop_speeds(v, w, most)), initial=0.0)
    found = stopping_distance(v, w, most)[0]
    if v > 0.0 and -w - 1.0 > min(largest_change(v), most):  # braking too hard to come to rest without passing it
        assert found >= expected - 1e-9
        expected = np.sum(stop_speeds(v, -min(largest_change(v), most) - 1.0, most))
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


# --- bounds ------------------------------------------------------------------------------------------------------


def jerky_joints(rng, count, some=True):
    """Joints of all kinds, as `random_joints` has them, most of them with a jerk limit, tight or wide."""
    joints, q = random_joints(rng, count)
    jerk = joints.acceleration * 10.0 ** rng.uniform(0.0, 3.0, count)
    return replace(joints, jerk=np.where(rng.random(count) < 0.9, jerk, np.inf) if some else jerk), q


def bounds_after(axes, q, v, w):
    axes.layout.dv_prev[:] = w
    return axes.bounds(q, v)


def stops_within(joints, i, q, v, w, dt, slack):
    """Whether coordinate i, at q, moves at v after a change of w and then stops within its limits."""
    unit = joints.jerk[i] * dt**2
    speeds = unit * stop_speeds(v / unit, w / unit, joints.acceleration[i] * dt / unit)
    path = q + dt * np.cumsum(speeds)
    inside = (path >= joints.lower[i] - slack).all() and (path <= joints.upper[i] + slack).all()
    return inside and (np.abs(speeds) <= joints.velocity[i] + slack).all()


@pytest.mark.parametrize("dt", [0.01, *(pytest.param(dt, marks=pytest.mark.slow) for dt in (0.001, 0.05))])
def test_bounds_keep_all_limits_in_a_hundred_thousand_steps(dt):
    """400 joints, 300 steps each, driven into their limits, to and fro, or at random."""
    rng = np.random.default_rng(1)
    joints, q = jerky_joints(rng, 400)
    axes, v, w = Axes(joints, 0.5, dt), np.zeros(400), np.zeros(400)
    unit, reached = np.where(np.isinf(joints.jerk), np.inf, joints.jerk * dt**2), np.zeros(400, dtype=bool)
    for step in range(300):
        lower, upper = bounds_after(axes, q, v, w)
        assert (lower <= upper).all()
        if step % 60 == 0:
            goal = rng.choice([0.0, 0.5, 1.0], 400)  # pushed to one side for a while; 0.5: anywhere
        v_next = lower + np.where(goal == 0.5, rng.random(400), goal) * (upper - lower)
        change = v_next - v
        assert (np.abs(change - w) <= unit * (1.0 + 1e-7) + 1e-12).all()
        assert (np.abs(change) <= joints.acceleration * dt + 1e-9).all()
        assert (np.abs(v_next) <= joints.velocity + 1e-9).all()
        q, v, w = q + dt * v_next, v_next, change
        assert (q >= joints.lower - 1e-9).all() and (q <= joints.upper + 1e-9).all()
        reached |= np.minimum(q - joints.lower, joints.upper - q) < 1e-6
    assert reached.mean() > 0.05  # pushed up to a limit, and no farther


@pytest.mark.parametrize("seed", range(2))
def test_bounds_are_the_largest_speeds_with_a_stop_in_time(seed):
    """Where neither the jerk nor the acceleration limits the bound; from all kinds of viable states."""
    rng, dt, checked = np.random.default_rng(seed), 0.01, 0
    joints, q = jerky_joints(rng, 40, some=False)
    axes, v, w = Axes(joints, 0.5, dt), np.zeros(40), np.zeros(40)
    for _ in range(60):
        lower, upper = bounds_after(axes, q, v, w)
        v_next = np.where(rng.random(40) < 0.6, upper, lower + rng.random(40) * (upper - lower))
        w, v, q = v_next - v, v_next, q + dt * v_next
    unit, step = joints.jerk * dt**2, joints.acceleration * dt
    for bound, away in zip(bounds_after(axes, q, v, w), (-1.0, 1.0), strict=True):
        farthest = np.minimum(away * w + unit, step) - 1e-3 * unit
        for i in range(40):
            assert stops_within(joints, i, q[i], bound[i], bound[i] - v[i], dt, 1e-9)
            if away * (bound[i] - v[i]) < farthest[i]:
                checked, beyond = checked + 1, bound[i] + away * 1e-3 * unit[i]
                assert not stops_within(joints, i, q[i], beyond, beyond - v[i], dt, 0.0)
    assert checked > 10


def test_bounds_relax_jerk_then_acceleration_from_states_without_a_stop():
    """Position and speed are kept, and the bounds do not cross; with acceleration, as far as that can be kept."""
    joints, q = jerky_joints(np.random.default_rng(3), 500)
    rng, dt = np.random.default_rng(4), 0.01
    v = rng.uniform(-5.0, 5.0, 500)
    w = rng.uniform(-1.0, 1.0, 500) * joints.acceleration * dt
    axes = Axes(joints, 0.5, dt)
    lower, upper = bounds_after(axes, q, v, w)
    within = Axes(replace(joints, jerk=np.full(500, np.inf)), 0.5, dt).bounds(q, v)
    assert (within[0] <= lower).all() and (lower <= upper).all() and (upper <= within[1]).all()
    change, unit = np.maximum(lower - v - w, v + w - upper), joints.jerk * dt**2
    assert (change > unit * (1.0 + 1e-9)).sum() > 100  # what jerk alone would forbid
    low_effort = (np.abs(v) < 0.2 * joints.velocity) & (np.minimum(q - joints.lower, joints.upper - q) > 3.0)
    assert (change[low_effort] <= unit[low_effort] * (1.0 + 1e-9)).all()


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_bounds_return_a_joint_into_its_limits_within_its_jerk(side):
    """From rest, with no more than its acceleration and jerk; once inside, it stays there."""
    joints, _ = jerky_joints(np.random.default_rng(5), 300)
    joints = replace(joints, acceleration=10.0 ** np.random.default_rng(6).uniform(0, 2, 300))
    rng, dt = np.random.default_rng(7), 0.01
    edge = joints.upper if side > 0 else joints.lower
    q = edge + side * rng.uniform(0.01, 5.0, 300) * np.minimum(joints.velocity, 0.1)
    v, w = np.zeros(300), np.zeros(300)
    axes, choice, back = Axes(joints, 0.5, dt), rng.random(300), np.zeros(300, dtype=bool)
    unit = np.where(np.isinf(joints.jerk), np.inf, joints.jerk * dt**2)
    for _ in range(10000):
        lower, upper = bounds_after(axes, q, v, w)
        assert (lower <= upper).all()
        v_next = lower + choice * (upper - lower)
        change = v_next - v
        assert (np.abs(change) <= joints.acceleration * dt + 1e-9).all()
        assert (np.abs(change - w) <= unit * (1.0 + 1e-7) + 1e-9).all()
        q, v, w = q + dt * v_next, v_next, change
        inside = (q >= joints.lower - 1e-9) & (q <= joints.upper + 1e-9)
        assert inside[back].all()
        back |= inside
        if back.all():
            break
    assert back.all()


# --- stops of all coordinates -------------------------------------------------------------------------------------


def limited(seed, n=7):
    """A layout with all limits, far away from those of position."""
    rng = np.random.default_rng(seed)
    acceleration = rng.uniform(1.0, 20.0, n)
    joints = JointBounds(np.full(n, 5.0), np.arange(n), np.arange(n), np.full(n, -9.0), np.full(n, 9.0),
                         acceleration, acceleration * 10.0 ** rng.uniform(0.5, 2.5, n))  # fmt: skip
    return make_layout(n, **limit_layout(joints, 0.5, 0.01)), rng


def stops(x, q, v, w):
    """Velocities of a stop by `velocity_bounds` and `stop_velocity`, step by step."""
    packed, path = kernels.pack(x), [v]
    while (np.abs(v) > 1e-9 * x.v_step).any() or (np.abs(w) > x.dv_step).any():
        q = q + x.dt * v
        x.v_prev[:], x.dv_prev[:] = v, w
        kernels.velocity_bounds(packed, q)
        kernels.stop_velocity(packed)
        assert (x.v_stop >= x.lower).all() and (x.v_stop <= x.upper).all()
        v, w = x.v_stop.copy(), x.v_stop - v
        path.append(v)
        assert len(path) < 3000
    return np.array(path)


@pytest.mark.parametrize("seed", range(3))
def test_stop_ends_at_rest_within_all_limits(seed):
    """At most twice as late as the slowest coordinate could alone."""
    x, rng = limited(seed)
    v, w = rng.uniform(-1.0, 1.0, 7) * 2.0, rng.uniform(-1.0, 1.0, 7) * x.v_step
    path = stops(x, np.zeros(7), v, w)
    assert np.abs(path[-1]).max() < 1e-9
    changes = np.diff(path, axis=0)
    assert (np.abs(changes) <= x.v_step * (1.0 + 1e-9)).all()
    assert (np.abs(np.diff(changes, axis=0, prepend=w[None])) <= x.dv_step * (1.0 + 1e-9)).all()
    alone = [len(stop_speeds(v[i] / x.dv_step[i], w[i] / x.dv_step[i], x.v_step[i] / x.dv_step[i])) for i in range(7)]
    assert len(path) <= 2 * max(alone) + 1


@pytest.mark.parametrize("seed", range(2))
def test_stop_from_constant_speed_is_uniform_and_of_least_time(seed):
    x, rng = limited(seed)
    v = rng.uniform(-2.0, 2.0, 7)
    path = stops(x, np.zeros(7), v, np.zeros(7))
    ratios = path / v
    np.testing.assert_allclose(ratios, np.repeat(ratios[:, :1], 7, axis=1), atol=1e-12)
    jerk = np.abs(np.diff(path, n=2, axis=0, prepend=np.array([v]))) / x.dv_step
    assert jerk[0].max() == pytest.approx(1.0) and (np.diff(ratios[:, 0]) < 1e-12).all()


@pytest.mark.parametrize("place", [0.0, 8.9])
@pytest.mark.parametrize("seed", range(2))
def test_stop_way_agrees_with_the_stop_step_by_step(seed, place):
    """In free space, and where position limits bend it."""
    x, rng = limited(seed)
    q, v, w = np.full(7, place), rng.uniform(0.5, 1.5, 7), rng.uniform(-1.0, 1.0, 7) * x.v_step
    if place:  # a viable state: moving there
        q, v, w = 0.0 * q + 5.0, 0.0 * v, 0.0 * w
        axes = kernels.pack(x)
        for _ in range(1000):
            x.v_prev[:], x.dv_prev[:] = v, w
            kernels.velocity_bounds(axes, q)
            v_next = x.upper.copy() if (q < 8.0).any() else 0.5 * (x.upper + np.minimum(v, x.upper))
            w, v = v_next - v, v_next
            q = q + x.dt * v
            if q.max() > 8.6:
                break
        q = q - x.dt * v
    expected = stops(x, q, v, w)
    path = np.full((1000, 7), np.nan)
    path[0] = v
    count = kernels.roll_out_stop(kernels.pack(x), q.copy(), w, path)
    assert abs(count - len(expected)) <= 1
    size = min(count, len(expected))
    np.testing.assert_allclose(path[:size], expected[:size], rtol=1e-9, atol=1e-9)
    assert (np.ptp(expected[: size // 2] / v, axis=1) > 1e-6).any()  # not all coordinates alike


# --- rows --------------------------------------------------------------------------------------------------------


def test_rows_stop_a_pair_at_its_distance_with_half_of_the_limits():
    """A pair that closes as fast as its row allows, and as its joints can follow, never comes nearer than it may."""
    step, unit, J, dt = np.array([0.1, 0.2]), np.array([0.01, 0.02]), np.array([[0.5, -1.0]]), 0.01
    d, v, w = np.array([0.9]), np.zeros(2), np.zeros(2)
    distances, changes = [], []
    for _ in range(400):
        closest = np.zeros((1, 10))
        closest[:, 0] = d
        x = make_layout(2, pairs=1, closest=closest, near_pairs=np.arange(1), feedforward=np.zeros(1), J=J, v_step=step,
            dv_step=unit, v_prev=v, dv_prev=w, acceleration_limited=True, jerk_limited=True,
            v_stop=np.array([0.0, -1e3]), near_speed=np.inf, row_gain=100.0, lower=-np.ones(2), upper=np.ones(2),
        )  # fmt: skip
        kernels.row_bounds(kernels.pack(x), 1, False)
        # the velocity along J that closes fastest, within the row and within what half of the limits allow
        per_speed = np.array([-1.0, 1.0]) / (J[0] @ [-1.0, 1.0]) * np.array([1.0, 1.0])
        least = max(x.rhs[0], J[0] @ (v + np.maximum(w + unit * [-1.0, 1.0], 0.0) * [1.0, 1.0]) - 9.0)
        v_next = per_speed * max(
            least, J[0] @ v + max(J[0] @ w - 0.5 * np.abs(J[0]) @ unit, -0.5 * np.abs(J[0]) @ step)
        )
        w, v = v_next - v, v_next
        changes.append(J[0] @ w)
        d = d + dt * (J @ v)
        distances.append(d[0])
    changes = np.array(changes)
    half = 0.5 * np.abs(J[0])
    assert min(distances) >= 0.1 - 1e-9 and distances[-1] == pytest.approx(0.1, abs=1e-3)
    assert (np.abs(np.diff(changes[:-60])) <= 1.25 * half @ unit).all()
    assert np.abs(changes).max() <= 1.01 * half @ step
