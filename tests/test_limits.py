"""Joint limits: bounds that never cross and are never left."""

import numpy as np
import pytest
from conftest import make_layout
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from qpavoid.config import Limits
from qpavoid.kernels import pack, speed_to_stop, velocity_bounds
from qpavoid.kernels.packing import compiled
from qpavoid.model.limits import JointBounds, limit_layout, saturate

N = 4
fast = settings(max_examples=100, deadline=None)
share = st.floats(0.01, 1.0)
period = st.floats(1e-4, 0.1)
velocities = arrays(np.float64, N, elements=st.floats(-50.0, 50.0))
INDEX = np.arange(N)
FREE = np.full(N, np.inf)


class Axes:
    """Bounds of joints in any number of ticks."""

    def __init__(self, joints, gain, dt):
        self.layout = make_layout(len(joints.velocity), **limit_layout(joints, gain, dt))
        self.packed = pack(self.layout)

    def bounds(self, q, v_prev=0.0):
        """Copies of lower and upper."""
        self.layout.v_prev[:] = v_prev
        velocity_bounds(self.packed, q)
        return self.layout.lower.copy(), self.layout.upper.copy()


def bounds_at(joints, q, gain, dt):
    return Axes(joints, gain, dt).bounds(q)


def vector(low, high):
    return arrays(np.float64, N, elements=st.floats(low, high))


@st.composite
def bounds(draw):
    """Limits of four joints, some without a speed limit."""
    lower = draw(vector(-3.0, 2.0))
    speed = np.where(draw(arrays(bool, N)), draw(vector(0.01, 5.0)), np.inf)
    return JointBounds(speed, INDEX, INDEX, lower, lower + draw(vector(1e-3, 4.0)), FREE, FREE)


@fast
@given(bounds(), vector(-10.0, 10.0), period, share, share)
def test_velocity_bounds_never_cross(joints, q, dt, gain, scale):
    lower, upper = bounds_at(joints.within(Limits(velocity_scale=scale)), q, gain, dt)
    assert not np.isnan([lower, upper]).any()
    assert (lower <= upper).all()
    assert (np.maximum(np.abs(lower), np.abs(upper)) <= scale * joints.velocity).all()


@fast
@given(bounds(), vector(0.0, 1.0), vector(0.0, 1.0), period, share, share)
def test_velocity_bounds_keep_the_next_configuration_inside(joints, place, choice, dt, gain, scale):
    q = joints.lower + place * (joints.upper - joints.lower)
    lower, upper = bounds_at(joints.within(Limits(velocity_scale=scale)), q, gain, dt)
    for v in (lower, upper, lower + choice * (upper - lower)):
        following = q + dt * v
        assert (following >= joints.lower - 1e-12).all()
        assert (following <= joints.upper + 1e-12).all()
    # and standing still is always allowed
    assert (lower <= 1e-12 / dt).all() and (upper >= -1e-12 / dt).all()


@fast
@given(bounds(), vector(1e-3, 5.0), st.sampled_from([-1.0, 1.0]), period, share)
def test_velocity_bounds_outside_return_without_overshoot(joints, beyond, side, dt, gain):
    edge = joints.upper if side > 0 else joints.lower
    q = edge + side * beyond
    lower, upper = bounds_at(joints, q, gain, dt)
    for v in (lower, upper):
        assert (side * v < 0).all()
    back = upper if side > 0 else lower  # the slowest return that is allowed
    following = side * (q + dt * back - edge)
    assert (following < beyond).all() and (following >= -1e-9).all()


@fast
@given(bounds(), vector(0.0, 1.0), velocities, period, share)
def test_saturate_keeps_to_the_bounds(joints, place, v, dt, gain):
    q = joints.lower + place * (joints.upper - joints.lower)
    lower, upper = bounds_at(joints, q, gain, dt)
    within, change = saturate(v, lower, upper, joints.velocity)
    assert (within >= lower).all() and (within <= upper).all()
    assert change == pytest.approx(np.abs(within - v).max(), abs=1e-15)


def test_saturate_by_hand():
    """The fastest joint sets one factor (1/2); then the second joint's position limit clips it alone."""
    v_max = np.array([1.0, 1.0, np.inf])
    within, change = saturate(np.array([2.0, -1.0, 8.0]), np.array([-1, -0.1, -9]), np.array([1.0, 1.0, 9.0]), v_max)
    np.testing.assert_allclose(within, [1.0, -0.1, 4.0])
    assert change == pytest.approx(4.0)


def test_joint_bounds_of_robots(panda, solo):
    """A floating base has the speed limits that it is given, and no position limits; joints keep the URDF's limits."""
    bounds = panda.bounds()
    np.testing.assert_array_equal(bounds.v_index, np.arange(7))
    np.testing.assert_allclose(bounds.upper[[0, 3]], [2.8973, -0.0698])
    np.testing.assert_allclose(bounds.velocity[[0, 6]], [2.175, 2.61])
    legs = solo.bounds()
    assert solo.model.nq == solo.model.nv + 1
    np.testing.assert_array_equal(legs.v_index, np.arange(6, 18))
    np.testing.assert_array_equal(legs.q_index, np.arange(7, 19))
    np.testing.assert_array_equal(legs.velocity[:6], 10.0)


# --- accelerations -----------------------------------------------------------------------------------------------


def travel(v, step, dt):
    """How far a coordinate goes that moves at v for one tick, and is then slowed by `step` in every tick."""
    far, v = np.zeros_like(v), v.copy()
    while (v > 0.0).any():
        far += dt * v
        v = np.maximum(v - step, 0.0)
    return far


@pytest.mark.parametrize("of", [speed_to_stop, compiled(speed_to_stop)])
def test_speed_to_stop_is_the_largest(of):
    """And does not from a speed that is a thousandth larger."""
    rng = np.random.default_rng(0)
    room, step, dt = (
        10.0 ** rng.uniform(-9, 1, 3000),
        10.0 ** rng.uniform(-3, 1, 3000),
        10.0 ** rng.uniform(-3, -1, 3000),
    )
    v = of(room, step, dt)
    np.testing.assert_allclose(travel(v, step, dt), room, rtol=1e-9)
    assert (travel(1.001 * v, step, dt) > 1.0005 * room).all()


def viable(joints, q, v, dt):
    """Speeds that braking brings to a standstill within the position limits, after this tick: v - step can stop."""
    step = joints.acceleration * dt
    room = np.stack((q - joints.lower, joints.upper - q))
    slowed = np.maximum(np.stack((-v, v)) - step, 0.0)
    slack = 1e-9 * np.maximum(1.0, joints.acceleration)
    return ((room >= -1e-9) & (slowed <= speed_to_stop(np.maximum(room, 0.0), step, dt) + slack)).all(axis=0)


@st.composite
def braked(draw):
    """Joints with limits of position and acceleration, some without a speed limit; a tick, and a viable state."""
    lower = draw(vector(-3.0, 2.0))
    speed = np.where(draw(arrays(bool, N)), draw(vector(0.01, 5.0)), np.inf)
    joints = JointBounds(speed, INDEX, INDEX, lower, lower + draw(vector(1e-3, 4.0)), draw(vector(0.05, 100.0)), FREE)
    dt = draw(st.floats(1e-3, 0.1))
    q = lower + draw(vector(0.0, 1.0)) * (joints.upper - lower)
    below, above = (
        speed_to_stop(np.maximum(room, 0.0), joints.acceleration * dt, dt) for room in (q - lower, joints.upper - q)
    )
    v = -np.minimum(below, speed) + draw(vector(0.0, 1.0)) * (np.minimum(below, speed) + np.minimum(above, speed))
    return joints, dt, q, v


@fast
@given(state=braked(), choice=vector(0.0, 1.0), gain=share)
def test_velocity_bounds_preserve_viability(state, choice, gain):
    """Whatever is chosen within the bounds keeps position, speed and acceleration limits, now and later."""
    joints, dt, q, v_prev = state
    lower, upper = Axes(joints, gain, dt).bounds(q, v_prev)
    assert (lower <= upper).all()
    for v in (lower, upper, lower + choice * (upper - lower)):
        assert (np.abs(v - v_prev) <= joints.acceleration * dt + 1e-9).all()
        assert (np.abs(v) <= joints.velocity + 1e-9).all()
        following = q + dt * v
        assert (following >= joints.lower - 1e-9).all() and (following <= joints.upper + 1e-9).all()
        assert viable(joints, following, v, dt).all()


def random_joints(rng, count):
    """Joints of all kinds, at rest somewhere in their range: of a millimetre or some radians, of any acceleration."""
    lower = rng.uniform(-3.0, 2.0, count)
    upper = lower + 10.0 ** rng.uniform(-3, 0.6, count)
    speed = np.where(rng.random(count) < 0.8, 10.0 ** rng.uniform(-2, 0.7, count), np.inf)
    index = np.arange(count)
    acceleration = 10.0 ** rng.uniform(-1, 2, count)
    joints = JointBounds(speed, index, index, lower, upper, acceleration, np.full(count, np.inf))
    return joints, rng.uniform(lower, upper)


def test_velocity_bounds_relax_the_acceleration_alone():
    """Position and speed are kept, and the bounds do not cross."""
    joints, q = random_joints(np.random.default_rng(3), 500)
    rng, dt = np.random.default_rng(4), 0.01
    v_prev = rng.uniform(-50.0, 50.0, 500)
    broken = ~viable(joints, q, v_prev, dt) | (np.abs(v_prev) > joints.velocity + joints.acceleration * dt)
    assert broken.sum() > 100
    axes = Axes(joints, 0.5, dt)
    lower, upper = axes.bounds(q, v_prev)
    hard_lower, hard_upper = axes.layout.hard_lower, axes.layout.hard_upper
    assert (hard_lower <= lower).all() and (lower <= upper).all() and (upper <= hard_upper).all()
    for v in (lower, upper):
        assert (np.abs(v) <= joints.velocity).all()
        assert (q + dt * v >= joints.lower - 1e-12).all() and (q + dt * v <= joints.upper + 1e-12).all()
    change = np.where(v_prev > 0.0, v_prev - upper, lower - v_prev)  # the least that is left to choose
    assert (change[broken] > joints.acceleration[broken] * dt).all()


def test_acceleration_limits_of_a_scenario_fill_in():
    """The scenario's is for joints to which the robot gives none; its share is of all of them."""
    given = np.array([2.0, np.inf, 4.0, np.inf])
    joints = JointBounds(np.ones(N), INDEX, INDEX, -np.ones(N), np.ones(N), given, FREE)
    np.testing.assert_array_equal(joints.within(Limits()).acceleration, given)
    found = joints.within(Limits(acceleration=6.0, acceleration_scale=0.5)).acceleration
    np.testing.assert_array_equal(found, [1.0, 3.0, 2.0, 3.0])
