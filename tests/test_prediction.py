"""Prediction of obstacles: constant mean twists, sampled paths, and a bound on how much an update changes them."""

import numpy as np
import pinocchio as pin
from hypothesis import given, settings
from hypothesis import strategies as st

from qpavoid import Obstacle, Pose, Sample
from qpavoid.config import Sensing, Sphere
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.trajectories import extrapolate
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
    rng, dt = np.random.default_rng(seed), 0.05
    names = ["a", "b"]
    obstacles = ObstacleTracker([Obstacle.at(name, Sphere(radius=0.1), [0, 0, 0]) for name in names], Sensing(), dt)

    def sample(turn, *parts):
        return Sample(parts[0], pin.exp3(turn), *parts[1:])

    first = {name: [rng.normal(size=3) for _ in range(4)] for name in names}
    observe(obstacles, 0.0, {name: sample(*parts) for name, parts in first.items()})
    before, radii = obstacles.prediction, np.array([0.2, 0.3])
    then = {name: obstacles.at(dt).states[i] for i, name in enumerate(names)}
    now = {}
    for name, state in then.items():
        R = state[:9].reshape(3, 3).T @ pin.exp3(size * rng.normal(size=3))
        now[name] = Sample(
            *(state[9:12] + size * rng.normal(size=3), R), *(state[12:].reshape(2, 3) + size * rng.normal(size=(2, 3)))
        )
    observe(obstacles, dt, now)
    bound = prediction_error_bound(obstacles.prediction, before, 1.0, radii)
    for i, name in enumerate(names):
        for t in np.linspace(0.0, 1.0, 11):
            points = rng.normal(size=(50, 3))
            points *= radii[i] / np.linalg.norm(points, axis=1, keepdims=True)
            states = np.array(
                [then[name], np.append(obstacles.prediction.states[i, :12], obstacles.prediction.twists[i])]
            )
            extrapolate(states, t)
            places = [points @ state[:9].reshape(3, 3) + state[9:12] for state in states]
            assert np.linalg.norm(places[0] - places[1], axis=1).max() <= bound + 1e-9
    assert prediction_error_bound(obstacles.prediction, before, 1.0, np.array([np.inf, 0.3])) == np.inf or size < 1e-9
    assert bound > 0.0 or size < 1e-9
    obstacles.reset()
    assert prediction_error_bound(obstacles.prediction, before, 1.0, radii) == np.inf
