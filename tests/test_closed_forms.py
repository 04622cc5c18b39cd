"""Closed forms of distances against coal, with a proof that nothing is closer, and where many points are closest."""

import coal
import numpy as np
import pinocchio as pin
import pytest
from conftest import BOX, CAPSULE, CYLINDER, SPHERE, random_q, random_scene
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import support

from qpavoid.control.distances import DistanceQuery
from qpavoid.kernels.distances import BY_COAL, CLOSED_FORM, compute_distances
from qpavoid.kernels.gjk import GUESS, MIN_CORE_DISTANCE
from qpavoid.model.convex_shapes import convex_shapes, pair_methods
from qpavoid.model.kinematics import ForwardKinematics

AT_ORIGIN = pin.SE3.Identity()


def found(a, b, at_a=AT_ORIGIN, at_b=AT_ORIGIN):
    """[distance, normal, point a, point b] of two bodies; None where their cores meet."""
    poses = np.array([np.concatenate((at.rotation.ravel(order="F"), at.translation)) for at in (at_a, at_b)])
    shapes, bodies, results = convex_shapes([a, b]), np.array([[0, 1]]), np.full((1, 10), np.nan)
    method, left, guesses = pair_methods(shapes, bodies), np.zeros(1, dtype=np.intp), np.zeros((1, GUESS))
    assert method[0] == CLOSED_FORM
    count = compute_distances(shapes, poses, bodies, method, np.array([0]), guesses, results, left)
    return None if count else results[0]


def by_coal(a, b, at_a, at_b):
    """Signed distance; GJK stops at 1e-10."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = 1e-10
    places = [coal.Transform3s(at.rotation, at.translation) for at in (at_a, at_b)]
    return coal.distance(a, places[0], b, places[1], request, result)


def make(rng, kinds=3):
    """A sphere, a capsule or a box."""
    return [
        lambda: coal.Sphere(rng.uniform(0.02, 0.3)),
        lambda: coal.Capsule(rng.uniform(0.02, 0.2), rng.uniform(0.05, 1.0)),
        lambda: coal.Box(*rng.uniform(0.02, 0.8, 3)),
    ][rng.integers(kinds)]()


def somewhere(rng, turned=True):
    """A random pose; along the world axes if not turned."""
    R = pin.Quaternion(rng.normal(size=4)).normalized().toRotationMatrix() if turned else np.eye(3)
    return pin.SE3(R, rng.uniform(-1.0, 1.0, 3))


def certify(result, a, b, at_a, at_b, tolerance=1e-12):
    """That no points are closer: along the normal, none of either body are farther out than the two that were found."""
    distance, normal, point_a, point_b = np.split(result, [1, 4, 7])
    np.testing.assert_allclose(point_b - point_a, distance * normal, rtol=0, atol=1e-14)
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-9)
    for body, at, point, way in ((a, at_a, point_a, normal), (b, at_b, point_b, -normal)):
        assert way @ point == pytest.approx(support(body, at)(way[None])[0], abs=tolerance)


def test_closed_forms_agree_with_coal():
    rng, apart = np.random.default_rng(0), 0
    for i in range(1500):
        a, b = make(rng), make(rng, 2)
        if i % 2:
            a, b = b, a
        at_a, at_b = somewhere(rng, i % 3 > 0), somewhere(rng, i % 3 > 0)
        result = found(a, b, at_a, at_b)
        if result is None:
            continue
        certify(result, a, b, at_a, at_b)
        distance = result[0]
        assert distance == pytest.approx(by_coal(a, b, at_a, at_b), abs=1e-9)
        apart += distance > 0.0
    assert 500 < apart < 1500


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 1e-17, 1e-9, 1e-6, 1e-3]), st.booleans())
def test_closed_forms_of_nearly_parallel_segments_are_exact(seed, tilt, box):
    rng = np.random.default_rng(seed)
    a, b = coal.Capsule(0.05, rng.uniform(0.1, 1.0)), coal.Capsule(0.05, rng.uniform(0.1, 1.0))
    if box:
        b = coal.Box(*rng.uniform(0.1, 1.0, 3))
    at_a = pin.SE3(pin.exp3(np.array([tilt, 0.0, 0.0])), np.append(rng.uniform(0.8, 1.2, 2), rng.uniform(-0.5, 0.5)))
    certify(found(a, b, at_a), a, b, at_a, AT_ORIGIN, tolerance=1e-9)


def test_closed_forms_take_the_middle_of_closest_intervals():
    one, two, box = coal.Capsule(0.1, 1.0), coal.Capsule(0.1, 0.4), coal.Box(0.6, 0.6, 0.6)
    beside = pin.SE3(np.eye(3), np.array([0.7, 0.0, 0.4]))
    # the one reaches from -0.5 to 0.5, the other from 0.2 to 0.6: they are beside each other from 0.2 to 0.5
    np.testing.assert_allclose(found(one, two, AT_ORIGIN, beside)[[0, 6, 9]], [0.5, 0.35, 0.35], atol=1e-15)
    np.testing.assert_allclose(found(box, two, AT_ORIGIN, beside)[[0, 6, 9]], [0.3, 0.25, 0.25], atol=1e-15)
    np.testing.assert_allclose(found(two, box, beside, AT_ORIGIN)[[0, 6, 9]], [0.3, 0.25, 0.25], atol=1e-15)


def test_closed_forms_skip_meeting_cores_and_nan():
    capsule, box = coal.Capsule(0.1, 0.4), coal.Box(0.2, 0.2, 0.2)
    for a, b in ((capsule, box), (box, capsule), (capsule, capsule), (coal.Sphere(0.1), box)):
        assert found(a, b) is None
        assert found(a, b, pin.SE3(np.eye(3), np.full(3, np.nan))) is None
    touching = pin.SE3(np.eye(3), np.array([0.1 + 2.0 * MIN_CORE_DISTANCE, 0.0, 0.0]))
    np.testing.assert_allclose(
        found(box, capsule, AT_ORIGIN, touching)[:2], [2.0 * MIN_CORE_DISTANCE - 0.1, 1.0], atol=1e-9
    )


def test_distance_query_agrees_with_coal(panda):
    """Deep in penetration, too, with shapes of all kinds."""
    rng = np.random.default_rng(3)
    scene = random_scene(panda, rng, [SPHERE, CAPSULE, BOX, CYLINDER] * 2)
    model = scene.robot.model
    query, kinematics, deep = DistanceQuery(scene), ForwardKinematics(model), 0
    closed = query.table.method == CLOSED_FORM
    assert 0 < closed.sum() < len(scene.pairs) and not (query.table.method == BY_COAL).any()
    alone, geometry_data, data = scene.geometry, scene.geometry.createData(), model.createData()
    for request in geometry_data.distanceRequests:
        request.gjk_tolerance = 1e-10
    for _ in range(40):
        q = random_q(panda, rng, spread=1.5)
        kinematics.compute(q)
        query.compute(kinematics.joint_poses, 0.2)
        pin.updateGeometryPlacements(model, data, alone, geometry_data, q)
        pin.computeDistances(alone, geometry_data)
        exact = np.array([result.min_distance for result in geometry_data.distanceResults])
        np.testing.assert_allclose(query.arrays.results[query.pairs, 0], exact[query.pairs], rtol=0, atol=1e-7)
        near = np.flatnonzero(exact < 0.2)
        assert np.isin(near, query.pairs).all()
        deep += int((exact[closed] < -0.1).sum())
    assert deep > 20
