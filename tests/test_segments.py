"""The closed distance formulas against a convex solver, a duality certificate, coal and known cases."""

import coal
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from qpavoid.geometry.segments import capsule_distances, line_parameters, point_segment, segment_segment

FloatArray = NDArray[np.float64]
TOL = 1e-9


def vec(*x: float) -> FloatArray:
    return np.array(x, dtype=np.float64)


# A coarse lattice makes parallel, collinear, crossing and zero-length cases common, floats make general ones.
coordinate = st.one_of(st.integers(-3, 3).map(float), st.floats(-3.0, 3.0, allow_subnormal=False))
point = st.tuples(coordinate, coordinate, coordinate).map(lambda x: np.array(x, dtype=np.float64))
segments = st.tuples(point, point, point, point)
# Two cases whose distances agree to rounding differ by up to its root, 1e-8, in direction. Where directions
# are compared to 1e-9, the ends lie on a lattice of 1/8 m: there two cases are either equal or well apart.
lattice_point = st.tuples(*[st.integers(-24, 24)] * 3).map(lambda x: np.array(x, dtype=np.float64) / 8)
lattice_segments = st.tuples(lattice_point, lattice_point, lattice_point, lattice_point)
rotation = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(lambda r: Rotation.from_rotvec(r).as_matrix())


def bounded_least_squares(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> float:
    """Minimise |a + m (b - a) - c - n (d - c)| over 0 <= m, n <= 1 with an active-set solver."""
    matrix = np.column_stack([b - a, c - d])
    best = lsq_linear(matrix, c - a, bounds=(0.0, 1.0), method="bvls", tol=1e-15)
    return float(np.linalg.norm(matrix @ best.x - (c - a)))


def on_segment(p: FloatArray, a: FloatArray, b: FloatArray) -> bool:
    """Whether |pa| + |pb| = |ab| and p is on the line."""
    t = np.dot(p - a, b - a) / max(np.dot(b - a, b - a), 1e-300)
    return bool(-TOL <= t <= 1 + TOL and np.allclose(a + t * (b - a), p, rtol=0, atol=TOL))


def coal_capsule(a: FloatArray, b: FloatArray, radius: float) -> tuple[coal.ShapeBase, coal.Transform3s]:
    """The same capsule for coal: centred at the middle, its axis along z; a sphere when a = b."""
    length = float(np.linalg.norm(b - a))
    if length == 0.0:
        return coal.Sphere(radius), coal.Transform3s(np.eye(3), a)
    z = (b - a) / length
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    frame = np.column_stack([x, np.cross(z, x), z])
    return coal.Capsule(radius, length), coal.Transform3s(frame, (a + b) / 2)


# ---------------------------------------------------------------------------------------- point to segment


@pytest.mark.parametrize(
    ("p", "distance", "foot"),
    [
        (vec(0.5, 3, 4), 5.0, vec(0.5, 0, 0)),
        (vec(-3, 0, 4), 5.0, vec(0, 0, 0)),  # before a: the axial 3 counts, eq. 2 as printed says 4
        (vec(5, 3, 0), 5.0, vec(1, 0, 0)),
        (vec(2, 0, 0), 1.0, vec(1, 0, 0)),
        (vec(0.25, 0, 0), 0.0, vec(0.25, 0, 0)),
    ],
)
def test_point_segment_known(p: FloatArray, distance: float, foot: FloatArray) -> None:
    result = point_segment(p, vec(0, 0, 0), vec(1, 0, 0))
    assert result.distance == pytest.approx(distance, abs=TOL)
    np.testing.assert_allclose(result.point, foot, rtol=0, atol=TOL)


def test_point_segment_of_zero_length_is_a_point() -> None:
    result = point_segment(vec(3, 4, 1), vec(0, 0, 1), vec(0, 0, 1))
    assert result.distance == 5.0
    np.testing.assert_array_equal(result.point, vec(0, 0, 1))


@given(point, point, point, st.floats(0.0, 1.0))
def test_point_segment_is_the_minimum(p: FloatArray, a: FloatArray, b: FloatArray, t: float) -> None:
    result = point_segment(p, a, b)
    assert on_segment(result.point, a, b)
    assert result.distance == pytest.approx(np.linalg.norm(p - result.point), abs=TOL)
    assert result.distance <= np.linalg.norm(p - (a + t * (b - a))) + TOL
    # The residual makes no acute angle with any direction that stays inside: the optimality of a projection.
    assert max(np.dot(p - result.point, x - result.point) for x in (a, b)) <= TOL


# ---------------------------------------------------------------------------------------- lines


def test_line_parameters_known() -> None:
    parameters = line_parameters(vec(0, 0, 0), vec(1, 0, 0), vec(3, -2, 7), vec(3, 2, 7))
    np.testing.assert_allclose(parameters, [3.0, 0.5], rtol=0, atol=TOL)


@given(segments)
def test_line_parameters_give_the_common_normal(points: tuple[FloatArray, ...]) -> None:
    a, b, c, d = points
    u, v = b - a, d - c
    sine = np.linalg.norm(np.cross(u, v)) / max(np.linalg.norm(u) * np.linalg.norm(v), 1e-300)
    assume(sine > 0.05 and min(np.linalg.norm(u), np.linalg.norm(v)) > 0.05)
    m, n = line_parameters(a, b, c, d)
    gap = c + n * v - (a + m * u)
    np.testing.assert_allclose([gap @ u, gap @ v], 0.0, atol=TOL)
    expected = np.linalg.solve([[u @ u, -u @ v], [u @ v, -v @ v]], [u @ (c - a), v @ (c - a)])
    np.testing.assert_allclose([m, n], expected, rtol=1e-7, atol=TOL)


@pytest.mark.parametrize("v", [vec(1, 2, 3), vec(-2, -4, -6), vec(0, 0, 0)])
def test_line_parameters_are_nan_when_not_unique(v: FloatArray) -> None:
    a, c = vec(0, 0, 0), vec(1, -1, 0)
    assert np.isnan(line_parameters(a, vec(1, 2, 3), c, c + v)).all()
    assert np.isnan(line_parameters(c, c + v, a, vec(1, 2, 3))).all()


def test_line_parameters_are_nan_when_parallel_to_rounding() -> None:
    u, c = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 1000, 3))
    a = np.zeros_like(u)
    assert np.any(np.cross(u, (c + u / 3) - c) != 0.0)  # the directions do differ in their last digits
    assert np.isnan(line_parameters(a, u, c, c + u / 3)).all()


# ---------------------------------------------------------------------------------------- segment to segment

KNOWN = {
    "crossing above": (vec(-1, 0, 0), vec(1, 0, 0), vec(0, -1, 2), vec(0, 1, 2), 2.0),
    "intersecting": (vec(-1, 0, 0), vec(1, 0, 0), vec(0, -1, 0), vec(0, 1, 0), 0.0),
    "T: end above interior": (vec(-1, 0, 0), vec(1, 0, 0), vec(0.5, 3, 0), vec(0.5, 9, 0), 3.0),
    "end to end": (vec(0, 0, 0), vec(1, 0, 0), vec(4, 4, 0), vec(4, 9, 1), 5.0),
    "sharing an end": (vec(0, 0, 0), vec(1, 0, 0), vec(1, 0, 0), vec(1, 5, 2), 0.0),
    "parallel side by side": (vec(0, 0, 0), vec(2, 0, 0), vec(1, 1, 0), vec(5, 1, 0), 1.0),
    "parallel, opposite sense": (vec(0, 0, 0), vec(2, 0, 0), vec(5, 1, 0), vec(1, 1, 0), 1.0),
    "parallel, one inside the other": (vec(0, 0, 0), vec(9, 0, 0), vec(4, 0, 2), vec(5, 0, 2), 2.0),
    "parallel past each other": (vec(0, 0, 0), vec(1, 0, 0), vec(4, 4, 0), vec(7, 4, 0), 5.0),
    "collinear apart": (vec(0, 0, 0), vec(1, 1, 1), vec(2, 2, 2), vec(3, 3, 3), np.sqrt(3)),
    "collinear overlapping": (vec(0, 0, 0), vec(2, 2, 2), vec(1, 1, 1), vec(3, 3, 3), 0.0),
    "collinear overlapping, along z": (vec(0, 0, 0), vec(0, 0, 2), vec(0, 0, 1), vec(0, 0, 3), 0.0),
    "identical": (vec(0, 1, 2), vec(2, 3, 5), vec(0, 1, 2), vec(2, 3, 5), 0.0),
    "point and segment": (vec(0.5, 2, 0), vec(0.5, 2, 0), vec(0, 0, 0), vec(1, 0, 0), 2.0),
    "point on the segment": (vec(1, 2, 3), vec(1, 2, 3), vec(0, 1, 2), vec(3, 4, 5), 0.0),
    "two points": (vec(0, 0, 0), vec(0, 0, 0), vec(2, 3, 6), vec(2, 3, 6), 7.0),
    "same point": (vec(1, 2, 3), vec(1, 2, 3), vec(1, 2, 3), vec(1, 2, 3), 0.0),
}


@pytest.mark.parametrize(("a", "b", "c", "d", "distance"), KNOWN.values(), ids=KNOWN.keys())
def test_segment_segment_known(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, distance: float) -> None:
    for ab in ((a, b), (b, a)):
        for cd in ((c, d), (d, c)):
            assert segment_segment(*ab, *cd).distance == pytest.approx(distance, abs=TOL)
            assert segment_segment(*cd, *ab).distance == pytest.approx(distance, abs=TOL)


@pytest.mark.parametrize(
    ("d", "n", "clamped"), [(vec(6, 3, 0), 0.5, 2.0), (vec(2.9, -0.1, 0), 3 / 2.9, np.hypot(1.9, 0.1))]
)
def test_clamping_one_by_one_would_be_wrong(d: FloatArray, n: float, clamped: float) -> None:
    """The line y = x - 3 meets the x axis at x = 3, past b = (1, 0): the minimum is b to that line, √2."""
    a, b, c = vec(0, 0, 0), vec(1, 0, 0), vec(0, -3, 0)
    np.testing.assert_allclose(line_parameters(a, b, c, d), [3.0, n], rtol=0, atol=TOL)
    assert np.linalg.norm(c + min(n, 1.0) * (d - c) - b) == pytest.approx(clamped)
    assert segment_segment(a, b, c, d).distance == pytest.approx(np.sqrt(2), abs=TOL)


@given(lattice_segments)
def test_witnesses_carry_a_proof_of_the_minimum(points: tuple[FloatArray, ...]) -> None:
    """Weak duality: the slab between the ends along any unit vector bounds the distance from below.

    That the witnesses' own direction attains the bound proves that no other pair of points is closer.
    """
    a, b, c, d = points
    distance, point_ab, point_cd = segment_segment(a, b, c, d)
    assume(distance > 1e-4)
    n = (point_cd - point_ab) / distance
    assert distance == pytest.approx(min(n @ c, n @ d) - max(n @ a, n @ b), abs=TOL)


@given(segments)
def test_segment_segment_is_the_minimum(points: tuple[FloatArray, ...]) -> None:
    a, b, c, d = points
    distance, point_ab, point_cd = segment_segment(a, b, c, d)
    assert on_segment(point_ab, a, b)
    assert on_segment(point_cd, c, d)
    assert distance == pytest.approx(np.linalg.norm(point_cd - point_ab), abs=TOL)
    assert distance == pytest.approx(bounded_least_squares(a, b, c, d), abs=TOL)


def test_segment_segment_equals_bounded_least_squares() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-1.0, 1.0, (4, 1000, 3))
    distance = segment_segment(*points).distance
    expected = [bounded_least_squares(*points[:, i]) for i in range(points.shape[1])]
    np.testing.assert_allclose(distance, expected, rtol=0, atol=TOL)
    m, n = line_parameters(*points)
    inside = (abs(m - 0.5) < 0.5) & (abs(n - 0.5) < 0.5)
    assert 50 < inside.sum() < 950  # both branches were compared


@pytest.mark.parametrize("angle", 10.0 ** -np.arange(1, 17))
@pytest.mark.parametrize("height", [0.0, 1e-6, 0.3])
def test_nearly_parallel(angle: float, height: float) -> None:
    """Two metres turned by a small angle about their common normal, `height` apart, in a general frame."""
    frame = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    u, v = frame @ vec(1, 0, 0), frame @ vec(np.cos(angle), np.sin(angle), 0)
    lift = frame @ vec(0, 0, height)
    for shift in (0.0, 0.4, -0.9):  # the axes cross at this place of u
        result = segment_segment(-u, u, shift * u - v + lift, shift * u + v + lift)
        assert result.distance == pytest.approx(height, abs=TOL)


@given(segments, rotation, point)
def test_distance_is_symmetric_and_invariant(
    points: tuple[FloatArray, ...], turn: FloatArray, shift: FloatArray
) -> None:
    a, b, c, d = points
    distance = segment_segment(a, b, c, d).distance
    assert segment_segment(c, d, a, b).distance == pytest.approx(distance, abs=TOL)
    moved = [turn @ p + shift for p in points]
    assert segment_segment(*moved).distance == pytest.approx(distance, abs=TOL)


@given(lattice_segments, rotation, lattice_point)
def test_gap_turns_with_the_segments(points: tuple[FloatArray, ...], turn: FloatArray, shift: FloatArray) -> None:
    """The witnesses of parallel axes may jump, the vector between them may not: it is unique."""
    a, b, c, d = points
    here, swapped = segment_segment(a, b, c, d), segment_segment(c, d, a, b)
    there = segment_segment(*[turn @ p + shift for p in points])
    gap = here.point_cd - here.point_ab
    np.testing.assert_allclose(swapped.point_ab - swapped.point_cd, gap, rtol=0, atol=TOL)
    np.testing.assert_allclose(there.point_cd - there.point_ab, turn @ gap, rtol=0, atol=TOL)


# ---------------------------------------------------------------------------------------- capsules


def random_capsules(m: int, seed: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Capsules about as long as a robot's links; every third a is a sphere, every fourth b."""
    rng = np.random.default_rng(seed)
    ends_a, ends_b = rng.uniform(-0.5, 0.5, (2, m, 2, 3))
    ends_a[::3, 1], ends_b[::4, 1] = ends_a[::3, 0], ends_b[::4, 0]
    radii_a, radii_b = rng.uniform(0.01, 0.1, (2, m))
    return ends_a, radii_a, ends_b, radii_b


def test_capsules_equal_coal() -> None:
    ends_a, radii_a, ends_b, radii_b = random_capsules(600, 2)
    result = capsule_distances(ends_a, radii_a, ends_b, radii_b)
    axis = result.distance + radii_a + radii_b
    assert (result.distance < -0.01).sum() > 20 and (result.distance > 0.01).sum() > 200
    for i in range(len(axis)):
        shape_a, pose_a = coal_capsule(ends_a[i, 0], ends_a[i, 1], radii_a[i])
        shape_b, pose_b = coal_capsule(ends_b[i, 0], ends_b[i, 1], radii_b[i])
        answer = coal.DistanceResult()
        distance = coal.distance(shape_a, pose_a, shape_b, pose_b, coal.DistanceRequest(), answer)
        assert result.distance[i] == pytest.approx(distance, abs=TOL)
        # Directions: coal's own round-off is divided by the axis distance.
        np.testing.assert_allclose(result.normal[i], answer.normal, rtol=0, atol=TOL / axis[i])
        np.testing.assert_allclose(result.point_a[i], answer.getNearestPoint1(), rtol=0, atol=TOL / axis[i])
        np.testing.assert_allclose(result.point_b[i], answer.getNearestPoint2(), rtol=0, atol=TOL / axis[i])


def test_capsules_in_one_call_equal_one_by_one() -> None:
    ends_a, radii_a, ends_b, radii_b = random_capsules(50, 3)
    together = capsule_distances(ends_a, radii_a, ends_b, radii_b)
    for i in range(50):
        k = slice(i, i + 1)
        alone = capsule_distances(ends_a[k], radii_a[k], ends_b[k], radii_b[k])
        for x, y in zip(together, alone, strict=True):
            np.testing.assert_allclose(x[k], y, rtol=0, atol=1e-14)
        axis = segment_segment(*ends_a[i], *ends_b[i]).distance
        assert together.distance[i] == pytest.approx(axis - radii_a[i] - radii_b[i], abs=1e-14)


def test_capsule_witnesses_lie_on_the_surfaces() -> None:
    ends_a, radii_a, ends_b, radii_b = random_capsules(300, 4)
    distance, normal, point_a, point_b = capsule_distances(ends_a, radii_a, ends_b, radii_b)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=0, atol=TOL)
    np.testing.assert_allclose(point_b - point_a, distance[:, None] * normal, rtol=0, atol=TOL)
    np.testing.assert_allclose(point_segment(point_a, ends_a[:, 0], ends_a[:, 1]).distance, radii_a, atol=TOL)
    np.testing.assert_allclose(point_segment(point_b, ends_b[:, 0], ends_b[:, 1]).distance, radii_b, atol=TOL)


def test_normal_is_the_gradient_of_the_distance() -> None:
    """What the avoidance rows rest on: d' = n · v when body b moves with v, overlapping or not."""
    ends_a, radii_a, ends_b, radii_b = random_capsules(300, 5)
    result = capsule_distances(ends_a, radii_a, ends_b, radii_b)
    apart = result.distance + radii_a + radii_b > 0.02
    h = 1e-5
    gradient = np.empty_like(result.normal)
    for k, step in enumerate(h * np.eye(3)):
        plus = capsule_distances(ends_a, radii_a, ends_b + step, radii_b).distance
        minus = capsule_distances(ends_a, radii_a, ends_b - step, radii_b).distance
        gradient[:, k] = (plus - minus) / (2 * h)
    # Next to a border between two cases the second derivative jumps: an error of h / (2 d), not h².
    np.testing.assert_allclose(gradient[apart], result.normal[apart], rtol=0, atol=h / 0.02)


@pytest.mark.parametrize("name", [name for name, case in KNOWN.items() if case[-1] == 0.0])
def test_intersecting_axes_still_have_a_normal(name: str) -> None:
    a, b, c, d, _ = KNOWN[name]
    ends_a, ends_b, radius_a, radius_b = np.array([[a, b]]), np.array([[c, d]]), vec(0.1), vec(0.2)
    distance, normal, point_a, point_b = capsule_distances(ends_a, radius_a, ends_b, radius_b)
    np.testing.assert_allclose(distance, -0.3, rtol=0, atol=TOL)
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=TOL)
    np.testing.assert_allclose([normal[0] @ (b - a), normal[0] @ (d - c)], 0.0, atol=TOL)
    np.testing.assert_allclose(point_b - point_a, -0.3 * normal, rtol=0, atol=TOL)
    # Moving b along the normal by the depth just separates the bodies.
    freed = capsule_distances(ends_a, radius_a, ends_b + 0.3 * normal[:, None], radius_b)
    np.testing.assert_allclose(freed.distance, 0.0, atol=TOL)
    np.testing.assert_allclose(freed.normal, normal, rtol=0, atol=TOL)


def test_spheres_are_capsules_with_equal_ends() -> None:
    centres = np.array([[[0, 0, 0]] * 2, [[1, 1, 1]] * 2], dtype=np.float64)
    result = capsule_distances(centres, vec(1, 0.5), centres + vec(0, 3, 4), vec(2, 0.25))
    np.testing.assert_allclose(result.distance, [2.0, 4.25], rtol=0, atol=TOL)
    np.testing.assert_allclose(result.normal, [[0, 0.6, 0.8]] * 2, rtol=0, atol=TOL)
    np.testing.assert_allclose(result.point_a[0], [0, 0.6, 0.8], rtol=0, atol=TOL)
    np.testing.assert_allclose(result.point_b[0], [0, 1.8, 2.4], rtol=0, atol=TOL)


def test_no_pairs_wrong_shapes_and_nan() -> None:
    none = capsule_distances(np.empty((0, 2, 3)), np.empty(0), np.empty((0, 2, 3)), np.empty(0))
    assert [x.shape for x in none] == [(0,), (0, 3), (0, 3), (0, 3)]
    ends_a, radii_a, ends_b, radii_b = random_capsules(3, 6)
    with pytest.raises(ValueError, match=r"\(3, 1\)"):  # would broadcast to 3 x 3 distances unseen
        capsule_distances(ends_a, radii_a, ends_b, radii_b[:, None])
    with pytest.raises(ValueError, match="shapes"):
        capsule_distances(ends_a, radii_a, ends_b[:1], radii_b)
    ends_b[1, 0, 2] = np.nan
    result = capsule_distances(ends_a, radii_a, ends_b, radii_b)
    np.testing.assert_array_equal(np.isnan(result.distance), [False, True, False])
    assert np.isnan(result.normal[1]).any()
