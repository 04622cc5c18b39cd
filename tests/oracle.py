"""Signed distances of convex bodies from their support functions alone, by brute force over directions.

The signed distance of A and B is the largest gap -(h_A(n) + h_B(-n)) over all unit vectors n from A to B: apart, that
is the separating direction; in penetration, the shortest separation.
"""

import coal
import numpy as np


def spiral(count):
    """Unit vectors spread over the sphere (count, 3)."""
    i = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    r = np.sqrt(1.0 - z * z)
    return np.column_stack((r * np.cos(angle), r * np.sin(angle), z))


DIRECTIONS = spiral(3000)
_GRID = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)), axis=-1).reshape(-1, 2)


def support(geometry, placement):
    """h(n): how far a body at a placement reaches along each of the directions n (k, 3)."""

    def local(n):
        match geometry:
            case coal.Sphere():
                return np.full(len(n), geometry.radius)
            case coal.Capsule():
                return geometry.radius + np.abs(n[:, 2]) * geometry.halfLength
            case coal.Box():
                return np.abs(n) @ geometry.halfSide
            case coal.Cylinder():
                return geometry.radius * np.hypot(n[:, 0], n[:, 1]) + np.abs(n[:, 2]) * geometry.halfLength
            case coal.Cone():
                base = geometry.radius * np.hypot(n[:, 0], n[:, 1]) - n[:, 2] * geometry.halfLength
                return np.maximum(base, n[:, 2] * geometry.halfLength)
            case coal.Ellipsoid():
                return np.linalg.norm(n * geometry.radii, axis=1)
            case coal.ConvexBase():
                return (n @ _points(geometry).T).max(axis=1)
        raise TypeError(geometry)

    return lambda n: local(n @ placement.rotation) + n @ placement.translation


def _points(hull):
    return np.array([hull.point(i) for i in range(hull.num_points)])


def signed_distance(a, b):
    """Largest gap of two support functions, and the direction that it is found in."""

    def gap(n):
        return -(a(n) + b(-n))

    gaps = gap(DIRECTIONS)
    best, direction = -np.inf, None
    for start in np.argsort(-gaps)[:5]:
        n, here, width = DIRECTIONS[start], gaps[start], 0.07
        while width > 1e-9:
            t = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
            t /= np.linalg.norm(t)
            around = n + width * _GRID @ np.array([t, np.cross(n, t)])
            around /= np.linalg.norm(around, axis=1, keepdims=True)
            found = gap(around)
            k = found.argmax()
            if found[k] > here:
                n, here = around[k], found[k]
            width *= 0.6
        if here > best:
            best, direction = here, n
    return best, direction
