"""Makes a robot.yaml and an SRDF of a bare URDF: bodies, pairs, a home pose, end effectors."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

import coal
import numpy as np
import pinocchio as pin

from qpavoid.bodies import CapsuleFit, check_meshes, fit_capsule, hull_points
from qpavoid.config import Body, Box, Capsule, Cylinder, Hull, RobotConfig, Sphere
from qpavoid.describe.ends import end_effectors
from qpavoid.describe.fit import GROSS, Bodies, fit_piece, hull_volume
from qpavoid.describe.sampling import (
    CLEAR,
    SAMPLES,
    SEED,
    BoolArray,
    Sampled,
    always_near,
    clear_home,
    sample_pairs,
    touching,
)
from qpavoid.describe.srdf import Semantics, find_srdf, read_srdf
from qpavoid.errors import ConfigError, UnknownName
from qpavoid.loading import nearest
from qpavoid.problem import Array
from qpavoid.robot import Robot, middle
from qpavoid.safe_xml import read_robot_xml
from qpavoid.urdf import is_mjcf, read_collision, read_model, read_pieces

Root = Literal["fixed", "planar", "free_flyer"]


@dataclass(frozen=True)
class Wishes:
    """What the user of `robot add` chose."""

    name: str | None = None
    """Of the robot; that of the file if left out."""
    bodies: Bodies = "auto"
    """Kind of collision bodies."""
    bodies_of: Mapping[str, Bodies] = field(default_factory=dict)
    """Link (with `*` and `?`): another kind."""
    root: Root = "fixed"
    """How the root link is attached to the world."""
    lock: Sequence[str] = ()
    """Joints (with `*` and `?`) held at the home pose for good."""
    home: Mapping[str, float] = field(default_factory=dict)
    """Joint: position of a home pose to prefer [rad or m]."""
    package_dirs: Sequence[Path] = ()
    """Folders in which `package://` meshes are looked up."""
    srdf: Path | None = None
    """An SRDF to honour; one found beside the URDF if left out."""
    samples: int = SAMPLES
    """Configurations drawn to find pairs that never collide."""
    seed: int = SEED
    """Of the draw."""


@dataclass(frozen=True)
class Piece:
    """A piece of a robot's geometry, as its file has it."""

    name: str
    link: str
    geometry: Any
    """coal geometry."""
    placement: Any
    """In the frame of its link."""


@dataclass(frozen=True)
class Described:
    """A robot's description, with how it came about."""

    config: RobotConfig
    """Fields of the robot.yaml; file names in it are absolute."""
    robot: Robot
    """As it is with that description."""
    urdf: Path
    """The file that it was made of."""
    wishes: Wishes
    """What the user chose."""
    pieces: Sequence[Piece]
    """What the bodies enclose."""
    semantics: Semantics
    """Of the SRDF that was honoured."""
    honoured: Path | None
    """That SRDF."""
    disabled: Mapping[frozenset[str], str]
    """Two links that are not checked, and why: to be written as an SRDF."""
    volume: Mapping[str, tuple[float, float]]
    """Link: volume of its bodies, and of the hulls of its meshes [m³]."""
    counts: Mapping[str, int]
    """Pairs: all, adjacent, srdf, always, never, watched."""
    clearance: float
    """Least distance at the home pose [m]."""
    notes: Sequence[str]
    """What the user should know."""


def describe(urdf: Path, wishes: Wishes | None = None) -> Described:
    """Works out what a robot.yaml has to say of a URDF or MJCF.

    Args:
        urdf: the file.
        wishes: what the user chose.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    wishes = wishes or Wishes()
    urdf = urdf.resolve()
    name = wishes.name or urdf.stem
    model = read_model(urdf, wishes.root)
    honoured = wishes.srdf or find_srdf(urdf)
    semantics = Semantics() if honoured is None else read_srdf(honoured)
    for joint in wishes.home:
        if not model.existJointName(joint):
            raise UnknownName(f"--home: no joint {joint!r}{nearest(joint, list(model.names)[1:])}")
    if wishes.home:
        semantics = replace(semantics, states={"--home": wishes.home, **semantics.states})
    notes: list[str] = []
    pieces = _pieces(urdf, model, wishes, notes)
    fields: dict[str, Any] = {
        "name": name,
        "urdf": str(urdf),
        "root_joint": wishes.root,
        "package_dirs": [str(folder.resolve()) for folder in wishes.package_dirs],
        "lock": _locks(urdf, model, wishes.lock, semantics, notes),
    }
    given = None if honoured is None else str(honoured.resolve())
    lean: set[str] = set()
    while True:
        fields["bodies"], volume = _bodies(pieces, wishes, lean)
        robot = Robot.from_config(RobotConfig(**fields, srdf=given), urdf)
        more = _too_fat(robot, _wished_homes(robot, semantics)[0], wishes.seed) - lean
        if not more:
            break
        lean |= more
    if lean:
        notes.append(f"exact where capsules would be too near at home or everywhere: {', '.join(sorted(lean))}")
    bare = Robot.from_config(RobotConfig(**fields), urdf)
    fields["end_effectors"] = end_effectors(bare.model, semantics.end_effectors)
    sampled = sample_pairs(robot, wishes.samples, wishes.seed)
    reasons = _reasons(bare, robot, sampled)
    disabled, single = _by_link(bare, reasons)
    fields["disabled_pairs"] = single
    watched = _watched(robot, ~sampled.never & ~sampled.always)
    home, clearance, taken = clear_home(watched, _wished_homes(watched, semantics), seed=wishes.seed)
    fields["home"] = _joint_values(watched.model, home)
    if taken is None and clearance > 0.0:
        notes.append("the wished home poses are not clear of collision; one near the first of them was drawn")
    if clearance <= 0.0:
        notes.append(
            "no pose clear of collision was found; `qpavoid robot check` names the pairs: list them under "
            "`disabled_pairs`, or give their links leaner bodies with --bodies LINK=convex"
        )
    if not fields["end_effectors"]:
        notes.append("no end effector was recognised; list the frames of your tools under `end_effectors`")
    config = RobotConfig(**fields)
    counts = {kind: list(reasons.values()).count(kind) for kind in ("adjacent", "srdf", "always", "never")}
    every = len(fields["bodies"]) * (len(fields["bodies"]) - 1) // 2
    return Described(
        config,
        replace(watched, home=home),
        urdf,
        wishes,
        pieces,
        semantics,
        honoured,
        {**disabled, **{pair: why for pair, why in semantics.disabled.items() if _known(pair, model)}},
        volume,
        {"all": every, **counts, "watched": every - sum(counts.values())},
        clearance,
        tuple(notes),
    )


def _pieces(urdf: Path, model: Any, wishes: Wishes, notes: list[str]) -> list[Piece]:
    """Collision geometry; what is meant to be seen where the file has none."""
    folders = [str(folder) for folder in wishes.package_dirs]
    geometry = read_pieces(urdf, model, folders, urdf)
    if not geometry.ngeoms:
        notes.append("the file has no geometry at all: nothing is watched until you list `bodies`")
    elif not read_collision(urdf, model, folders, urdf).ngeoms:
        notes.append("the file has no collision geometry: bodies are fitted to what is meant to be seen")
    check_meshes(geometry, str(urdf))
    found = []
    for piece in geometry.geometryObjects:
        frame = model.frames[piece.parentFrame]
        found.append(Piece(piece.name, frame.name, piece.geometry, frame.placement.actInv(piece.placement)))
    return found


# --- bodies -------------------------------------------------------------------------------------------------


def _too_fat(robot: Robot, home: Array, seed: int) -> set[str]:
    """Links of the pairs that are too near at the home pose, or in every one of a few random poses."""
    names = [body.name for body in robot.bodies.geometryObjects]
    near = [names[i] for pair in always_near(robot, _FEW, seed) for i in pair]
    near += [body for pair in robot.always_touching for body in pair]
    near += [body for a, b, _ in touching(robot, home, CLEAR) for body in (a, b)]
    link = {body.name: robot.model.frames[body.parentFrame].name for body in robot.bodies.geometryObjects}
    return {link[body] for body in near}


_FEW = 200
"""Random poses that tell whether capsules are too fat."""


def _bodies(
    pieces: Iterable[Piece], wishes: Wishes, lean: Iterable[str]
) -> tuple[list[Body], dict[str, tuple[float, float]]]:
    """Bodies of every link, and the volumes that they and the hulls take.

    Args:
        pieces: of all links.
        wishes: which kinds of bodies.
        lean: links for which `auto` is to take what is exact.
    """
    by_link: dict[str, list[Piece]] = {}
    for piece in pieces:
        by_link.setdefault(piece.link, []).append(piece)
    for pattern in wishes.bodies_of:
        if not any(fnmatchcase(link, pattern) for link in by_link):
            raise UnknownName(f"--bodies: no link {pattern!r} with geometry{nearest(pattern, by_link)}")
    bodies: list[Body] = []
    volume = {}
    for link, of_link in by_link.items():
        kinds = [kind for pattern, kind in wishes.bodies_of.items() if fnmatchcase(link, pattern)]
        kind = kinds[-1] if kinds else wishes.bodies
        kind = "convex" if kind == "auto" and link in lean else kind
        shapes, taken, hulls = _link_shapes(of_link, kind)
        volume[link] = taken, hulls
        for index, shape in enumerate(shapes):
            bodies.append(Body(name=link if len(shapes) == 1 else f"{link}_{index}", frame=link, **shape))
    return bodies, volume


def _link_shapes(pieces: Sequence[Piece], kind: Bodies) -> tuple[list[dict[str, Any]], float, float]:
    """Shapes of one link, in its frame, as fields of a `Body`; their volume, and that of the hulls of its pieces.

    One capsule around all pieces takes the place of several shapes where it takes no more room than they do, or, in
    `auto`, where it is not gross.
    """
    fits = [fit_piece(piece.geometry, kind) for piece in pieces]
    hulls = [hull_volume(piece.geometry) for piece in pieces]
    total = sum(
        sum(capsule.volume for capsule in capsules) if capsules else hull
        for capsules, hull in zip(fits, hulls, strict=True)
    )
    if len(pieces) > 1 and kind != "convex":
        points = [_moved(hull_points(piece.geometry), piece.placement) for piece in pieces]
        whole = fit_capsule(np.concatenate(points))
        if whole.volume <= max(total, GROSS * sum(hulls) if kind == "auto" else 0.0):
            return [capsule_fields(whole, pin.SE3.Identity())], whole.volume, sum(hulls)
    shapes = []
    for piece, capsules in zip(pieces, fits, strict=True):
        shapes += [capsule_fields(capsule, piece.placement) for capsule in capsules]
        if not capsules:
            shapes.append(_exact_fields(piece))
    return shapes, total, sum(hulls)


def _moved(points: Array, placement: Any) -> Array:
    return np.asarray(points @ placement.rotation.T + placement.translation)


def capsule_fields(fit: CapsuleFit, placement: Any) -> dict[str, Any]:
    """Fields of a `Body` that encloses a capsule, with five digits after the point.

    The radius makes up for the rounding of everything else, so that what was enclosed stays so.

    Args:
        fit: the capsule.
        placement: of its frame in the body's.
    """
    axis = placement.rotation @ fit.rotation[:, 2]
    center = placement.act(np.asarray(fit.center))
    position = np.round(center, _DIGITS) + 0.0  # no -0.0
    pitch, yaw = round(math.acos(np.clip(axis[2], -1.0, 1.0)), _DIGITS), round(math.atan2(axis[1], axis[0]), _DIGITS)
    length = round(fit.length, _DIGITS)
    if length == 0.0:
        pitch = yaw = 0.0
    turned = np.array([math.cos(yaw) * math.sin(pitch), math.sin(yaw) * math.sin(pitch), math.cos(pitch)])
    shift = np.linalg.norm(position - center) + 0.5 * np.linalg.norm(length * turned - fit.length * axis)
    radius = math.ceil((fit.radius + float(shift)) * 10**_DIGITS) / 10**_DIGITS
    shape = Capsule(radius=radius, length=length) if length > 0.0 else Sphere(radius=radius)
    return {"shape": shape, "position": tuple(position.tolist()), "rpy": (0.0, pitch, yaw)}


_DIGITS = 5
"""After the point, of lengths [m] and angles [rad] in files."""


def _exact_fields(piece: Piece) -> dict[str, Any]:
    """Fields of a `Body` that is a primitive as it is, or the hull of a mesh."""
    geometry, placement = piece.geometry, piece.placement
    if isinstance(geometry, coal.Box):
        x, y, z = (_up(2.0 * half) for half in geometry.halfSide)
        shape: Any = Box(size=(x, y, z))
    elif isinstance(geometry, coal.Cylinder):
        shape = Cylinder(radius=_up(geometry.radius), length=_up(2.0 * geometry.halfLength))
    else:
        return {"shape": Hull(geometry=piece.name)}
    rpy = np.round(pin.rpy.matrixToRpy(placement.rotation), 2 * _DIGITS) + 0.0  # no -0.0
    position = np.round(placement.translation, 2 * _DIGITS) + 0.0
    return {"shape": shape, "position": tuple(position.tolist()), "rpy": tuple(rpy.tolist())}


def _up(size: float) -> float:
    """A size rounded up, but for rounding errors."""
    return math.ceil(size * 10**_DIGITS - 1e-6) / 10**_DIGITS


# --- pairs --------------------------------------------------------------------------------------------------


def _pairs(robot: Robot) -> list[frozenset[str]]:
    names = [body.name for body in robot.bodies.geometryObjects]
    return [frozenset((names[pair.first], names[pair.second])) for pair in robot.bodies.collisionPairs]


def _reasons(bare: Robot, robot: Robot, sampled: Sampled) -> dict[frozenset[str], str]:
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


def _by_link(robot: Robot, reasons: Mapping[frozenset[str], str]) -> tuple[dict[frozenset[str], str], list[Any]]:
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


def _watched(robot: Robot, kept: BoolArray) -> Robot:
    """The robot with some of its pairs only."""
    bodies = pin.GeometryModel(robot.bodies)
    pairs = list(robot.bodies.collisionPairs)
    bodies.removeAllCollisionPairs()
    for pair, keep in zip(pairs, kept, strict=True):
        if keep:
            bodies.addCollisionPair(pair)
    return replace(robot, bodies=bodies)


def _known(pair: frozenset[str], model: Any) -> bool:
    return all(model.existFrame(link) for link in pair)


# --- poses --------------------------------------------------------------------------------------------------


def _wished_homes(robot: Robot, semantics: Semantics) -> list[Array]:
    """Named poses of the SRDF, then the middle of the joints' ranges; rounded, and within the limits."""
    states: list[Mapping[str, float]] = [*semantics.states.values(), {}]
    return [_posed(robot.model, robot.home, state) for state in states]


def _posed(model: Any, q: Array, state: Mapping[str, float]) -> Array:
    values = {**_joint_values(model, q), **{name: value for name, value in state.items() if model.existJointName(name)}}
    q = q.copy()
    for name, value in values.items():
        joint = model.joints[model.getJointId(name)]
        if joint.nq == 1:
            low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
            q[joint.idx_q] = np.clip(round(value, 4), low, high) if low < high else round(value, 4)
        elif joint.nq == 2:
            q[joint.idx_q : joint.idx_q + 2] = math.cos(round(value, 4)), math.sin(round(value, 4))
    return q


def _joint_values(model: Any, q: Array) -> dict[str, float]:
    """Position of every joint that one number describes [rad or m]."""
    values = {}
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        if joint.nq == 1:
            values[name] = round(float(q[joint.idx_q]), _DIGITS)
        elif joint.nq == 2 and joint.nv == 1:
            values[name] = round(math.atan2(q[joint.idx_q + 1], q[joint.idx_q]), _DIGITS)
    return values


def _locks(urdf: Path, model: Any, patterns: Sequence[str], semantics: Semantics, notes: list[str]) -> dict[str, float]:
    """Joints that are held, and where: those the user names, and those that move together with others.

    A joint that mimics another would move on its own otherwise, which it cannot.
    """
    names = list(model.names)[1:]
    held = []
    for pattern in patterns:
        found = [name for name in names if fnmatchcase(name, pattern)]
        if not found:
            raise UnknownName(f"--lock: no joint {pattern!r}{nearest(pattern, names)}")
        held += found
    followers = {name: source for name, source in mimics(urdf).items() if name in names}
    coupled = [name for name in names if name in followers or name in {source[0] for source in followers.values()}]
    if coupled := [name for name in coupled if name not in held]:
        notes.append(f"held at home, because they move together (mimic): {', '.join(coupled)}")
    state = next(iter(semantics.states.values()), {})
    start = _joint_values(model, _posed(model, middle(model), state))
    values = {}
    for name in [*held, *coupled]:
        if name not in start:
            raise ConfigError(f"--lock: joint {name!r} is not described by one number and cannot be held; leave it out")
        leader, multiplier, offset = followers.get(name, (name, 1.0, 0.0))
        values[name] = round(multiplier * start.get(leader, 0.0) + offset, _DIGITS)
    return values


def mimics(urdf: Path) -> dict[str, tuple[str, float, float]]:
    """Joint: the one that it follows, multiplier and offset."""
    if is_mjcf(urdf):
        return {}
    found: dict[str, tuple[str, float, float]] = {}
    for joint in read_robot_xml(urdf, "URDF").iter("joint"):
        mimic: ET.Element | None = joint.find("mimic")
        if mimic is not None:
            numbers = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
            found[joint.get("name", "")] = (mimic.get("joint", ""), *numbers)
    return found
