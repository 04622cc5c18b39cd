"""Makes a robot.yaml and an SRDF of a bare URDF: bodies, pairs, a home pose, end effectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from qpavoid.config import RobotConfig
from qpavoid.describe.fit import Bodies
from qpavoid.describe.poses import joint_values, locks, wished_homes
from qpavoid.describe.reasons import by_link, pair_reasons, watching
from qpavoid.describe.sampling import CLEAR, SAMPLES, SEED, always_near, clear_home, sample_pairs, touching
from qpavoid.describe.shapes import LinkBodies, Piece, bodies_of_link, kinds_of_links
from qpavoid.describe.srdf import Semantics, find_srdf, read_srdf
from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.geometry.bodies import check_meshes
from qpavoid.geometry.ends import end_effectors
from qpavoid.geometry.urdf import read_collision, read_model, read_pieces
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
    package_dirs: Sequence[Path] = ()
    """Folders in which `package://` meshes are looked up."""
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
    model = read_model(urdf, wishes.root)
    honoured = wishes.srdf or find_srdf(urdf)
    semantics = _semantics(honoured, model, wishes)
    notes: list[str] = []
    pieces = _pieces(urdf, model, wishes, notes)
    bare = RobotConfig(
        name=wishes.name or urdf.stem,
        urdf=str(urdf),
        root_joint=wishes.root,
        package_dirs=[str(folder.resolve()) for folder in wishes.package_dirs],
        lock=locks(urdf, model, wishes.lock, semantics, notes),
        end_effectors=end_effectors(model, semantics.end_effectors),
    )
    given = bare.model_copy(update={"srdf": None if honoured is None else str(honoured.resolve())})
    links = _links(pieces, given, semantics, wishes, notes)
    bodies = {"bodies": [body for link in links.values() for body in link.bodies]}
    robot = Robot.from_config(given.model_copy(update=bodies), urdf)
    sampled = sample_pairs(robot, wishes.samples, wishes.seed)
    reasons = pair_reasons(Robot.from_config(bare.model_copy(update=bodies), urdf), robot, sampled)
    disabled, single = by_link(robot, reasons)
    watched = watching(robot, ~sampled.never & ~sampled.always)
    home, clearance, taken = clear_home(watched, wished_homes(watched, semantics), seed=wishes.seed)
    _say_what_is_missing(bare, clearance, taken is None, notes)
    home_values = joint_values(watched.model, home)
    counts = {kind: list(reasons.values()).count(kind) for kind in ("adjacent", "srdf", "always", "never")}
    every = robot.bodies.ngeoms * (robot.bodies.ngeoms - 1) // 2
    return Described(
        config=bare.model_copy(update={**bodies, "disabled_pairs": single, "home": home_values}),
        robot=replace(watched, home=home),
        urdf=urdf,
        wishes=wishes,
        pieces=pieces,
        honoured=honoured,
        disabled={**disabled, **{pair: why for pair, why in semantics.disabled.items() if _known(pair, model)}},
        volume={link: (bodies_of.volume, bodies_of.hulls) for link, bodies_of in links.items()},
        counts={"all": every, **counts, "watched": every - sum(counts.values())},
        clearance=clearance,
        notes=tuple(notes),
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


def _say_what_is_missing(config: RobotConfig, clearance: float, drawn: bool, notes: list[str]) -> None:
    if clearance <= 0.0:
        notes.append(
            "no pose clear of collision was found; `qpavoid robot check` names the pairs: list them under "
            "`disabled_pairs`, or give their links leaner bodies with --bodies LINK=convex"
        )
    elif drawn:
        notes.append("the wished home poses are not clear of collision; one near the first of them was drawn")
    if not config.end_effectors:
        notes.append("no end effector was recognised; list the frames of your tools under `end_effectors`")


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


def _links(
    pieces: Sequence[Piece], config: RobotConfig, semantics: Semantics, wishes: Wishes, notes: list[str]
) -> dict[str, LinkBodies]:
    """Bodies of every link; `auto` takes exact ones where capsules would be too near at home or everywhere."""
    kinds = kinds_of_links(pieces, wishes.bodies, wishes.bodies_of)
    fitted = {link: bodies_of_link(pieces, link, kind) for link, kind in kinds.items()}
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
        notes.append(f"exact where capsules would be too near at home or everywhere: {', '.join(exact)}")
    return links


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
