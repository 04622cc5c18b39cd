"""Joint limits: bounds that never cross and are never left."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from qpavoid.limits import JointBounds, saturate, velocity_bounds

N = 4
fast = settings(max_examples=200, deadline=None)
share = st.floats(0.01, 1.0)
period = st.floats(1e-4, 0.1)
velocities = arrays(np.float64, N, elements=st.floats(-50.0, 50.0))
INDEX = np.arange(N)


def vector(low, high):
    return arrays(np.float64, N, elements=st.floats(low, high))


@st.composite
def bounds(draw):
    """Limits of four joints, some without a speed limit."""
    lower = draw(vector(-3.0, 2.0))
    speed = np.where(draw(arrays(bool, N)), draw(vector(0.01, 5.0)), np.inf)
    return JointBounds(speed, INDEX, INDEX, lower, lower + draw(vector(1e-3, 4.0)))


@fast
@given(bounds(), vector(-10.0, 10.0), period, share, share)
def test_bounds_never_cross_and_keep_to_the_speed(joints, q, dt, gain, scale):
    lower, upper = velocity_bounds(joints.slowed(scale), q, gain / dt)
    assert not np.isnan([lower, upper]).any()
    assert (lower <= upper).all()
    assert (np.maximum(np.abs(lower), np.abs(upper)) <= scale * joints.velocity).all()


@fast
@given(bounds(), vector(0.0, 1.0), vector(0.0, 1.0), period, share, share)
def test_the_next_configuration_stays_inside(joints, place, choice, dt, gain, scale):
    q = joints.lower + place * (joints.upper - joints.lower)
    lower, upper = velocity_bounds(joints.slowed(scale), q, gain / dt)
    for v in (lower, upper, lower + choice * (upper - lower)):
        following = q + dt * v
        assert (following >= joints.lower - 1e-12).all()
        assert (following <= joints.upper + 1e-12).all()
    # and standing still is always allowed
    assert (lower <= 1e-12 / dt).all() and (upper >= -1e-12 / dt).all()


@fast
@given(bounds(), vector(1e-3, 5.0), st.sampled_from([-1.0, 1.0]), period, share)
def test_outside_its_limits_a_joint_is_sent_back_without_overshoot(joints, beyond, side, dt, gain):
    edge = joints.upper if side > 0 else joints.lower
    q = edge + side * beyond
    lower, upper = velocity_bounds(joints, q, gain / dt)
    for v in (lower, upper):
        assert (side * v < 0).all()
    back = upper if side > 0 else lower  # the slowest return that is allowed
    following = side * (q + dt * back - edge)
    assert (following < beyond).all() and (following >= -1e-9).all()


def test_bounds_by_hand():
    joints = JointBounds(np.array([2.0, 1.0, np.inf]), np.array([0, 3]), np.array([0, 2]), -np.ones(2), np.ones(2))
    q = np.array([0.99, 7.0, 7.0, 0.0])  # the middle joint is continuous: two numbers in q, one in v
    lower, upper = velocity_bounds(joints.slowed(0.5), q, 0.5 / 0.01)
    np.testing.assert_allclose(upper, [0.5, 0.5, 50.0])
    np.testing.assert_allclose(lower, [-1.0, -0.5, -50.0])


@fast
@given(bounds(), vector(0.0, 1.0), velocities, period, share)
def test_saturated_velocity_is_within_the_bounds_and_its_change_is_reported(joints, place, v, dt, gain):
    q = joints.lower + place * (joints.upper - joints.lower)
    lower, upper = velocity_bounds(joints, q, gain / dt)
    within, change = saturate(v, lower, upper, joints.velocity)
    assert (within >= lower).all() and (within <= upper).all()
    assert change == pytest.approx(np.abs(within - v).max(), abs=1e-15)


@fast
@given(velocities, vector(0.01, 5.0))
def test_saturate_keeps_the_direction_while_only_speeds_are_exceeded(v, v_max):
    within, _ = saturate(v, -v_max, v_max, v_max)
    factor = min(1.0, 1.0 / max(np.max(np.abs(v) / v_max), 1e-300))
    np.testing.assert_allclose(within, factor * v, rtol=1e-12)


@fast
@given(vector(-1.0, 1.0), vector(0.01, 5.0))
def test_saturate_leaves_alone_what_is_inside(place, v_max):
    v = place * v_max
    within, change = saturate(v, -v_max, v_max, v_max)
    np.testing.assert_allclose(within, v, rtol=1e-15)
    assert change <= 1e-15 * v_max.max()


def test_saturate_by_hand():
    """The fastest joint sets one factor (1/2); then the second joint's position limit clips it alone."""
    v_max = np.array([1.0, 1.0, np.inf])
    within, change = saturate(np.array([2.0, -1.0, 8.0]), np.array([-1, -0.1, -9]), np.array([1.0, 1.0, 9.0]), v_max)
    np.testing.assert_allclose(within, [1.0, -0.1, 4.0])
    assert change == pytest.approx(4.0)


def test_without_any_limit_nothing_changes():
    infinite = np.full(2, np.inf)
    nothing = np.array([], dtype=np.intp)
    joints = JointBounds(infinite, nothing, nothing, np.array([]), np.array([]))
    lower, upper = velocity_bounds(joints.slowed(0.5), np.zeros(2), 0.5 / 0.01)
    v = np.array([1e6, -1e6])
    within, change = saturate(v, lower, upper, infinite)
    np.testing.assert_array_equal(within, v)
    assert change == 0.0


def test_bounds_of_robots(panda, solo):
    """The tangent space leaves the floating base free; every other coordinate keeps the URDF's limits."""
    bounds = panda.bounds()
    np.testing.assert_array_equal(bounds.v_index, np.arange(7))
    np.testing.assert_allclose(bounds.upper[[0, 3]], [2.8973, -0.0698])
    np.testing.assert_allclose(bounds.velocity[[0, 6]], [2.175, 2.61])
    legs = solo.bounds()
    assert solo.model.nq == solo.model.nv + 1
    np.testing.assert_array_equal(legs.v_index, np.arange(6, 18))
    np.testing.assert_array_equal(legs.q_index, np.arange(7, 19))
    assert np.isinf(legs.velocity[:6]).all()
