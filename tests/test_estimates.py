"""Obstacles that are given: what is taken of an update, and lines through bare poses against weighted least squares."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest

from qpavoid.control.estimates import MeasuredStates
from qpavoid.control.trajectories import TrajectoryBatch
from qpavoid.kernels.obstacles import POSE, REST, SAMPLE
from qpavoid.kernels.pose_fit import POSE_WEIGHT
from qpavoid.model.sample import Sample

NO_PIECES = TrajectoryBatch({}).pieces
DT, PERIOD = 0.01, 1.0 / 30.0


class Seen:
    """One obstacle, updated at times."""

    def __init__(self):
        self.measured = MeasuredStates(NO_PIECES, 1, DT)

    def update(self, t, position, rotation=None, kind=POSE, **velocity):
        """The state (18,) that is taken, and whether it is."""
        rows, numbers, kinds = Sample.at(position, rotation, **velocity).row[None], np.array([0]), np.array([kind])
        assert self.measured.check(numbers, rows[:, : 12 if kind == POSE else 18].copy(), kinds) == 0
        rejected, _ = self.measured.observe(t, numbers, kinds, np.array([t]), numbers)
        return self.measured.arrays.states[0].copy(), not rejected

    def after(self, position, t, **velocity):
        """Updates at 30 Hz up to t, noise and all as `position` gives them; the last state."""
        return [self.update(x, position(x), **velocity)[0] for x in np.arange(0.0, t, PERIOD)][-1]


def rotation_of(state):
    return state[:9].reshape(3, 3).T


def test_samples_are_taken_as_they_are_and_what_rests_rests():
    seen, velocity = Seen(), {"linear": (0.1, 0.2, 0.3), "angular": (1.0, 0.0, 0.0)}
    state, _ = seen.update(1.0, (1.0, 2.0, 3.0), kind=SAMPLE, **velocity)
    np.testing.assert_array_equal(state[9:], [1, 2, 3, 0.1, 0.2, 0.3, 1, 0, 0])
    state, _ = seen.update(1.1, (1.0, 2.0, 3.0), kind=REST, **velocity)
    np.testing.assert_array_equal(state[12:], 0.0)
    assert seen.measured.arrays.at_rest[0] and seen.measured.arrays.stamps[0] == 1.1


@pytest.mark.parametrize("before", [POSE, SAMPLE, REST])
def test_two_poses_give_their_difference_over_the_interval(before):
    rng, seen = np.random.default_rng(0), Seen()
    R0, R = (pin.exp3(rng.normal(size=3)) for _ in range(2))
    first, _ = seen.update(1.0, (0.0, 0.0, 0.0), R0, kind=before)
    if before == POSE:
        np.testing.assert_array_equal(first[12:], 0.0)
    state, _ = seen.update(1.5, (0.1, 0.2, -0.3), R)
    np.testing.assert_allclose(state[9:15], [0.1, 0.2, -0.3, 0.2, 0.4, -0.6], atol=1e-14)
    np.testing.assert_allclose(state[15:], pin.log3(R @ R0.T) / 0.5, atol=1e-12)
    np.testing.assert_allclose(rotation_of(state), R, atol=1e-14)
    same, _ = seen.update(1.5 + 1e-6, (0.2, 0.2, -0.3), R)  # no interval: another pose, the same twist
    np.testing.assert_array_equal(same[9:], [0.2, 0.2, -0.3, *state[12:]])


@pytest.mark.parametrize("seed", range(5))
def test_poses_are_put_on_the_line_of_least_weighted_squares(seed):
    """Irregular times, noise; rotations by the sum of their vectors, about whichever axes they are."""
    rng, seen = np.random.default_rng(seed), Seen()
    t = np.cumsum(rng.uniform(0.02, 0.06, 12))
    v, w = 0.3 * rng.normal(size=(2, 3))
    p = t[:, None] * v + 0.002 * rng.normal(size=(12, 3))
    R = [pin.exp3(0.01 * rng.normal(size=3)) @ pin.exp3(x * w) for x in t]
    turned = np.cumsum([np.zeros(3), *[pin.log3(b @ a.T) for a, b in pairwise(R)]], axis=0)
    for k in range(12):
        state, _ = seen.update(t[k], p[k], R[k])
        if k < 2:
            continue
        weights = POSE_WEIGHT ** (0.5 * np.arange(k, -1.0, -1.0))
        slope, at = np.polyfit(t[: k + 1] - t[k], np.hstack((p, turned))[: k + 1], 1, w=weights)
        np.testing.assert_allclose(state[9:12], at[:3], atol=1e-12)
        np.testing.assert_allclose(state[12:], slope, atol=1e-10)
        np.testing.assert_allclose(rotation_of(state), pin.exp3(at[3:] - turned[k]) @ R[k], atol=1e-12)


def test_line_of_a_steady_motion_is_exact():
    w, seen = np.array([0.3, -2.0, 1.0]), Seen()
    for t in np.arange(0.0, 2.0, PERIOD):
        state, _ = seen.update(t, t * np.array([1.0, -0.5, 0.0]), pin.exp3(t * w))
    np.testing.assert_allclose(state[12:], [1.0, -0.5, 0.0, *w], atol=1e-12)
    np.testing.assert_allclose(state[9:12], t * np.array([1.0, -0.5, 0.0]), atol=1e-14)
    np.testing.assert_allclose(rotation_of(state), pin.exp3(t * w), atol=1e-13)


def test_noise_of_a_camera_is_smoothed_as_by_seven_poses():
    """3 mm at 30 Hz: the difference of two poses is off by 127 mm/s, a line through seven by 17 mm/s (each axis)."""
    rng = np.random.default_rng(0)
    found = [Seen().after(lambda t: t * np.eye(3)[0] + 0.003 * rng.normal(size=3), 1.0) for _ in range(300)]
    error = np.std(np.array(found)[:, 9:15], axis=0)
    assert (error[:3] < 2.3e-3).all() and (error[3:] < 0.018).all()
    assert (error[3:] > 0.010).all()  # more would be slower to turn


@pytest.mark.parametrize("size", [0.02, 0.5])
def test_an_obstacle_that_is_put_elsewhere_is_where_it_is_seen(size):
    """Small steps are smoothed, by no more than they are; large ones start anew, with the difference of two poses."""
    seen = Seen()
    seen.after(lambda t: np.zeros(3), 1.0)
    state, _ = seen.update(1.0, (size, 0.0, 0.0))
    assert size - 0.012 < state[9] <= size
    for k in range(1, 10):
        state, _ = seen.update(1.0 + k * PERIOD, (size, 0.0, 0.0))
    assert abs(state[9] - size) < 1e-3 and abs(state[12]) < 0.02
    assert abs(state[13:]).max() < 1e-12


def test_a_pose_that_is_too_far_away_changes_nothing():
    """Faster than 1000 m/s: what comes then is compared with the pose before."""
    seen = Seen()
    before = seen.after(lambda t: np.array([t, 0.0, 0.0]), 0.5)
    stamp, known = seen.measured.arrays.stamps[0], seen.measured.arrays.last.copy()
    _, taken = seen.update(stamp + 0.01, (1e3, 0.0, 0.0))
    assert not taken and seen.measured.arrays.stamps[0] == stamp
    np.testing.assert_array_equal(seen.measured.arrays.last, known)
    state, taken = seen.update(stamp + PERIOD, (stamp + PERIOD, 0.0, 0.0))
    assert taken and state[12] == pytest.approx(before[12], abs=1e-9)


@pytest.mark.parametrize("age", [0.05, 0.1, 0.15, 0.2])
def test_prediction_errors_are_those_of_the_rule_for_d1(age):
    """Noise σ becomes σ (0.7 + 0.17 h/T) when it is moved on by h, an acceleration a at most ½ a (h + 3 T)²."""
    rng, errors, end = np.random.default_rng(1), [], 29 * PERIOD
    for _ in range(300):
        state = Seen().after(lambda t: 0.003 * rng.normal(size=3), 1.0)
        errors.append(state[9:12] + age * state[12:15])
    assert np.std(errors) == pytest.approx(0.003 * (0.7 + 0.17 * age / PERIOD), rel=0.1)
    state = Seen().after(lambda t: np.array([0.5 * t * t, 0.0, 0.0]), 1.0)
    off = 0.5 * (end + age) ** 2 - state[9] - age * state[12]
    assert 0.8 < off / (0.5 * (age + 3.0 * PERIOD) ** 2) <= 1.02
