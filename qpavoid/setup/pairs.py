"""Pairs of bodies that are not checked: the reasons, and how often the robot's own geometry touches there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Literal, NamedTuple, get_args

import numpy as np
import pinocchio as pin

from qpavoid.config import PairMargin
from qpavoid.model.joints import frame_index
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.pairs import ALWAYS_TOUCHING, D1, find_contacts, pair_array
from qpavoid.model.robot import Robot
from qpavoid.problem import Array, Mask
from qpavoid.setup.sampling import PairSamples, draw_poses
from qpavoid.setup.shapes import Piece

Reason = Literal["drawn in", "always", "srdf", "adjacent", "never"]
"""Why a pair is not checked; of two links with several bodies, the first of these that one of their pairs has."""
SRDF_REASONS = {"adjacent": "Adjacent", "always": "Default", "never": "Never", "drawn in": "Default", "srdf": "User"}
"""Reasons as an SRDF gives them."""
_POSES = 200
"""Random configurations in which contacts of the geometry of unchecked links are counted."""
_LEAST = 0.1
"""Share of the samples in which a telescope is drawn in, at the least: what touches more seldom meets an end stop."""
_ERRORS = 0.01
"""Share of the samples in which the extension may fail to predict whether a telescope's pair touches [-]."""
_STRAIGHT = 1e-6
"""Departure of a path from a straight line, as a share of its length, that is rounding [-]."""


class UncheckedLinks(NamedTuple):
    """Two links of which no pair of bodies is checked."""

    links: tuple[str, str]
    reason: Reason
    geometry: float
    """Share of random configurations in which the file's own geometry touches, meshes as they are [-]."""

    def notes(self) -> list[Note]:
        """Return a note of what may matter; none of pairs that never touch, or always do as neighbours do."""
        fraction, severity, remedy = self.geometry, "note", ""
        if self.reason == "always" and fraction < ALWAYS_TOUCHING:
            clause, severity = "not checked: their bodies nearly always touch, their geometry more seldom", "warning"
            remedy = f"leaner bodies: --bodies {self.links[0]}=convex, or of your own"
        elif self.reason in ("always", "drawn in"):
            design = "overlap" if self.reason == "always" else "slide into each other"
            clause = f"not checked: they {design} by design"
        elif not 0.0 < fraction < ALWAYS_TOUCHING:
            return []
        elif self.reason == "srdf":
            clause = "not checked (disabled by hand), but can touch"
            remedy = "take them out of the SRDF or `disabled_pairs`"
        else:
            clause, remedy = "not checked (one joint apart), but can touch", "limit that joint so that they cannot"
        return [Note(NoteKind.PAIR, self.links, clause, remedy, severity, fraction)]  # type: ignore[arg-type]


def _named_pairs(robot: Robot) -> list[frozenset[str]]:
    names = [body.name for body in robot.bodies.geometryObjects]
    return [frozenset((names[pair.first], names[pair.second])) for pair in robot.bodies.collisionPairs]


def links_of_bodies(robot: Robot) -> dict[str, str]:
    """Return the link of each body, by name."""
    return {body.name: robot.model.frames[body.parentFrame].name for body in robot.bodies.geometryObjects}


def pair_reasons(
    robot: Robot, sampled: PairSamples | None = None, is_nested: Mask | None = None
) -> dict[frozenset[str], Reason]:
    """Explain why each pair of bodies that is not checked is not.

    Of the robot's own m pairs, what became of them in random configurations counts, and which slide into each other
    (m,).
    """
    parents = robot.model.parents
    touching = set(map(frozenset, robot.always_touching))
    numbers = {pair: i for i, pair in enumerate(_named_pairs(robot))}
    reasons: dict[frozenset[str], Reason] = {}
    for body, other in combinations(robot.bodies.geometryObjects, 2):
        pair, a, b = frozenset((body.name, other.name)), body.parentJoint, other.parentJoint
        number = numbers.get(pair)
        if pair in touching:
            reasons[pair] = "always"
        elif number is None:
            reasons[pair] = "adjacent" if a == b or parents[a] == b or parents[b] == a else "srdf"
        elif sampled is not None and sampled.always[number]:
            reasons[pair] = "always"
        elif is_nested is not None and is_nested[number]:
            reasons[pair] = "drawn in"
        elif sampled is not None and sampled.never[number]:
            reasons[pair] = "never"
    return reasons


_WORDS: dict[Reason, str] = {
    "adjacent": "one joint apart",
    "always": "touch in nearly every configuration",
    "drawn in": "slide into each other by design",
    "never": "never came near in random configurations",
    "srdf": "disabled by an SRDF or `disabled_pairs`",
}


def reasons_in_words(reasons: Mapping[frozenset[str], Reason]) -> dict[str, list[str]]:
    """Return the pairs that are not checked, by the reason."""
    by_reason: dict[str, list[str]] = {}
    for pair, reason in sorted(reasons.items(), key=lambda item: sorted(item[0])):
        by_reason.setdefault(_WORDS[reason], []).append(" – ".join(sorted(pair)))
    return by_reason


def by_link(
    robot: Robot, reasons: Mapping[frozenset[str], Reason]
) -> tuple[dict[frozenset[str], Reason], list[tuple[str, str]]]:
    """Sort unchecked pairs: by links where that describes them, else by bodies."""
    link, order = links_of_bodies(robot), get_args(Reason)
    pairs: dict[frozenset[str], list[Reason | None]] = {}
    for a, b in combinations(link, 2):
        if link[a] != link[b]:
            pairs.setdefault(frozenset((link[a], link[b])), []).append(reasons.get(frozenset((a, b))))
    disabled = {
        links: min((why for why in whys if why), key=order.index) for links, whys in pairs.items() if None not in whys
    }
    single = [
        (min(pair), max(pair))
        for pair, why in reasons.items()
        if why in ("never", "always", "drawn in") and frozenset(link[body] for body in pair) not in disabled
    ]
    return disabled, sorted(single)


def measure_unchecked(
    robot: Robot, pieces: Sequence[Piece], disabled: Mapping[frozenset[str], Reason]
) -> list[UncheckedLinks]:
    """Sample how often the geometry of links that are not checked touches, meshes as the file has them."""
    # bodies enclose the geometry: where they never come near, it does not touch
    shares = _contact_shares(robot, pieces, [links for links, reason in disabled.items() if reason != "never"])
    return [
        UncheckedLinks((min(links), max(links)), reason, shares.get(links, 0.0))
        for links, reason in sorted(disabled.items(), key=lambda item: sorted(item[0]))
    ]


def find_unchecked(robot: Robot, pieces: Sequence[Piece]) -> list[UncheckedLinks]:
    """Find the links of a robot of which no pair of bodies is checked, and how often their geometry touches."""
    disabled, _ = by_link(robot, pair_reasons(robot))
    # those that always touch are notes of the robot's own
    return measure_unchecked(robot, pieces, {links: why for links, why in disabled.items() if why != "always"})


def _contact_shares(
    robot: Robot, pieces: Sequence[Piece], links: Iterable[frozenset[str]]
) -> dict[frozenset[str], float]:
    """Sample how often the geometry of two links touches [-]; pairs that never move relative to each other are out."""
    geometry, owners = pin.GeometryModel(), dict[str, list[int]]()
    for number, piece in enumerate(pieces):
        frame_id = frame_index(robot.model, piece.link)
        frame = robot.model.frames[frame_id]
        placement = frame.placement * piece.placement
        body = pin.GeometryObject(f"{number}", frame.parentJoint, frame_id, placement, piece.geometry)
        owners.setdefault(piece.link, []).append(geometry.addGeometryObject(body))
    joints, pair_links = [body.parentJoint for body in geometry.geometryObjects], []
    for pair in links:
        a, b = sorted(pair)
        for i, j in [(i, j) for i in owners.get(a, []) for j in owners.get(b, []) if joints[i] != joints[j]]:
            geometry.addCollisionPair(pin.CollisionPair(min(i, j), max(i, j)))
            pair_links.append(pair)
    touching = find_contacts(robot.model, geometry, draw_poses(robot, _POSES))
    touches: dict[frozenset[str], Mask] = {}
    for pair, column in zip(pair_links, touching.T, strict=True):
        touches[pair] = touches.get(pair, False) | column
    return {pair: float(column.mean()) for pair, column in touches.items()}


def own_margins(robot: Robot, d1: Array) -> list[PairMargin]:
    """Return the pairs with a safety distance of their own, from that of each pair (m,)."""
    bodies = [sorted(pair) for pair in _named_pairs(robot)]
    return [PairMargin(bodies=(a, b), d1=float(own)) for (a, b), own in zip(bodies, d1, strict=True) if own < D1]


def with_pairs(robot: Robot, mask: Mask) -> Robot:
    """Return the robot with some of its pairs only."""
    bodies = pin.GeometryModel(robot.bodies)
    for pair, is_kept in zip(list(robot.bodies.collisionPairs), mask, strict=True):
        if not is_kept:
            bodies.removeCollisionPair(pair)
    return replace(robot, bodies=bodies)


def nested_pairs(robot: Robot, pair_samples: PairSamples) -> Mask:
    """Find the pairs (m,) that overlap when a telescope is drawn in, as a finger in its guide.

    Two conditions. The origin of one body's joint moves along a straight line as seen from the other's, so that nothing
    but prismatic joints with a common axis moves it; and its place along that line alone decides whether they touch:
    always on one side of a threshold, never on the other. A pair that meets an obstacle of the robot's own, such as two
    carriages on one rail, touches in the middle of its range or only near an end, and stays.
    """
    touching = pair_samples.touching
    is_nested = np.zeros(touching.shape[1], dtype=bool)
    candidates = np.flatnonzero((touching.mean(axis=0) >= _LEAST) & ~pair_samples.always).tolist()
    data, poses = robot.model.createData(), list[list[Array]]()
    for q in pair_samples.poses if candidates else ():
        pin.forwardKinematics(robot.model, data, q)
        poses.append([pose.homogeneous for pose in data.oMi])
    joints, pairs = [body.parentJoint for body in robot.bodies.geometryObjects], pair_array(robot.bodies)
    for index in candidates:
        a, b = (np.array([pose[joints[i]] for pose in poses]) for i in pairs[index].tolist())
        is_nested[index] = _decides(_along_line(a, b), touching[:, index]) or _decides(
            _along_line(b, a), touching[:, index]
        )
    return is_nested


def _along_line(frames: Array, origins: Array) -> Array | None:
    """Return places (k,) of origins along a line, as seen from frames [m]; None if they do not keep to one."""
    in_frame = np.einsum("kij,ki->kj", frames[:, :3, :3], origins[:, :3, 3] - frames[:, :3, 3])
    centred = in_frame - in_frame.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    return None if sizes[0] < 1e-6 or sizes[1] > _STRAIGHT * sizes[0] else np.asarray(centred @ axes[0])


def _decides(extension: Array | None, touching: Mask) -> bool:
    """Return True if a threshold of the extension (k,) separates touching samples (k,)."""
    if extension is None:
        return False
    steps = np.where(touching[np.argsort(extension)], -1, 1)
    errors = touching.sum() + np.cumsum(np.concatenate(([0], steps)))  # if those above each threshold do not touch
    return bool(min(errors.min(), len(steps) - errors.max()) <= _ERRORS * len(steps))
