"""GJK of convex bodies: proven by support functions, and against coal, for all kinds of shapes, sizes and positions."""

import coal
import numpy as np
import pinocchio as pin
import pytest
from oracle import support
from test_closed_forms import by_coal, certify, somewhere

from qpavoid.geometry.meshes import convex_hull
from qpavoid.kernels.distances import BY_COAL, BY_GJK, TO_HALF_SPACE, compute_distances
from qpavoid.kernels.gjk import GUESS
from qpavoid.model.convex_shapes import convex_shapes, pair_methods, write_shape

LARGEST_SEARCH = 60
"""Iterations of a search, at most."""


def sphere_points(rng, count):
    p = rng.normal(size=(count, 3))
    return p / np.linalg.norm(p, axis=1, keepdims=True)


MAKE = {
    "sphere": lambda rng: coal.Sphere(rng.uniform(0.02, 0.3)),
    "capsule": lambda rng: coal.Capsule(*rng.uniform(0.02, 0.3, 2)),
    "box": lambda rng: coal.Box(*rng.uniform(0.02, 0.6, 3)),
    "cylinder": lambda rng: coal.Cylinder(*rng.uniform(0.02, 0.4, 2)),
    "cone": lambda rng: coal.Cone(*rng.uniform(0.02, 0.4, 2)),
    "ellipsoid": lambda rng: coal.Ellipsoid(*rng.uniform(0.02, 0.3, 3)),
    "hull": lambda rng: convex_hull(0.2 * rng.normal(size=(rng.integers(4, 20), 3)) + rng.normal(size=3)),
    "large hull": lambda rng: convex_hull(0.3 * sphere_points(rng, rng.integers(30, 200))),
}
POLYTOPES = {"box", "hull", "large hull"}


def scaled(body, factor):
    match body:
        case coal.Sphere():
            return coal.Sphere(factor * body.radius)
        case coal.Box():
            return coal.Box(*(2.0 * factor * body.halfSide))
        case coal.Ellipsoid():
            return coal.Ellipsoid(*(factor * body.radii))
        case coal.ConvexBase():
            return convex_hull(factor * np.array(body.points()))
    return type(body)(factor * body.radius, 2.0 * factor * body.halfLength)


@pytest.fixture(scope="module")
def bodies():
    """20 of each kind about as large as a link, 20 of 1 mm, 20 of some metres."""
    rng = np.random.default_rng(0)
    small = {kind: [make(rng) for _ in range(20)] for kind, make in MAKE.items()}
    return {
        (kind, size): [scaled(body, size) for body in some]
        for kind, some in small.items()
        for size in (1.0, 0.004, 20.0)
    }


class Pair:
    """Two bodies as the kernels take them; remembers where its last search ended."""

    def __init__(self, a, b):
        self.shapes, self.bodies = convex_shapes([a, b]), np.array([[0, 1]])
        self.method = pair_methods(self.shapes, self.bodies)
        self.guesses = np.zeros((1, GUESS))

    def search(self, at_a, at_b):
        """[distance, normal, point a, point b]; None where coal is to compute it."""
        poses = np.array([np.concatenate((at.rotation.ravel(order="F"), at.translation)) for at in (at_a, at_b)])
        results, left = np.full((1, 10), np.nan), np.zeros(1, dtype=np.intp)
        count = compute_distances(
            self.shapes, poses, self.bodies, self.method, np.array([0]), self.guesses, results, left
        )
        assert self.guesses[0, 3] <= LARGEST_SEARCH
        return None if count else results[0]

    @property
    def radii(self):
        return float(self.shapes.core[:, 0].sum())


def draw(rng, bodies, sizes=(1.0,)):
    """Two bodies of any kinds that GJK is for, somewhere near each other; turned at random, along axes, or alike."""
    kinds = list(MAKE)
    while True:
        one, two = rng.choice(kinds, 2)
        if {one, two} <= {"sphere", "capsule"} or ("box" in (one, two) and {"sphere", "capsule"} & {one, two}):
            continue
        size_a, size_b = rng.choice(sizes, 2) if rng.random() < 0.3 else [rng.choice(sizes)] * 2
        a, b = (bodies[kind, size][rng.integers(20)] for kind, size in ((one, size_a), (two, size_b)))
        at_a, at_b = somewhere(rng, rng.random() < 0.7), somewhere(rng, rng.random() < 0.7)
        if rng.random() < 0.3:  # nearly parallel
            tilt = 10.0 ** rng.uniform(-12, -3) * rng.normal(size=3)
            at_b = pin.SE3(at_a.rotation @ pin.exp3(tilt), at_b.translation)
        reach = 0.7 * max(size_a, size_b)
        at_a.translation *= reach
        at_b.translation *= reach
        return (one, two), max(size_a, size_b), a, b, at_a, at_b


def gap(a, b, at_a, at_b, normal):
    """How far bodies are apart along a direction: no distance is less."""
    return float(-support(a, at_a)(normal[None])[0] - support(b, at_b)(-normal[None])[0])


@pytest.mark.parametrize("seed", range(3))
def test_gjk_agrees_with_coal_and_is_proven(bodies, seed):
    rng, apart, given_up = np.random.default_rng(seed), 0, 0
    for _ in range(1000):
        kinds, _, a, b, at_a, at_b = draw(rng, bodies)
        pair = Pair(a, b)
        assert pair.method[0] == BY_GJK
        result, expected = pair.search(at_a, at_b), by_coal(a, b, at_a, at_b)
        if result is None:
            given_up += expected + pair.radii > 1e-6
            continue
        apart += 1
        certify(result, a, b, at_a, at_b, tolerance=1e-9 if set(kinds) <= POLYTOPES | {"capsule"} else 1e-8)
        assert result[0] == pytest.approx(expected, abs=1e-7)
    assert apart > 500 and given_up <= 1


@pytest.mark.parametrize("seed", range(3))
def test_gjk_is_proven_of_bodies_from_a_millimetre_to_ten_metres(bodies, seed):
    """coal is off by up to 1e-4 m here: the gap along the normal, and the points that are closest, are the proof."""
    rng, apart, given_up = np.random.default_rng(10 + seed), 0, 0
    for _ in range(1000):
        _, size, a, b, at_a, at_b = draw(rng, bodies, (0.004, 1.0, 20.0))
        pair = Pair(a, b)
        result = pair.search(at_a, at_b)
        if result is None:
            given_up += by_coal(a, b, at_a, at_b) + pair.radii > 1e-5 * size
            continue
        apart += 1
        certify(result, a, b, at_a, at_b, tolerance=1e-7)
        assert 0.0 <= result[0] - gap(a, b, at_a, at_b, result[1:4]) + 1e-12 * size < 1e-8 * max(size, 1.0)
    assert apart > 500 and given_up <= 5


def test_gjk_is_exact_up_to_touching(bodies):
    rng, apart, given_up = np.random.default_rng(20), 0, 0
    while apart < 1000:
        kinds, _, a, b, at_a, at_b = draw(rng, bodies)
        pair = Pair(a, b)
        result = pair.search(at_a, at_b)
        if result is None:
            continue
        distance = 10.0 ** rng.uniform(-5, -2)
        at_b = pin.SE3(at_b.rotation, at_b.translation - (result[0] + pair.radii - distance) * result[1:4])
        result = pair.search(at_a, at_b)
        apart += 1
        if result is None:
            given_up += 1
            continue
        assert result[0] + pair.radii == pytest.approx(distance, abs=1e-8)
        if set(kinds) <= POLYTOPES:
            certify(result, a, b, at_a, at_b, tolerance=1e-9)
    assert given_up <= 5


def test_gjk_does_not_find_bodies_apart_that_overlap(bodies):
    rng, overlapping = np.random.default_rng(30), 0
    for _ in range(1500):
        _, _, a, b, at_a, at_b = draw(rng, bodies, (0.004, 1.0, 20.0))
        at_b.translation += 0.6 * (at_a.translation - at_b.translation)
        pair = Pair(a, b)
        depth = by_coal(a, b, at_a, at_b) + pair.radii
        if depth < -1e-4:
            overlapping += 1
            assert pair.search(at_a, at_b) is None
    assert overlapping > 300


def test_gjk_does_not_depend_on_where_the_search_starts(bodies):
    """From where it ended at another pose, near or far; normals are equal to 1e-4."""
    rng, apart = np.random.default_rng(40), 0
    for _ in range(1000):
        _, _, a, b, at_a, at_b = draw(rng, bodies)
        cold = Pair(a, b).search(at_a, at_b)
        if cold is None or cold[0] < 1e-3:
            continue
        apart += 1
        pair = Pair(a, b)
        pair.search(at_a * pin.exp6(rng.normal(size=6) * 10.0 ** rng.uniform(-4, 1)), at_b)
        warm = pair.search(at_a, at_b)
        assert warm[0] == pytest.approx(cold[0], abs=1e-8)
        np.testing.assert_allclose(warm[1:4], cold[1:4], atol=1e-4)
    assert apart > 500


def test_gjk_of_polytopes_that_moved_a_little_looks_once(bodies):
    rng, iterations = np.random.default_rng(50), []
    for _ in range(300):
        a, b = (bodies[kind, 1.0][rng.integers(20)] for kind in rng.choice(sorted(POLYTOPES), 2))
        at_a, at_b, pair = somewhere(rng), somewhere(rng), Pair(a, b)
        if pair.search(at_a, at_b) is not None:
            pair.search(at_a * pin.exp6(1e-3 * rng.normal(size=6)), at_b)
            iterations.append(pair.guesses[0, 3])
    assert len(iterations) > 100 and np.median(iterations) == 1 and max(iterations) <= 8


def test_gjk_swaps_with_the_bodies(bodies):
    rng = np.random.default_rng(60)
    for _ in range(200):
        _, _, a, b, at_a, at_b = draw(rng, bodies)
        one, two = Pair(a, b).search(at_a, at_b), Pair(b, a).search(at_b, at_a)
        assert (one is None) == (two is None)
        if one is not None:
            np.testing.assert_allclose(two[0], one[0], atol=1e-9)
            if one[0] > 1e-3:
                np.testing.assert_allclose(two[1:4], -one[1:4], atol=1e-4)


def test_gjk_leaves_nan_to_coal(bodies):
    rng, nowhere = np.random.default_rng(70), pin.SE3(np.eye(3), np.full(3, np.nan))
    for kind in MAKE:
        a, b = bodies[kind, 1.0][0], bodies["cylinder", 1.0][0]
        pair = Pair(a, b)
        assert pair.search(nowhere, somewhere(rng)) is None
        assert pair.search(somewhere(rng), pin.SE3(np.eye(3), np.array([5.0, 0.0, 0.0]))) is not None  # as if new


@pytest.mark.parametrize("first", [True, False])
def test_half_space_is_as_coal_has_it(bodies, first):
    """In penetration, too; with the middle of a face or edge that is parallel to it."""
    rng, ground = np.random.default_rng(80), coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
    for kind in MAKE:
        for turned in (True, False) * 10:
            body, at, plane = bodies[kind, 1.0][rng.integers(20)], somewhere(rng, turned), somewhere(rng, turned)
            pair = Pair(ground, body) if first else Pair(body, ground)
            assert pair.method[0] == TO_HALF_SPACE
            result = pair.search(plane, at) if first else pair.search(at, plane)
            normal = plane.rotation[:, 2] if first else -plane.rotation[:, 2]
            up = plane.rotation[:, 2]
            deepest = -support(body, at)(-up[None])[0]
            assert result[0] == pytest.approx(deepest - up @ plane.translation, abs=1e-11)
            np.testing.assert_allclose(result[1:4], normal, atol=1e-15)
            np.testing.assert_allclose(result[7:10] - result[4:7], result[0] * normal, atol=1e-12)
            point = result[7:10] if first else result[4:7]
            assert up @ point == pytest.approx(deepest, abs=1e-11)
            if not turned and kind in ("box", "cylinder", "capsule"):
                np.testing.assert_allclose(point[:2], at.translation[:2], atol=1e-12)


def test_shapes_of_spare_slots_are_as_if_they_had_been_there(bodies):
    """A hull that there is no room for is for coal."""
    rng, wall, other = np.random.default_rng(90), coal.Box(0.2, 1.0, 1.0), bodies["hull", 1.0][0]
    spare, many = Pair(coal.Capsule(0.05, 0.0), wall), convex_hull(sphere_points(rng, 600))
    spare.shapes = convex_shapes([coal.Capsule(0.05, 0.0), wall, other], spare=[0])
    for kind in [*MAKE, *reversed(MAKE)]:
        body, at = bodies[kind, 1.0][rng.integers(20)], (somewhere(rng), somewhere(rng))
        write_shape(spare.shapes, 0, body)
        spare.method, spare.guesses[:] = pair_methods(spare.shapes, spare.bodies), 0.0
        result, expected = spare.search(*at), Pair(body, wall).search(*at)
        assert (result is None) == (expected is None)
        if result is not None:
            np.testing.assert_array_equal(result, expected)
        np.testing.assert_array_equal(
            spare.shapes.vertices[spare.shapes.span[2, 0] : spare.shapes.span[2, 1]], other.points()
        )
    write_shape(spare.shapes, 0, many)
    assert pair_methods(spare.shapes, np.array([[0, 1], [2, 1]])).tolist() == [BY_COAL, BY_GJK]
