"""Makes a robot.yaml and an SRDF of a bare URDF: bodies, pairs, a home pose, end effectors."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from qpavoid.config import JointLimits, RobotConfig
from qpavoid.describe.fit import GROSS, Bodies
from qpavoid.describe.home import ROOM, Home, find_home
from qpavoid.describe.poses import joint_values, locks, wished_homes
from qpavoid.describe.reasons import (
    LeftOut,
    Reason,
    by_link,
    contact_shares,
    keeping,
    left_out,
    own_margins,
    pair_reasons,
    srdf_reason,
)
from qpavoid.describe.sampling import (
    D1,
    SAMPLES,
    SEED,
    always_near,
    robot_size,
    safety_distances,
    sample_pairs,
    touching,
)
from qpavoid.describe.shapes import LinkBodies, Piece, bodies_of_link, kinds_of_links, pieces_of
from qpavoid.describe.srdf import Semantics, find_srdf, read_srdf
from qpavoid.describe.telescope import drawn_in
from qpavoid.describe.wheels import wheel_joints
from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.files.packages import absolute_entries
from qpavoid.geometry.bodies import check_meshes
from qpavoid.geometry.ends import end_effectors
from qpavoid.geometry.plausible import name_implausible_sizes
from qpavoid.geometry.urdf import read_model, read_pieces
from qpavoid.kinematics import MIMIC
from qpavoid.notes import Note, NoteKind, RobotWarning, merged
from qpavoid.problem import Array
from qpavoid.robot import Robot

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
    honoured: Path | None
    """That SRDF."""
    disabled: Mapping[frozenset[str], str]
    """Two links that are not checked, and why: to be written as an SRDF."""
    links: Mapping[str, LinkBodies]
    """Link: its bodies and their volumes."""
    counts: Mapping[str, int]
    """Pairs: all, adjacent, srdf, always, drawn in, never, active."""
    near: float
    """Distance that counts as never coming near [m]."""
    left_out: Sequence[LeftOut]
    """Links that are not checked against each other."""
    home: Home
    """The home pose."""
    notes: Sequence[Note]
    """What was left out, mended, replaced or assumed."""


def _silent(_: str) -> None:
    """Say nothing of the progress."""


def describe(urdf: Path, wishes: Wishes | None = None, progress: Callable[[str], None] = _silent) -> Described:
    """Work out what a robot.yaml has to say of a URDF or MJCF.

    Args:
        urdf: the file.
        wishes: what the user chose.
        progress: called with what is done next.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    wishes = wishes or Wishes()
    urdf = urdf.resolve()
    progress("reading the model")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RobotWarning)  # all notes of the robot are in the description
        return _describe(urdf, wishes, progress)


def _describe(urdf: Path, wishes: Wishes, progress: Callable[[str], None]) -> Described:
    model = read_model(urdf, wishes.root)
    honoured = wishes.srdf or find_srdf(urdf)
    semantics = _semantics(honoured, model, wishes)
    notes: list[Note] = []
    packages = absolute_entries([str(entry) for entry in wishes.package_dirs], Path.cwd())
    pieces = _pieces(urdf, model, packages, wishes, notes)
    bare = RobotConfig(
        name=wishes.name or urdf.stem,
        urdf=str(urdf),
        root_joint=wishes.root,
        package_dirs=packages,
        allow_missing_meshes=wishes.allow_missing_meshes,
        lock=locks(urdf, model, wishes.lock, semantics, notes, _wheels(model, pieces, wishes)),
        end_effectors=end_effectors(model, semantics.end_effectors),
    )
    given = bare.model_copy(update={"srdf": None if honoured is None else str(honoured.resolve())})
    links, robot = _links(pieces, given, semantics, wishes, notes, progress)
    bodies = {"bodies": [body for link in links.values() for body in link.bodies]}
    everything = robot if honoured is None else Robot.from_config(bare.model_copy(update=bodies), urdf)
    progress(f"sampling {len(robot.bodies.collisionPairs)} pairs")
    sampled = sample_pairs(robot, wishes.samples, wishes.seed)
    nested = drawn_in(robot, sampled)
    reasons = pair_reasons(everything, robot, sampled, nested)
    disabled, single = by_link(robot, reasons)
    kept = ~sampled.never & ~sampled.always & ~nested
    active, d1 = keeping(robot, kept), safety_distances(sampled)[kept]
    progress("looking for a home pose")
    home = find_home(active, wished_homes(active, semantics), bare.end_effectors, d1, wishes.home, wishes.seed)
    progress("comparing with the geometry")
    shares = contact_shares(robot, sampled)
    out = left_out(active, pieces, disabled, shares)
    notes += [note for entry in out if (note := entry.note()) is not None]
    notes += _notes_of_home(active, home, wishes)
    if not bare.end_effectors:
        remedy = "list the frames of your tools under `end_effectors`"
        notes.append(Note(NoteKind.FRAME, (), "no end effector was recognised", remedy))
    counts = {kind: list(reasons.values()).count(kind) for kind in get_args(Reason)}
    every = robot.bodies.ngeoms * (robot.bodies.ngeoms - 1) // 2
    margins = own_margins(active, d1)
    return Described(
        config=bare.model_copy(
            update={
                **bodies,
                "disabled_pairs": single,
                "pair_margins": margins,
                "limits": JointLimits(velocity=_assumed_speeds(model, active.model)),
                "home": joint_values(active.model, home.q),
            }
        ),
        robot=replace(active, home=home.q),
        urdf=urdf,
        wishes=wishes,
        pieces=pieces,
        honoured=honoured,
        disabled={
            **{pair: srdf_reason(why) for pair, why in disabled.items()},
            **{pair: why for pair, why in semantics.disabled.items() if _known(pair, model)},
        },
        links=links,
        counts={"all": every, **counts, "active": every - sum(counts.values())},
        near=sampled.near,
        left_out=out,
        home=home,
        notes=tuple(dict.fromkeys(merged([*robot.notes, *notes]))),
    )


def _semantics(srdf: Path | None, model: Any, wishes: Wishes) -> Semantics:
    """What an SRDF says, with the home pose that the user prefers as its first one."""
    semantics = Semantics() if srdf is None else read_srdf(srdf)
    for name, value in wishes.home.items():
        if not model.existJointName(name):
            raise UnknownName(f"--home: no joint {name!r}{nearest(name, list(model.names)[1:])}")
        joint = model.joints[model.getJointId(name)]
        if joint.nq == 1:
            low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
            if low < high and not low <= value <= high:
                raise ConfigError(f"--home: {name} = {value:g} lies outside its limits [{low:g}, {high:g}] [rad or m]")
    return replace(semantics, states={"--home": wishes.home, **semantics.states}) if wishes.home else semantics


def _known(pair: frozenset[str], model: Any) -> bool:
    return all(model.existFrame(link) for link in pair)


def _assumed_speeds(model: Any, used: Any) -> dict[str, float | list[float]]:
    """Largest speeds that the robot has though its file gives none: written out, so that they can be seen and mended.

    Args:
        model: as the file has it.
        used: the robot's.
    """
    assumed: dict[str, float | list[float]] = {}
    for name, joint in zip(list(used.names)[1:], list(used.joints)[1:], strict=True):
        of_file = model.joints[model.getJointId(name)]
        given = np.array(model.velocityLimit[of_file.idx_v : of_file.idx_v + of_file.nv])
        speeds = np.array(used.velocityLimit[joint.idx_v : joint.idx_v + joint.nv])
        if joint.shortname() != MIMIC and np.any((given != speeds) & np.isfinite(speeds)):
            assumed[name] = float(speeds[0]) if joint.nv == 1 else speeds.tolist()
    return assumed


def _wheels(model: Any, pieces: Sequence[Piece], wishes: Wishes) -> list[str]:
    return [] if wishes.root == "fixed" else wheel_joints(model, pieces)


def _notes_of_home(robot: Robot, home: Home, wishes: Wishes) -> Iterator[Note]:
    """Say where the home pose comes from, if it is none of the wishes, and what is wrong with it."""
    kind = NoteKind.HOME
    if home.clearance <= 0.0:
        remedy = (
            "`qpavoid robot check` names the pairs: list them under `disabled_pairs`, or give their links leaner "
            "bodies with --bodies LINK=convex"
        )
        yield Note(kind, home.nearest or (), "no pose clear of collision was found", remedy, "warning")
    elif home.short > 0.0:
        what = f"nearest pair, {1e3 * home.clearance:.1f} mm apart: no pose with room to move was found"
        yield Note(kind, home.nearest or (), what, "give a pose with --home JOINT=VALUE", "warning")
    if home.wish is None:
        start = "the one that was wished" if wishes.home else "the SRDF's poses and the middle of the joints' ranges"
        what = f"drawn near {start}, where pairs are too near or a limb is singular"
        moved = tuple(name for name, value in joint_values(robot.model, home.q).items() if value)
        yield Note(kind, moved, what, "--home JOINT=VALUE")
    if home.singular:
        what = "cannot move well in every direction there: singular, or nearly so"
        yield Note(kind, tuple(home.singular), what, "bend it with --home")


def _pieces(urdf: Path, model: Any, packages: Sequence[str], wishes: Wishes, notes: list[Note]) -> list[Piece]:
    """Collision geometry; of links without any, what is meant to be seen of them."""
    geometry = read_pieces(urdf, model, packages, urdf, notes, allow_missing=wishes.allow_missing_meshes)
    if not geometry.ngeoms:
        what = "has no geometry at all: nothing is checked"
        notes.append(Note(NoteKind.SHAPE, (urdf.name,), what, "list `bodies`", "warning"))
    check_meshes(geometry, str(urdf))
    name_implausible_sizes(model, geometry, notes)
    return pieces_of(geometry.geometryObjects, model)


def _links(
    pieces: Sequence[Piece],
    config: RobotConfig,
    semantics: Semantics,
    wishes: Wishes,
    notes: list[Note],
    progress: Callable[[str], None],
) -> tuple[dict[str, LinkBodies], Robot]:
    """Bodies of every link, and the robot with them.

    `auto` takes exact ones where capsules would be too near at home or everywhere.
    """
    kinds = kinds_of_links(pieces, wishes.bodies, wishes.bodies_of)
    fitted = {}
    for number, (link, kind) in enumerate(kinds.items(), start=1):
        progress(f"fitting bodies to link {number} of {len(kinds)}: {link}")
        fitted[link] = bodies_of_link(pieces, link, kind)
    links = dict(fitted)
    while True:
        listed = [body for link in links.values() for body in link.bodies]
        robot = Robot.from_config(config.model_copy(update={"bodies": listed}), Path(config.urdf))
        fat = _too_fat(robot, wished_homes(robot, semantics)[0], wishes.seed)
        mended = {link: bodies_of_link(pieces, link, "convex") for link in fat if kinds[link] == "auto"}
        if all(links[link] == bodies for link, bodies in mended.items()):
            break
        links.update(mended)
    if exact := [link for link in links if links[link] != fitted[link]]:
        what = "exact bodies, because capsules would be too near at home or everywhere"
        notes.append(Note(NoteKind.SHAPE, tuple(exact), what))
    gross = {link: found for link, found in links.items() if found.volume > GROSS * found.inside > 0.0}
    if worst := sorted(gross, key=lambda link: -gross[link].volume):
        first = gross[worst[0]]
        what = (
            f"bodies of more than {GROSS:g} times what their geometry encloses, {1e3 * first.volume:.3g} l around "
            f"{1e3 * first.inside:.3g} l of the first: concave, or no closed surface"
        )
        notes.append(Note(NoteKind.SHAPE, tuple(worst), what, f"--bodies {worst[0]}=capsules, or bodies of your own"))
    return links, robot


def _too_fat(robot: Robot, home: Array, seed: int) -> set[str]:
    """Links of the pairs that are too near at the home pose, or in every one of a few random poses."""
    names = [body.name for body in robot.bodies.geometryObjects]
    near = [names[i] for pair in always_near(robot, _FEW, seed) for i in pair]
    near += [body for pair in robot.always_touching for body in pair[:2]]
    near += [body for a, b, _ in touching(robot, home, min(_CLEAR * robot_size(robot), ROOM * D1)) for body in (a, b)]
    link = {body.name: robot.model.frames[body.parentFrame].name for body in robot.bodies.geometryObjects}
    return {link[body] for body in near}


_CLEAR = 0.04
"""Distance at the wished home pose, as a share of the robot's size, within which capsules are too fat [-]."""
_FEW = 200
"""Random poses that tell whether capsules are too fat."""
