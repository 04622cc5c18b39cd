"""A robot.yaml and an SRDF for a bare URDF: bodies, pairs, a home pose, end effectors."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from qpavoid.config import JointLimits, RobotConfig
from qpavoid.errors import ConfigError, matching
from qpavoid.model.end_effectors import end_effectors
from qpavoid.model.joints import find_joint
from qpavoid.model.kinematics import MIMIC
from qpavoid.model.notes import Note, NoteKind, RobotWarning, merge_notes
from qpavoid.model.packages import absolute_entries
from qpavoid.model.pairs import D1
from qpavoid.model.robot import Robot
from qpavoid.model.shape_checks import note_implausible_sizes
from qpavoid.model.urdf import read_model, read_pieces
from qpavoid.problem import Array
from qpavoid.setup import pairs
from qpavoid.setup.fit import MAX_VOLUME_RATIO, Bodies
from qpavoid.setup.home import HOME_CLEARANCE, Home, find_home
from qpavoid.setup.joints import home_candidates, joint_locks, joint_values
from qpavoid.setup.sampling import (
    SAMPLES,
    SEED,
    robot_size,
    safety_distances,
    sample_pairs,
    touching,
)
from qpavoid.setup.shapes import LinkBodies, Piece, bodies_of_link, kinds_of_links, pieces_of
from qpavoid.setup.srdf import Semantics, find_srdf, read_srdf
from qpavoid.setup.wrist import wrist_links

Root = Literal["fixed", "planar", "free_flyer"]
PROTRUSION, WRIST_PROTRUSION = 0.02, 0.005
"""How far bodies may stand out of the geometry, and from the wrist on [m]: grasps bring a hand and the links before it
within 5 to 10 mm of what stands around, and nothing else of an arm."""
_TIGHTER = 0.25
"""Part of the bound that remains for links whose bodies are too near at home or everywhere [-]."""
_HOME_NEAR = 0.04
"""Distance at the preferred home pose, as a share of the robot's size, within which capsules are oversized [-]."""


@dataclass(frozen=True)
class DescribeOptions:
    """Options of `robot add`."""

    name: str | None = None
    """Of the robot; that of the file if left out."""
    bodies: Bodies = "auto"
    """Kind of collision bodies."""
    bodies_of: Mapping[str, Bodies] = field(default_factory=dict)
    """Link (with `*` and `?`): another kind."""
    protrusion: float = PROTRUSION
    """How far bodies of `auto` may stand out of the geometry [m]."""
    wrist_protrusion: float = WRIST_PROTRUSION
    """The same from the wrist on: of what comes close to what is grasped [m]."""
    wrist: Sequence[str] | None = None
    """Links (with `*` and `?`) that count as from the wrist on; found by `wrist_links` if left out."""
    root: Root = "fixed"
    """How the root link is attached to the world."""
    lock: Sequence[str] = ()
    """Joints (with `*` and `?`) locked at the home pose."""
    home: Mapping[str, float] = field(default_factory=dict)
    """Joint: position of a home pose to prefer [rad or m]."""
    package_dirs: Sequence[str | Path] = ()
    """Folders in which `package://` meshes are looked up, and `NAME=FOLDER` of single packages."""
    allow_missing_meshes: bool = False
    """Whether shapes whose mesh cannot be found are left out."""
    srdf: Path | None = None
    """An SRDF to honour; one found beside the URDF if left out."""
    samples: int = SAMPLES
    """Configurations drawn to find pairs that never collide."""
    seed: int = SEED
    """Of the draw."""


@dataclass(frozen=True)
class Description:
    """A robot's description, with how it came about."""

    config: RobotConfig
    """Fields of the robot.yaml; file names in it are absolute."""
    robot: Robot
    """As it is with that description."""
    options: DescribeOptions
    """What the user chose."""
    pieces: Sequence[Piece]
    """What the bodies enclose."""
    honoured: Path | None
    """That SRDF."""
    disabled: Mapping[frozenset[str], str]
    """Two links that are not checked, and why: to be written as an SRDF."""
    links: Mapping[str, LinkBodies]
    """Link: its bodies and their volumes."""
    reasons: Mapping[frozenset[str], pairs.Reason]
    """Two bodies that are not checked, and why."""
    counts: Mapping[str, int]
    """Pairs: all, adjacent, srdf, always, drawn in, never, active."""
    near: float
    """Distance that counts as never coming near [m]."""
    unchecked: Sequence[pairs.UncheckedLinks]
    """Links that are not checked against each other."""
    home: Home
    """The home pose."""
    notes: Sequence[Note]
    """What was left out, mended, replaced or assumed."""


def describe(
    urdf: Path, options: DescribeOptions | None = None, progress: Callable[[str], None] = lambda _: None
) -> Description:
    """Work out the robot.yaml of a URDF or MJCF.

    Args:
        urdf: the file.
        options: what the user chose.
        progress: called with what is done next.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    progress("reading the model")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RobotWarning)  # all notes of the robot are in the description
        return _describe(urdf.resolve(), options or DescribeOptions(), progress)


def _describe(urdf: Path, options: DescribeOptions, progress: Callable[[str], None]) -> Description:
    model = read_model(urdf, options.root)
    honoured = options.srdf or find_srdf(urdf)
    semantics = _semantics(honoured, model, options)
    notes: list[Note] = []
    packages = absolute_entries([str(entry) for entry in options.package_dirs], Path.cwd())
    pieces = _pieces(urdf, model, packages, options, notes)
    bare = RobotConfig(
        name=options.name or urdf.stem,
        urdf=str(urdf),
        root_joint=options.root,
        package_dirs=packages,
        allow_missing_meshes=options.allow_missing_meshes,
        lock=joint_locks(urdf, model, options.lock, semantics, notes, options.root != "fixed"),
        end_effectors=end_effectors(model, semantics.end_effectors),
    )
    with_srdf = bare.model_copy(update={"srdf": None if honoured is None else str(honoured.resolve())})
    wrist = _wrist(model, bare.end_effectors, pieces, options)
    links, robot = _links(pieces, with_srdf, wrist, semantics, options, notes, progress)

    progress(f"sampling {len(robot.bodies.collisionPairs)} pairs")
    sampled = sample_pairs(robot, options.samples, options.seed)
    is_nested = pairs.nested_pairs(robot, sampled)
    reasons = pairs.pair_reasons(robot, sampled, is_nested)
    disabled, single = pairs.by_link(robot, reasons)
    is_active = ~sampled.never & ~sampled.always & ~is_nested
    active, d1 = pairs.with_pairs(robot, is_active), safety_distances(sampled)[is_active]

    progress("looking for a home pose")
    home = find_home(active, home_candidates(active, semantics), bare.end_effectors, d1, options.home, options.seed)
    progress("comparing with the geometry")
    unchecked = pairs.measure_unchecked(active, pieces, disabled)
    notes += [
        *(note for entry in unchecked for note in entry.notes()),
        *_notes_of_home(active, home, options, bool(semantics.states)),
    ]
    if not bare.end_effectors:
        remedy = "list the frames of your tools under `end_effectors`"
        notes.append(Note(NoteKind.FRAME, (), "no end effector was recognised", remedy))
    counts = {kind: list(reasons.values()).count(kind) for kind in get_args(pairs.Reason)}
    pair_count = robot.bodies.ngeoms * (robot.bodies.ngeoms - 1) // 2
    of_srdf = {pair: why for pair, why in semantics.disabled.items() if all(map(model.existFrame, pair))}
    decided = {
        "bodies": [body for link in links.values() for body in link.bodies],
        "disabled_pairs": single,
        "pair_margins": pairs.own_margins(active, d1),
        "limits": JointLimits(velocity=_assumed_speeds(model, active.model)),
        "home": joint_values(active.model, home.q),
    }
    of_file = [note for note in robot.notes if note.kind is not NoteKind.HOME]  # it has another home now
    return Description(
        config=bare.model_copy(update=decided),
        robot=replace(active, home=home.q),
        options=options,
        pieces=pieces,
        honoured=honoured,
        disabled={**{pair: pairs.SRDF_REASONS[why] for pair, why in disabled.items()}, **of_srdf},
        links=links,
        reasons=reasons,
        counts={"all": pair_count, **counts, "active": pair_count - sum(counts.values())},
        near=sampled.near,
        unchecked=unchecked,
        home=home,
        notes=tuple(dict.fromkeys(merge_notes([*of_file, *notes]))),
    )


def _semantics(srdf: Path | None, model: Any, options: DescribeOptions) -> Semantics:
    """Read an SRDF, with the home pose that the user prefers as its first one."""
    semantics = Semantics() if srdf is None else read_srdf(srdf)
    for name, value in options.home.items():
        joint = find_joint(model, name, "--home")
        if joint.nq == 1:
            low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
            if low < high and not low <= value <= high:
                raise ConfigError(f"--home: {name} = {value:g} lies outside its limits [{low:g}, {high:g}] [rad or m]")
    return replace(semantics, states={"--home": options.home, **semantics.states}) if options.home else semantics


def _assumed_speeds(model: Any, robot_model: Any) -> dict[str, float | list[float]]:
    """List the largest speeds that the robot has and the model of its file does not, so that a user can change them."""
    speeds_by_joint: dict[str, float | list[float]] = {}
    for name, joint in zip(list(robot_model.names)[1:], list(robot_model.joints)[1:], strict=True):
        of_file = model.joints[model.getJointId(name)]
        given = np.array(model.velocityLimit[of_file.idx_v : of_file.idx_v + of_file.nv])
        speeds = np.array(robot_model.velocityLimit[joint.idx_v : joint.idx_v + joint.nv])
        if joint.shortname() != MIMIC and np.any((given != speeds) & np.isfinite(speeds)):
            speeds_by_joint[name] = float(speeds[0]) if joint.nv == 1 else speeds.tolist()
    return speeds_by_joint


def _notes_of_home(robot: Robot, home: Home, options: DescribeOptions, has_states: bool) -> Iterator[Note]:
    """Yield notes on the origin of the home pose, and on what is wrong with it."""
    kind = NoteKind.HOME
    if home.clearance <= 0.0:
        remedy = (
            "`qpavoid robot check` names the pairs: list them under `disabled_pairs`, or give their links leaner "
            "bodies with --bodies LINK=convex"
        )
        yield Note(kind, home.nearest or (), "no pose clear of collision was found", remedy, "warning")
    elif home.deficit > 0.0:
        clause = f"nearest pair, {1e3 * home.clearance:.1f} mm apart: no pose with room to move was found"
        yield Note(kind, home.nearest or (), clause, "give a pose with --home JOINT=VALUE", "warning")
    if home.preference is None:
        start = "the SRDF's poses and " * has_states + "the middle of the joints' ranges"
        start = "the one that was wished" if options.home else start
        clause = f"drawn near {start}, where pairs are too near or a limb is singular"
        moved_joints = tuple(name for name, value in joint_values(robot.model, home.q).items() if value)
        yield Note(kind, moved_joints, clause, "--home JOINT=VALUE")
    if home.singular:
        clause = "cannot move well in every direction there: singular, or nearly so"
        yield Note(kind, tuple(home.singular), clause, "bend it with --home")


def _pieces(
    urdf: Path, model: Any, packages: Sequence[str], options: DescribeOptions, notes: list[Note]
) -> list[Piece]:
    """Read the collision geometry; visual geometry of links without any."""
    geometry = read_pieces(urdf, model, packages, urdf, notes, allow_missing=options.allow_missing_meshes)
    if not geometry.ngeoms:
        clause = "has no geometry at all: nothing is checked"
        notes.append(Note(NoteKind.SHAPE, (urdf.name,), clause, "list `bodies`", "warning"))
    note_implausible_sizes(model, geometry, notes)
    return pieces_of(geometry.geometryObjects, model)


def _links(
    pieces: Sequence[Piece],
    config: RobotConfig,
    wrist: set[str],
    semantics: Semantics,
    options: DescribeOptions,
    notes: list[Note],
    progress: Callable[[str], None],
) -> tuple[dict[str, LinkBodies], Robot]:
    """Fit the bodies of every link, and build the robot with them.

    `auto` takes tighter ones where they would be too near at home or everywhere.
    """
    kinds = kinds_of_links(pieces, options.bodies, options.bodies_of)
    links = {}
    for number, (link, kind) in enumerate(kinds.items(), start=1):
        progress(f"fitting bodies to link {number} of {len(kinds)}: {link}")
        bound = options.wrist_protrusion if link in wrist else options.protrusion
        links[link] = bodies_of_link(pieces, link, kind, bound)
    tighter_links: list[str] = []
    while True:
        listed = [body for link in links.values() for body in link.bodies]
        robot = Robot.from_config(config.model_copy(update={"bodies": listed}), Path(config.urdf))
        oversized = _oversized(robot, home_candidates(robot, semantics)[0])
        tighter = {
            link: bodies_of_link(pieces, link, "auto", _TIGHTER * links[link].bound)
            for link in oversized
            if kinds[link] == "auto" and link not in tighter_links
        }
        if all(links[link].bodies == made.bodies for link, made in tighter.items()):
            break
        links.update(tighter)
        tighter_links += tighter
    if tighter_links:
        clause = "tighter bodies, because others would be too near at home or everywhere"
        notes.append(Note(NoteKind.SHAPE, tuple(sorted(tighter_links, key=list(links).index)), clause))
    if loose := [link for link, made in links.items() if kinds[link] == "auto" and made.protrusion > made.limit]:
        farthest = max(links[link].protrusion for link in loose)
        clause = f"bodies that stand out farther than they should, up to {1e3 * farthest:.0f} mm: hollow, or bent"
        notes.append(Note(NoteKind.SHAPE, tuple(loose), clause, "bodies of your own, or a mesh in convex pieces"))
    gross = [link for link, made in links.items() if made.volume > MAX_VOLUME_RATIO * made.inside > 0.0]
    if worst := sorted(gross, key=lambda link: -links[link].volume):
        first = links[worst[0]]
        clause = (
            f"bodies of more than {MAX_VOLUME_RATIO:g} times what their geometry encloses, {1e3 * first.volume:.3g} l "
            f"around {1e3 * first.inside:.3g} l of the first: concave, or no closed surface"
        )
        notes.append(Note(NoteKind.SHAPE, tuple(worst), clause, f"--bodies {worst[0]}=capsules, or bodies of your own"))
    return links, robot


def _wrist(model: Any, ends: Sequence[str], pieces: Sequence[Piece], options: DescribeOptions) -> set[str]:
    """Return the links that are from the wrist on."""
    if options.wrist is None:
        return wrist_links(model, ends)
    return set(matching(options.wrist, [piece.link for piece in pieces], "--wrist: no link with geometry"))


def _oversized(robot: Robot, home: Array) -> set[str]:
    """Find the links of pairs that are too near at home, or touch in nearly every pose."""
    too_near = min(_HOME_NEAR * robot_size(robot), HOME_CLEARANCE * D1)
    link = pairs.links_of_bodies(robot)
    near_pairs = [*robot.always_touching, *(pair[:2] for pair in touching(robot, home, too_near))]
    return {link[body] for pair in near_pairs for body in pair}
