"""Which bodies of a robot can collide with each other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.errors import UnknownName, nearest
from qpavoid.model.limits import JointBounds
from qpavoid.model.notes import Note, NoteKind
from qpavoid.problem import Array, IntArray, Mask


def add_self_pairs(model: Any, bodies: Any, disabled: Iterable[tuple[str, str]], origin: str) -> None:
    """Add every pair of bodies that is not rigidly connected, adjacent or disabled.

    Args:
        model: pinocchio model.
        bodies: its collision bodies, changed in place.
        disabled: pairs of name patterns, in either order.
        origin: file to name in errors.

    Raises:
        UnknownName: a pattern that matches no body.
    """
    names = [body.name for body in bodies.geometryObjects]
    joints = [body.parentJoint for body in bodies.geometryObjects]

    def matching(pattern: str) -> list[int]:
        matches = [i for i, name in enumerate(names) if fnmatchcase(name, pattern)]
        if not matches:
            raise UnknownName(f"{origin}: disabled_pairs: no body {pattern!r}{nearest(pattern, names)}")
        return matches

    disabled_pairs = {frozenset((i, j)) for a, b in disabled for i in matching(a) for j in matching(b)}
    for i, j in combinations(range(len(names)), 2):
        a, b = joints[i], joints[j]
        adjacent = a == b or model.parents[a] == b or model.parents[b] == a
        if not adjacent and frozenset((i, j)) not in disabled_pairs:
            bodies.addCollisionPair(pin.CollisionPair(i, j))


ALWAYS_TOUCHING = 0.95
"""Share of random configurations from which on two bodies that touch in them do so by design: a row that is violated in
nearly every configuration protects nothing. The remaining 5 % leave out configurations with a joint at its limits."""


class TouchingPair(NamedTuple):
    """Two bodies that touch in nearly every configuration."""

    a: str
    b: str
    fraction: float
    """Share of random configurations in which they touch [-]."""

    def note(self) -> Note:
        """Return a note that the pair is not checked."""
        clause = f"not checked: its bodies touch in {100.0 * self.fraction:.0f} % of random configurations"
        return Note(NoteKind.PAIR, (self.a, self.b), clause, fraction=self.fraction)


def drop_always_touching(model: Any, bodies: Any, joints: JointBounds, samples: int = 200) -> list[TouchingPair]:
    """Remove the pairs that touch in nearly every one of many random configurations.

    Those are neighbours whose shapes overlap at the joint by design.

    Args:
        model: pinocchio model.
        bodies: its collision bodies with their pairs, changed in place.
        joints: position limits, within which configurations are drawn; joints without are drawn over a full turn.
        samples: how many configurations are drawn, always the same ones.

    Returns:
        The pairs that were removed.
    """
    random, neutral = np.random.default_rng(0), pin.neutral(model)
    finite = np.isfinite(joints.lower) & np.isfinite(joints.upper)
    poses = []
    for _ in range(samples):
        q = pin.integrate(model, neutral, random.uniform(-np.pi, np.pi, model.nv))
        q[joints.q_index[finite]] = random.uniform(joints.lower[finite], joints.upper[finite])
        poses.append(q)
    fraction = find_contacts(model, bodies, poses, ALWAYS_TOUCHING).mean(axis=0)
    indices = np.flatnonzero(fraction >= ALWAYS_TOUCHING).tolist()
    pairs, names = pair_array(bodies).tolist(), [body.name for body in bodies.geometryObjects]
    for index in indices:
        bodies.removeCollisionPair(pin.CollisionPair(*pairs[index]))
    return [TouchingPair(names[pairs[i][0]], names[pairs[i][1]], float(fraction[i])) for i in indices]


def find_contacts(model: Any, bodies: Any, poses: Sequence[Array], at_least: float = 0.0) -> Mask:
    """Find the configurations in which the bodies of each pair touch (k, m).

    Args:
        model: pinocchio model.
        bodies: collision bodies with their m pairs.
        poses: k configurations (nq,).
        at_least: share of the configurations; a pair that can no longer attain it is not computed further.
    """
    model_data, data, count = model.createData(), bodies.createData(), len(bodies.collisionPairs)
    touches, active = np.zeros((len(poses), count), dtype=bool), np.arange(count)
    for number, q in enumerate(poses):
        pin.updateGeometryPlacements(model, model_data, bodies, data, q)
        pin.computeCollisions(bodies, data, False)
        touches[number, active] = [data.collisionResults[int(i)].isCollision() for i in active]
        separations = number + 1 - touches[: number + 1, active].sum(axis=0)
        below_fraction = separations > (1.0 - at_least) * len(poses)
        for i in active[below_fraction].tolist():
            data.deactivateCollisionPair(i)
        active = active[~below_fraction]
        if not len(active):
            break
    return touches


def pair_array(bodies: Any) -> IntArray:
    """Return the indices of the bodies of each pair (m, 2)."""
    return np.array([(p.first, p.second) for p in bodies.collisionPairs], dtype=np.intp).reshape(-1, 2)
