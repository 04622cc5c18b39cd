"""Which bodies of a robot can collide with each other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations, product
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.config import Avoidance
from qpavoid.errors import matching
from qpavoid.model.limits import JointBounds
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.space import Space
from qpavoid.problem import Array, IntArray, Mask


def add_self_pairs(model: Any, bodies: Any, disabled: Iterable[tuple[str, str]], origin: str) -> None:
    """Add every pair of bodies that is not rigidly connected, adjacent or disabled by name patterns, in either order.

    Raises:
        UnknownName: a pattern that matches no body; naming the `origin`, a file.
    """
    names = [body.name for body in bodies.geometryObjects]
    joints, what = [body.parentJoint for body in bodies.geometryObjects], f"{origin}: disabled_pairs: no body"
    disabled_pairs = {
        frozenset((first, second))
        for pair in disabled
        for first, second in product(*(matching([pattern], names, what) for pattern in pair))
    }
    for i, j in combinations(range(len(names)), 2):
        a, b = joints[i], joints[j]
        adjacent = a == b or model.parents[a] == b or model.parents[b] == a
        if not adjacent and frozenset((names[i], names[j])) not in disabled_pairs:
            bodies.addCollisionPair(pin.CollisionPair(i, j))


ALWAYS_TOUCHING = 0.95
"""Share of random configurations from which on two bodies that touch in them do so by design: a row that is violated in
nearly every configuration protects nothing. The remaining 5 % leave out configurations with a joint at its limits."""


def drop_always_touching(model: Any, bodies: Any, bounds: JointBounds, notes: list[Note], samples: int = 200) -> None:
    """Remove the pairs that touch in nearly every one of many random configurations, always the same; note each.

    Those are neighbours whose shapes overlap at the joint by design.
    """
    poses = Space(model, bounds).draw(np.random.default_rng(0), samples)
    fraction = find_contacts(model, bodies, poses, ALWAYS_TOUCHING).mean(axis=0)
    pairs, names = pair_array(bodies).tolist(), [body.name for body in bodies.geometryObjects]
    for index in np.flatnonzero(fraction >= ALWAYS_TOUCHING).tolist():
        a, b = pairs[index]
        bodies.removeCollisionPair(pin.CollisionPair(a, b))
        clause = f"not checked: its bodies touch in {100.0 * fraction[index]:.0f} % of random configurations"
        notes.append(Note(NoteKind.PAIR, (names[a], names[b]), clause, fraction=float(fraction[index])))


def find_contacts(model: Any, bodies: Any, poses: Array, at_least: float = 0.0) -> Mask:
    """Find the configurations in which the bodies of each pair touch (k, m).

    Args:
        model: pinocchio model.
        bodies: collision bodies with their m pairs.
        poses: configurations (k, nq).
        at_least: share of the configurations; a pair that can no longer attain it is not computed further.
    """
    model_data, data, count = model.createData(), bodies.createData(), len(bodies.collisionPairs)
    touches, active = np.zeros((len(poses), count), dtype=bool), np.arange(count)
    for number, q in enumerate(poses):
        pin.updateGeometryPlacements(model, model_data, bodies, data, q)
        pin.computeCollisions(bodies, data, False)
        touches[number, active] = [data.collisionResults[int(i)].isCollision() for i in active]
        is_out = (~touches[: number + 1, active]).sum(axis=0) > (1.0 - at_least) * len(poses)
        for i in active[is_out].tolist():
            data.deactivateCollisionPair(i)
        active = active[~is_out]
        if not len(active):
            break
    return touches


D1 = Avoidance().d1
"""Safety distance of scenarios that give none [m]."""


def notes_of_home(near: Sequence[tuple[str, str, float]], is_given: bool) -> list[Note]:
    """Name the pairs that are nearer than the default d1 at home.

    Args:
        near: of `Robot.near_at_home`.
        is_given: whether the home pose was chosen, so that they are meant to be that near.
    """
    remedy = "give a `home` with bent joints, or `pair_margins`; `qpavoid robot add` writes both"
    clear = f"nearer than the default d1, {1e3 * D1:g} mm, kept as far apart as there, less 1 mm"
    touching = "touch there: the robot moves to part them, at no more than 0.2 rad/s"
    notes = []
    for is_touching, clause in ((False, clear), (True, touching)):
        names = tuple(f"{a} - {b} ({1e3 * d:.1f} mm)" for a, b, d in near if (d <= 0.0) is is_touching)
        if names:
            severity: Any = "note" if is_given and not is_touching else "warning"
            notes.append(Note(NoteKind.HOME, names, clause, remedy, severity))
    return notes


def pair_array(bodies: Any) -> IntArray:
    """Return the indices of the bodies of each pair (m, 2)."""
    return np.array([(p.first, p.second) for p in bodies.collisionPairs], dtype=np.intp).reshape(-1, 2)
