"""Distances of points and segments against a convex solver, an optimality certificate and known cases."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from qpavoid.geometry.segments import point_segment_distance, segment_segment_distance

TOL = 1e-9

# A coarse lattice makes parallel, collinear, crossing and zero-length cases common, floats make general ones.
coordinate = st.one_of(st.integers(-3, 3).map(float), st.floats(-3.0, 3.0, allow_subnormal=False))
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)


def vec(*x):
    return np.array(x, dtype=np.float64)


def bounded_least_squares(a, b, c, d):
    """Minimise |a + m (b - a) - c - n (d - c)| over 0 <= m, n <= 1 with an active-set solver."""
    matrix = np.column_stack([b - a, c - d])
    best = lsq_linear(matrix, c - a, bounds=(0.0, 1.0), method="bvls", tol=1e-15)
    return float(np.linalg.norm(matrix @ best.x - (c - a)))


def test_point_beyond_an_end():
    """The axial 3 counts: eq. 2 as printed says 4. A segment of no length is a point."""
    p, a = vec([-3, 0, 4], [0.5, 3, 4], [5, 3, 0], [0.25, 0, 0]), vec(0, 0, 0)
    np.testing.assert_allclose(point_segment_distance(p, a, vec(1, 0, 0)), [5.0, 5.0, 5.0, 0.0], atol=TOL)
    np.testing.assert_allclose(point_segment_distance(p, a, a), np.linalg.norm(p, axis=1), atol=TOL)


@given(st.tuples(point, point, point, point))
def test_it_is_the_minimum(points):
    assert segment_segment_distance(*points) == pytest.approx(bounded_least_squares(*points), abs=TOL)


def test_all_in_one_call():
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (4, 300, 3))
    expected = [bounded_least_squares(*points[:, i]) for i in range(300)]
    np.testing.assert_allclose(segment_segment_distance(*points), expected, rtol=0, atol=TOL)
    table = segment_segment_distance(points[0, :, None], points[1, :, None], points[2], points[3])
    np.testing.assert_allclose(np.diag(table), expected, rtol=0, atol=TOL)


@pytest.mark.parametrize("angle", 10.0 ** -np.arange(1, 17, 3))
def test_nearly_parallel(angle):
    """Two metres turned by a small angle about their common normal, some height apart, in a general frame."""
    frame = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    u, v = frame @ vec(1, 0, 0), frame @ vec(np.cos(angle), np.sin(angle), 0)
    for height in (0.0, 1e-6, 0.3):
        lift = frame @ vec(0, 0, height)
        for shift in (0.0, 0.4, -0.9):  # the axes cross at this place of u
            distance = segment_segment_distance(-u, u, shift * u - v + lift, shift * u + v + lift)
            assert distance == pytest.approx(height, abs=TOL)
