"""Which pairs of bodies are not watched, and why: by links where that says it all, as an SRDF does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pinocchio as pin

from qpavoid.describe.sampling import BoolArray, Sampled
from qpavoid.robot import Robot


def _pairs(robot: Robot) -> list[frozenset[str]]:
    names = [body.name for body in robot.bodies.geometryObjects]
    return [frozenset((names[pair.first], names[pair.second])) for pair in robot.bodies.collisionPairs]


def pair_reasons(bare: Robot, robot: Robot, sampled: Sampled) -> dict[frozenset[str], str]:
    """Why each pair of bodies that is not watched is not.

    Args:
        bare: the robot without an SRDF.
        robot: the robot with it.
        sampled: what became of its pairs.
    """
    names = [body.name for body in bare.bodies.geometryObjects]
    every = [frozenset((a, b)) for i, a in enumerate(names) for b in names[:i]]
    touching = {frozenset(pair) for pair in bare.always_touching}
    checked = set(_pairs(bare))
    kept = dict(zip(_pairs(robot), zip(sampled.always, sampled.never, strict=True), strict=True))
    reasons = {}
    for pair in every:
        if pair in touching:
            reasons[pair] = "always"
        elif pair not in checked:
            reasons[pair] = "adjacent"
        elif pair not in kept:
            reasons[pair] = "srdf"
        elif any(kept[pair]):
            reasons[pair] = "always" if kept[pair][0] else "never"
    return reasons


_WHY = {"adjacent": "Adjacent", "always": "Default", "never": "Never"}


def by_link(robot: Robot, reasons: Mapping[frozenset[str], str]) -> tuple[dict[frozenset[str], str], list[Any]]:
    """What is not watched, by links where that says it all, and by bodies where it does not."""
    link = {body.name: robot.model.frames[body.parentFrame].name for body in robot.bodies.geometryObjects}
    pairs: dict[frozenset[str], list[str | None]] = {}
    names = list(link)
    for i, a in enumerate(names):
        for b in names[:i]:
            if link[a] != link[b]:
                pairs.setdefault(frozenset((link[a], link[b])), []).append(reasons.get(frozenset((a, b))))
    off = {links: _WHY.get(str(whys[0]), "User") for links, whys in pairs.items() if None not in whys}
    single = [
        tuple(sorted(pair))
        for pair, why in reasons.items()
        if why in ("never", "always") and frozenset(link[body] for body in pair) not in off
    ]
    return off, sorted(single)


def watching(robot: Robot, kept: BoolArray) -> Robot:
    """The robot with some of its pairs only."""
    bodies = pin.GeometryModel(robot.bodies)
    pairs = list(robot.bodies.collisionPairs)
    bodies.removeAllCollisionPairs()
    for pair, keep in zip(pairs, kept, strict=True):
        if keep:
            bodies.addCollisionPair(pair)
    return replace(robot, bodies=bodies)
