"""Pairs of bodies that are not checked: the reasons, and how often the robot's own geometry touches there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pinocchio as pin

from qpavoid.config import PairMargin
from qpavoid.model.joints import frame_index
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.pairs import ALWAYS_TOUCHING, find_contacts
from qpavoid.model.robot import Robot
from qpavoid.problem import Array
from qpavoid.setup.sampling import D1, SEED, BoolArray, PairSamples, Space
from qpavoid.setup.shapes import Piece

Reason = Literal["adjacent", "srdf", "always", "drawn in", "never"]
_POSES = 200
"""Random configurations in which contacts of the geometry of unchecked links are counted."""


@dataclass(frozen=True)
class UncheckedLinks:
    """Two links of which no pair of bodies is checked."""

    links: tuple[str, str]
    reason: Reason
    bodies: float | None
    """Share of random configurations in which their bodies touch, the pair that does so most [-]; None: not sampled."""
    geometry: float
    """The same of the file's own geometry, meshes as they are [-]."""

    def note(self) -> Note | None:
        """Return a note of what may matter.

        None of pairs that never touch, or always do as neighbours do.
        """
        share, kind = self.geometry, NoteKind.PAIR
        if self.reason == "always" and share < ALWAYS_TOUCHING:
            bodies = 100.0 * (self.bodies or 0.0)
            clause = f"not checked: their bodies touch in {bodies:.0f} % of configurations, their geometry more seldom"
            remedy = f"leaner bodies: --bodies {self.links[0]}=convex, or of your own"
            return Note(kind, self.links, clause, remedy, "warning", share)
        if self.reason == "always":
            return Note(kind, self.links, "not checked: they overlap by design", share=share)
        if self.reason == "drawn in":
            return Note(kind, self.links, "not checked: they slide into each other by design", share=share)
        if not 0.0 < share < ALWAYS_TOUCHING:
            return None
        why, remedy = "one joint apart", "limit that joint so that they cannot"
        if self.reason == "srdf":
            why, remedy = "disabled by hand", "take them out of the SRDF or `disabled_pairs`"
        return Note(kind, self.links, f"not checked ({why}), but can touch", remedy, share=share)


def _pairs(robot: Robot) -> list[frozenset[str]]:
    names = [body.name for body in robot.bodies.geometryObjects]
    return [frozenset((names[pair.first], names[pair.second])) for pair in robot.bodies.collisionPairs]


def pair_reasons(
    bare: Robot, robot: Robot, pair_samples: PairSamples, is_nested: BoolArray
) -> dict[frozenset[str], Reason]:
    """Explain why each pair of bodies that is not checked is not.

    Args:
        bare: the robot without an SRDF.
        robot: the robot with it.
        pair_samples: what became of its pairs.
        is_nested: which of them slide into each other (m,).
    """
    names = [body.name for body in bare.bodies.geometryObjects]
    touching = {frozenset(pair[:2]) for pair in robot.always_touching}
    checked = {*_pairs(bare), *(frozenset(pair[:2]) for pair in bare.always_touching)}
    mask = {pair: i for i, pair in enumerate(_pairs(robot))}
    reasons: dict[frozenset[str], Reason] = {}
    for pair in [frozenset((a, b)) for i, a in enumerate(names) for b in names[:i]]:
        index = mask.get(pair)
        if pair in touching or (index is not None and pair_samples.always[index]):
            reasons[pair] = "always"
        elif pair not in checked:
            reasons[pair] = "adjacent"
        elif index is None:
            reasons[pair] = "srdf"
        elif is_nested[index]:
            reasons[pair] = "drawn in"
        elif pair_samples.never[index]:
            reasons[pair] = "never"
    return reasons


_WHY = {"adjacent": "Adjacent", "always": "Default", "never": "Never", "drawn in": "Default"}


def by_link(
    robot: Robot, reasons: Mapping[frozenset[str], Reason]
) -> tuple[dict[frozenset[str], Reason], list[tuple[str, str]]]:
    """Sort unchecked pairs: by links where that describes them, else by bodies."""
    link = _links(robot)
    pairs: dict[frozenset[str], list[Reason | None]] = {}
    names = list(link)
    for i, a in enumerate(names):
        for b in names[:i]:
            if link[a] != link[b]:
                pairs.setdefault(frozenset((link[a], link[b])), []).append(reasons.get(frozenset((a, b))))
    order: tuple[Reason, ...] = ("drawn in", "always", "srdf", "adjacent", "never")
    disabled = {
        links: min((why for why in whys if why), key=order.index) for links, whys in pairs.items() if None not in whys
    }
    single = [
        (min(pair), max(pair))
        for pair, why in reasons.items()
        if why in ("never", "always", "drawn in") and frozenset(link[body] for body in pair) not in disabled
    ]
    return disabled, sorted(single)


def srdf_reason(reason: Reason) -> str:
    """Return the reason as an SRDF gives it."""
    return _WHY.get(reason, "User")


def _links(robot: Robot) -> dict[str, str]:
    return {body.name: robot.model.frames[body.parentFrame].name for body in robot.bodies.geometryObjects}


def measure_unchecked(
    robot: Robot,
    pieces: Sequence[Piece],
    disabled: Mapping[frozenset[str], Reason],
    shares: Mapping[frozenset[str], float],
) -> list[UncheckedLinks]:
    """Sample how often the geometry of links that are not checked touches.

    Args:
        robot: with its pairs.
        pieces: geometry as the file has it.
        disabled: two links that are not checked, and why.
        shares: two bodies: share of configurations in which they touch [-].
    """
    # bodies enclose the geometry: where they never come near, it does not touch
    of_geometry = geometry_contacts(robot, pieces, [links for links, reason in disabled.items() if reason != "never"])
    link = _links(robot)
    of_bodies: dict[frozenset[str], float] = {}
    for pair, share in shares.items():
        links = frozenset(link[body] for body in pair)
        of_bodies[links] = max(of_bodies.get(links, 0.0), share)
    return [
        UncheckedLinks((min(links), max(links)), reason, of_bodies.get(links), of_geometry.get(links, 0.0))
        for links, reason in sorted(disabled.items(), key=lambda item: sorted(item[0]))
    ]


def find_unchecked(robot: Robot, pieces: Sequence[Piece]) -> list[UncheckedLinks]:
    """Find the links of a robot of which no pair of bodies is checked.

    Also how often their geometry touches.

    Args:
        robot: with its pairs.
        pieces: geometry as the file has it.
    """
    link, joint = _links(robot), {body.name: body.parentJoint for body in robot.bodies.geometryObjects}
    checked = {frozenset(link[body] for body in pair) for pair in _pairs(robot)}
    always = {frozenset((link[pair.a], link[pair.b])) for pair in robot.always_touching}
    parents, disabled, names = robot.model.parents, dict[frozenset[str], Reason](), list(link)
    for i, a in enumerate(names):
        for b in names[:i]:
            pair = frozenset((link[a], link[b]))
            if joint[a] != joint[b] and pair not in checked and pair not in always:
                adjacent = parents[joint[a]] == joint[b] or parents[joint[b]] == joint[a]
                disabled[pair] = "adjacent" if adjacent else "srdf"
    return measure_unchecked(robot, pieces, disabled, {})


def geometry_contacts(
    robot: Robot, pieces: Sequence[Piece], links: Iterable[frozenset[str]]
) -> dict[frozenset[str], float]:
    """Sample how often the geometry of two links touches, as a share [-].

    Pairs that never move relative to each other are left out.

    Args:
        robot: whose model moves the links.
        pieces: geometry as the file has it.
        links: pairs of links.
    """
    geometry, owners = pin.GeometryModel(), dict[str, list[int]]()
    for number, piece in enumerate(pieces):
        frame_id = frame_index(robot.model, piece.link)
        frame = robot.model.frames[frame_id]
        body = pin.GeometryObject(
            f"{number}", frame.parentJoint, frame_id, frame.placement * piece.placement, piece.geometry
        )
        owners.setdefault(piece.link, []).append(geometry.addGeometryObject(body))
    joints, pair_links = [body.parentJoint for body in geometry.geometryObjects], []
    for pair in links:
        a, b = sorted(pair)
        for i in owners.get(a, []):
            for j in owners.get(b, []):
                if joints[i] != joints[j]:
                    geometry.addCollisionPair(pin.CollisionPair(min(i, j), max(i, j)))
                    pair_links.append(pair)
    touching = find_contacts(robot.model, geometry, list(Space(robot).draw(np.random.default_rng(SEED), _POSES)))
    touches: dict[frozenset[str], BoolArray] = {}
    for pair, column in zip(pair_links, touching.T, strict=True):
        touches[pair] = touches.get(pair, np.zeros(len(column), dtype=bool)) | column
    return {pair: float(column.mean()) for pair, column in touches.items()}


def shares_of_contact(robot: Robot, pair_samples: PairSamples) -> dict[frozenset[str], float]:
    """Return the share of configurations in which each pair touches [-].

    Only of pairs that were sampled.
    """
    shares = dict(zip(_pairs(robot), pair_samples.contact.tolist(), strict=True))
    return {**shares, **{frozenset((pair.a, pair.b)): pair.share for pair in robot.always_touching}}


def own_margins(robot: Robot, d1: Array) -> list[PairMargin]:
    """Return the pairs with a safety distance of their own, from that of each pair (m,)."""
    bodies = [sorted(pair) for pair in _pairs(robot)]
    return [PairMargin(bodies=(a, b), d1=float(own)) for (a, b), own in zip(bodies, d1, strict=True) if own < D1]


def with_pairs(robot: Robot, mask: BoolArray) -> Robot:
    """Return the robot with some of its pairs only."""
    bodies = pin.GeometryModel(robot.bodies)
    pairs = list(robot.bodies.collisionPairs)
    bodies.removeAllCollisionPairs()
    for pair, is_kept in zip(pairs, mask, strict=True):
        if is_kept:
            bodies.addCollisionPair(pair)
    return replace(robot, bodies=bodies)
