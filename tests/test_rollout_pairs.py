"""Distances along a rollout: bounds where they are not computed anew, the distances themselves where that matters."""

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import Obstacle, Robot, build_scene, kernels
from qpavoid.config import Box, Capsule, Cylinder, HalfSpace, Sphere
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.kernels.rollout_pairs import forget_pairs, near_pairs_along
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.sample import Sample
from qpavoid.safety.rollout import lay_out_pairs

INFLUENCE, PREFERRED = 0.25, 0.1


class Walk:
    """A robot and obstacles that go on at random, with distances along the way, and exact ones."""

    def __init__(self, robot, seed, shapes):
        self.rng, count = np.random.default_rng(seed), len(shapes)
        places = self.rng.uniform(-0.8, 0.8, (count, 3)) + np.array([0.0, 0.0, 0.5])
        obstacles = [
            Obstacle.at(f"o{i}", shape, place) for i, (shape, place) in enumerate(zip(shapes, places, strict=True))
        ]
        self.scene = build_scene(robot, obstacles)
        self.kinematics = ForwardKinematics(robot.model)
        self.query, self.exact = DistanceQuery(self.scene), DistanceQuery(self.scene)
        self.query.set_influence_distance(INFLUENCE)
        self.pairs = lay_out_pairs(self.query)
        self.samples = [Sample.at(place) for place in places]
        self.q, self.velocities = robot.home, self.rng.normal(size=(count, 6)) * [0.4, 0.4, 0.4, 1.0, 1.0, 1.0]
        forget_pairs(self.query.packed, self.pairs)

    def advance(self, dt=0.01, speed=0.5):
        """Go on for dt, robot and obstacles."""
        model = self.scene.robot.model
        self.q = pin.integrate(model, self.q, dt * speed * self.rng.normal(size=model.nv))
        for i, (sample, velocity) in enumerate(zip(self.samples, self.velocities, strict=True)):
            turned = pin.exp3(dt * velocity[3:]) @ sample.rotation
            self.samples[i] = Sample.at(sample.position + dt * velocity[:3], turned)

    def measure(self):
        """Return the pairs with a row, their results, their bounds, and the exact distances of all (m,)."""
        states = ObstacleStates.of(self.samples)
        self.kinematics.compute(self.q)
        self.query.place(states)
        kernels.place_bodies(self.query.packed, self.kinematics.joint_poses)
        near_pairs_along(self.query.packed, self.pairs, INFLUENCE, PREFERRED)
        self.query.finish()
        self.exact.place(states)
        self.exact.compute(self.kinematics.joint_poses, INFLUENCE)
        distances = np.full(len(self.scene.pairs), np.inf)
        distances[self.exact.pairs] = self.exact.arrays.results[self.exact.pairs, 0]
        rows = self.query.pairs.copy()
        return rows, self.query.arrays.results[rows].copy(), self.pairs.bounds[rows], distances


SHAPES = [Sphere(radius=0.05), Box(size=(0.3, 0.02, 0.1)), Capsule(radius=0.04, length=0.3)] * 3 + [HalfSpace()]
CURVED = [Cylinder(radius=0.05, length=0.3), Box(size=(0.2, 0.2, 0.01))] * 4


@pytest.mark.parametrize("robot", ["panda", "panda-capsules", "baxter"])
@pytest.mark.parametrize("shapes", [SHAPES, CURVED], ids=["closed", "gjk"])
def test_bounds_hold_and_near_pairs_are_computed_at_every_pose(robot, shapes):
    walk, kept, computed = Walk(Robot.load(robot), 3, shapes), 0, 0
    for _ in range(40):
        walk.advance()
        rows, results, bounds, distances = walk.measure()
        is_kept = bounds < np.inf
        kept, computed = kept + is_kept.sum(), computed + (~is_kept).sum()
        # none that gets a row is missing, and the lower bounds and those of the witness points enclose the distance
        assert set(np.flatnonzero(distances < INFLUENCE)) <= set(rows.tolist())
        assert (bounds[is_kept] <= distances[rows[is_kept]] + 1e-9).all() and (bounds[is_kept] >= PREFERRED).all()
        near = is_kept & np.isfinite(distances[rows])
        assert (results[near, 0] >= distances[rows[near]] - 1e-9).all()
        assert (results[is_kept, 0] - bounds[is_kept] <= 0.25 * bounds[is_kept]).all()
        np.testing.assert_allclose(results[~is_kept, 0], distances[rows[~is_kept]], rtol=0, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(results[:, 1:4], axis=1), 1.0, rtol=0, atol=1e-9)
    assert kept > 100 and computed > 100


def test_what_rests_is_computed_once():
    walk = Walk(Robot.load("panda-capsules"), 1, SHAPES[:3])
    walk.velocities[:] = 0.0
    first = walk.measure()
    walk.advance(speed=0.0)
    rows, _, bounds, _ = walk.measure()
    near = first[1][:, 0] < PREFERRED
    assert np.isinf(first[2]).all() and (first[1][:, 0] < INFLUENCE).any()
    again = set(rows[np.isinf(bounds)].tolist())
    assert again == set(first[0][near].tolist())


@pytest.mark.parametrize("shapes", [SHAPES, CURVED], ids=["closed", "gjk"])
def test_a_step_leaves_out_only_what_is_certainly_beyond(shapes):
    """With margins that grow, too: what is nearer than the influence distance has the results of a search anew."""
    walk, left_out = Walk(Robot.load("panda"), 5, shapes), 0
    for k in range(60):
        walk.advance(dt=0.004)
        states = ObstacleStates.of(walk.samples, 1e-3 * k)
        walk.kinematics.compute(walk.q)
        for query, beyond in ((walk.query, INFLUENCE), (walk.exact, np.inf)):
            query.place(states)
            query.set_influence_distance(INFLUENCE)
            kernels.place_bodies(query.packed, walk.kinematics.joint_poses)
            kernels.near_pairs(query.packed, beyond)
            query.finish()
        x, every = walk.query.arrays, walk.exact.pairs
        distances = walk.exact.arrays.results[every, 0] - walk.exact.arrays.margin[x.twist_row[every]]
        near = every[distances < INFLUENCE]
        assert set(near.tolist()) <= set(walk.query.pairs.tolist())
        np.testing.assert_allclose(x.results[near, 0], walk.exact.arrays.results[near, 0], rtol=0, atol=1e-6)
        left_out += len(every) - len(walk.query.pairs)
    assert left_out > 100
