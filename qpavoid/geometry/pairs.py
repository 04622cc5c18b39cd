"""Which bodies of a robot can collide with each other."""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.errors import UnknownName, nearest
from qpavoid.limits import JointBounds
from qpavoid.problem import IntArray


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


def drop_always_touching(model: Any, bodies: Any, joints: JointBounds, samples: int = 200) -> list[tuple[str, str]]:
    """Removes the pairs that touch in every one of many random configurations.

    Those are neighbours whose shapes overlap at the joint, not a threat.

    Args:
        model: pinocchio model.
        bodies: its collision bodies with their pairs, changed in place.
        joints: position limits, within which configurations are drawn; joints without are turned all the way round.
        samples: how many configurations are drawn, always the same ones.

    Returns:
        Names of the pairs that were removed.
    """
    model_data, data, random = model.createData(), bodies.createData(), np.random.default_rng(0)
    touching = np.ones(len(bodies.collisionPairs), dtype=bool)
    for _ in range(samples if touching.any() else 0):
        q = pin.integrate(model, pin.neutral(model), random.uniform(-np.pi, np.pi, model.nv))
        finite = np.isfinite(joints.lower) & np.isfinite(joints.upper)
        q[joints.q_index[finite]] = random.uniform(joints.lower[finite], joints.upper[finite])
        pin.updateGeometryPlacements(model, model_data, bodies, data, q)
        pin.computeDistances(bodies, data)
        touching &= np.array([result.min_distance <= 0.0 for result in data.distanceResults], dtype=bool)
    removed = pair_array(bodies)[touching].tolist()
    for a, b in removed:
        bodies.removeCollisionPair(pin.CollisionPair(a, b))
    names = [body.name for body in bodies.geometryObjects]
    return [(names[a], names[b]) for a, b in removed]


def pair_array(bodies: Any) -> IntArray:
    """(m, 2) indices of the bodies of each pair."""
    return np.array([(p.first, p.second) for p in bodies.collisionPairs], dtype=np.intp).reshape(-1, 2)
