"""Prediction of obstacles: mean twists, turns, and a bound on how much an update changes them."""

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qpavoid import Obstacle, Pose, Sample
from qpavoid.config import Sensing, Sphere
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.kernels import prediction_error_bound


def observe(tracker, t, updates):
    """Take over what a step at t is given."""
    tracker.advance(tracker.read(t, updates))


def test_prediction_uses_the_mean_twist():
    """Poses with a noise of 5 mm give twists with errors of 0.7 m/s, but predictions without."""
    dt, rng = 0.01, np.random.default_rng(0)
    obstacles, off = ObstacleTracker([Obstacle.at("ball", Sphere(radius=0.1), [0, 0, 0])], Sensing(), dt), []
    for k in range(200):
        t = k * dt
        at = np.array([0.2 * t, 0.0, 0.0])
        observe(obstacles, t, {"ball": Pose.at(at + 0.005 * rng.normal(size=3))})
        if k == 1:
            first = obstacles.prediction.twists[0, :3]
            np.testing.assert_array_equal(first, obstacles.current.states[0, 12:15])  # of one twist, that is the mean
        if k > 50:
            off.append(obstacles.at(t + 1.0).states[0, 9:12] - at - [0.2, 0.0, 0.0])
    assert np.std(off) < 0.05 and np.abs(np.mean(off, axis=0)).max() < 0.02


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.0, 0.3))
def test_prediction_error_bound_covers_every_point(seed, size):
    """Two obstacles on circles, of which the last samples are off."""
    rng, dt = np.random.default_rng(seed), 0.05
    names, radii = ["a", "b"], np.array([0.2, 0.3])
    obstacles = ObstacleTracker([Obstacle.at(name, Sphere(radius=0.1), [0, 0, 0]) for name in names], Sensing(), dt)
    orbits = [rng.normal(size=(4, 3)) for _ in names]

    def sample(orbit, t, size=0.0):
        arm, turn, rotation, angular = orbit
        offset, R = size * rng.normal(size=(4, 3)), pin.exp3(t * turn)
        at, velocity = R @ arm, np.cross(turn, R @ arm)
        return Sample(at + offset[0], pin.exp3(rotation + offset[1]), velocity + offset[2], angular + offset[3])

    for k in range(6):
        observe(obstacles, k * dt, {n: sample(orbit, k * dt) for n, orbit in zip(names, orbits, strict=True)})
    before = obstacles.prediction
    assert before.turns.all()
    observe(obstacles, 6 * dt, {n: sample(orbit, 6 * dt, size) for n, orbit in zip(names, orbits, strict=True)})
    now, off = obstacles.prediction, 0.0
    bound = prediction_error_bound(now, before, 1.0, radii)
    for t in np.linspace(0.0, 1.0, 11):
        one, two = (obstacles.at(6 * dt + t, prediction).states for prediction in (before, now))
        one = one if t else obstacles.at(6 * dt + 1e-12, before).states
        for i in range(2):
            points = rng.normal(size=(50, 3))
            points *= radii[i] / np.linalg.norm(points, axis=1, keepdims=True)
            places = [points @ state[i, :9].reshape(3, 3) + state[i, 9:12] for state in (one, two)]
            off = max(off, np.linalg.norm(places[0] - places[1], axis=1).max())
    assert off <= bound + 1e-9
    assert prediction_error_bound(now, before, 1.0, np.array([np.inf, 0.3])) == np.inf or size < 1e-9
    obstacles.reset()
    assert prediction_error_bound(obstacles.prediction, before, 1.0, radii) == np.inf


# --- obstacles that turn -------------------------------------------------------------------------------------------


def errors_of_prediction(position, velocity, dt, ahead, noise=0.0, end=3.0):
    """By how much samples up to some time predict the position a time ahead wrong (N,) [m]; turns (N, 3)."""
    obstacles, rng, errors, turns = tracker_of("ball", dt), np.random.default_rng(0), [], []
    for t in np.arange(0.0, end, dt):
        observe(obstacles, t, {"ball": Sample.at(position(t), linear=velocity(t) + noise * rng.normal(size=3))})
        errors.append(np.linalg.norm(obstacles.at(t + ahead).states[0, 9:12] - position(t + ahead)))
        turns.append(obstacles.prediction.turns[0])
    return np.array(errors), np.array(turns)


def tracker_of(name, dt):
    return ObstacleTracker([Obstacle.at(name, Sphere(radius=0.1), [0, 0, 0])], Sensing(), dt)


def on_circle(radius, turn):
    """Position and velocity of a circle about the origin."""
    arm, turn = radius * np.array([0.6, 0.0, 0.8]), np.array([0.0, turn, 0.0])
    return lambda t: pin.exp3(t * turn) @ arm, lambda t: np.cross(turn, pin.exp3(t * turn) @ arm)


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.04])
@pytest.mark.parametrize(("radius", "turn"), [(0.18, 1.8), (0.5, -0.6), (0.1, 4.0)])
def test_circles_are_foretold_from_the_fourth_sample_on(dt, radius, turn):
    """A line leads astray by ½ a t² at least: by 22 to 200 mm within the half second."""
    errors, turns = errors_of_prediction(*on_circle(radius, turn), dt, 0.5)
    assert errors[10:].max() < 2e-3 * radius < 0.02 < errors[:3].max()
    np.testing.assert_allclose(turns[10:], np.tile([0.0, turn, 0.0], (len(turns) - 10, 1)), atol=2e-3 * abs(turn))


def test_noise_of_a_hundredth_leaves_most_of_a_turn():
    """Velocities of 0.32 m/s with a noise of 10 mm/s; a line is 0.12 m off, see above."""
    errors, _ = errors_of_prediction(*on_circle(0.18, 1.8), 0.01, 0.5, noise=0.01)
    assert errors[50:].mean() < 0.04


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.033])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("jumps", [False, True])
def test_neither_noise_nor_a_sudden_change_of_velocity_is_a_turn(dt, noise, jumps):
    """So lines are predicted as they are without any turns, to the last bit."""
    rng = np.random.default_rng(3)
    ends, velocities = np.cumsum(rng.uniform(0.3, 2.0, 20)), 0.15 * rng.normal(size=(21, 3))
    _, turns = errors_of_prediction(
        lambda t: np.zeros(3), lambda t: velocities[np.searchsorted(ends, t) if jumps else 0], dt, 0.5, noise, 10.0
    )
    assert not turns.any()
