"""Bodies as cores with a radius around them, of which distances have a closed form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import coal
import numpy as np

from qpavoid.problem import Array, IntArray, Mask


def cores(geometries: Sequence[Any]) -> Array:
    """Return the radius and the core's half sizes along the axes of each geometry (g, 4) [m].

    A sphere is a point, and a capsule a segment along z, with a radius around it; a box is a core without one. Rows of
    all other shapes are NaN.
    """
    return np.array([_core(geometry) for geometry in geometries]).reshape(-1, 4)


def _core(geometry: Any) -> tuple[float, ...]:
    match geometry:
        case coal.Sphere():
            return (geometry.radius, 0.0, 0.0, 0.0)
        case coal.Capsule():
            return (geometry.radius, 0.0, 0.0, geometry.halfLength)
        case coal.Box() if (geometry.halfSide > 0.0).all():
            return (0.0, *geometry.halfSide)
    return (np.nan,) * 4


def has_closed_form(table: Array, bodies: IntArray) -> Mask:
    """Find the pairs (m,) of bodies (m, 2) whose distance has a closed form.

    Both have a core, and one at most is a box.
    """
    known, box = ~np.isnan(table[:, 0]), table[:, 1] > 0.0
    return np.asarray(known[bodies].all(axis=1) & ~box[bodies].all(axis=1))
