"""Which bodies of a robot can collide with each other."""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.errors import UnknownName
from qpavoid.loading import nearest
from qpavoid.problem import Array


def add_self_pairs(model: Any, bodies: Any, disabled: Iterable[tuple[str, str]], origin: str) -> None:
    """Adds every pair of bodies to `bodies` that is not rigidly connected, adjacent or disabled.

    Args:
        model: pinocchio model.
        bodies: its collision bodies, changed in place.
        disabled: pairs of name patterns, in either order.
        origin: file to name in errors.

    Raises:
        UnknownName: a pattern that matches no body.
    """
    names = [body.name for body in bodies.geometryObjects]
    off: set[frozenset[int]] = set()
    for pattern_a, pattern_b in disabled:
        matches = [_matching(pattern, names, origin) for pattern in (pattern_a, pattern_b)]
        off |= {frozenset((i, j)) for i in matches[0] for j in matches[1]}
    joints = [body.parentJoint for body in bodies.geometryObjects]
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            a, b = joints[i], joints[j]
            adjacent = a == b or model.parents[a] == b or model.parents[b] == a
            if not adjacent and frozenset((i, j)) not in off:
                bodies.addCollisionPair(pin.CollisionPair(i, j))


def _matching(pattern: str, names: list[str], origin: str) -> list[int]:
    found = [i for i, name in enumerate(names) if fnmatchcase(name, pattern)]
    if not found:
        raise UnknownName(f"{origin}: disabled_pairs: no body {pattern!r}{nearest(pattern, names)}")
    return found


def drop_colliding_pairs(model: Any, bodies: Any, q: Array) -> list[tuple[str, str]]:
    """Removes the pairs that touch at a configuration which is known to be free of collision.

    What touches there are neighbours whose shapes overlap at the joint, not a threat.

    Args:
        model: pinocchio model.
        bodies: its collision bodies with their pairs, changed in place.
        q: configuration (nq,), as a rule the home pose.

    Returns:
        Names of the pairs that were removed.
    """
    data = bodies.createData()
    pin.updateGeometryPlacements(model, model.createData(), bodies, data, q)
    pin.computeDistances(bodies, data)
    touching = [
        pair
        for pair, result in zip(list(bodies.collisionPairs), data.distanceResults, strict=True)
        if result.min_distance <= 0.0
    ]
    names = [body.name for body in bodies.geometryObjects]
    for pair in touching:
        bodies.removeCollisionPair(pair)
    return [(names[p.first], names[p.second]) for p in touching]


def pair_array(bodies: Any) -> np.ndarray[Any, np.dtype[np.intp]]:
    """(m, 2) indices of the bodies of each pair."""
    return np.array([(p.first, p.second) for p in bodies.collisionPairs], dtype=np.intp).reshape(-1, 2)
