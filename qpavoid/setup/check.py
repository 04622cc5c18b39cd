"""The check of a robot before it is used: its parts, its faults, and their remedies."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.config import RobotConfig, Task
from qpavoid.config.loading import read_config
from qpavoid.config.shipped import find_robot
from qpavoid.control.tasks import build_tasks
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError, QpavoidError
from qpavoid.model.end_effectors import end_effectors
from qpavoid.model.notes import SEVERITIES, Note, NoteKind, RobotWarning, abbreviate
from qpavoid.model.packages import absolute_entries, find_mesh, mesh_folders
from qpavoid.model.robot import Robot
from qpavoid.model.scene import build_scene
from qpavoid.model.space import Space
from qpavoid.model.urdf import find_resource, is_mjcf, mesh_names, read_model, read_pieces
from qpavoid.setup.home import MIN_CONDITIONING, Conditioning, Limbs
from qpavoid.setup.joints import Joint, joint_notes, list_joints
from qpavoid.setup.pairs import find_unchecked
from qpavoid.setup.shapes import Piece, pieces_of

_MAX_STEPS, _MAX_SECONDS = 300, 5.0
"""Control steps that are timed for the median, and the time after which timing ends [s]."""
_SLOW_STEP = 1000.0
"""Median control step from which a warning is given: the whole period of a 1 kHz loop [µs]."""


@dataclass
class Report:
    """Findings of `robot check`."""

    name: str
    source: str
    nq: int = 0
    nv: int = 0
    joints: list[Joint] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)
    shapes: dict[str, int] = field(default_factory=dict)
    """Pieces of collision geometry by type."""
    triangles: int = 0
    """Of all collision meshes."""
    bodies: int = 0
    pairs: int = 0
    home_collisions: list[tuple[str, str, float]] = field(default_factory=list)
    """Pairs that touch at the home pose, and their distance [m]."""
    end_effectors: list[str] = field(default_factory=list)
    load_seconds: float | None = None
    tick_us: float | None = None
    """Median control step that tracks all end effectors, without obstacles [µs]."""
    clearance: float | None = None
    """Least distance of any pair at the home pose [m]; None: no pair."""
    conditioning: dict[str, Conditioning] = field(default_factory=dict)
    """Of the limb that ends at each end effector, at the home pose."""
    notes: list[Note] = field(default_factory=list)
    """What was left out, mended, replaced or assumed, and what is wrong; errors first."""
    robot: Robot | None = field(default=None, repr=False)
    """The robot itself, where it can be made."""

    @property
    def usable(self) -> bool:
        """Whether it can run as it is."""
        return not any(note.severity == "error" for note in self.notes)

    def add(self, severity: Any, kind: NoteKind, names: Sequence[str], clause: str, remedy: str) -> None:
        """Add a note."""
        self.notes.append(Note(kind, tuple(names), clause, remedy, severity))


def check_robot(
    name_or_path: str,
    root: str = "fixed",
    package_dirs: Sequence[str | Path] = (),
    allow_missing_meshes: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> Report:
    """Look over a URDF, an MJCF, a robot.yaml or a robot that ships.

    Args:
        name_or_path: which one.
        root: how its root link is attached to the world; a robot.yaml says so itself.
        package_dirs: folders to look for meshes in, and `NAME=FOLDER`; before those that a robot.yaml names.
        allow_missing_meshes: whether shapes whose mesh cannot be found are left out.
        progress: called with what is done next.

    Raises:
        ConfigError, UnknownName: it cannot be read at all.
    """
    path = find_robot(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        config = read_config(path, RobotConfig)
    else:
        config = RobotConfig(name=path.stem, urdf=path.name, root_joint=root)  # type: ignore[arg-type]
    entries = [*absolute_entries([str(entry) for entry in package_dirs], Path.cwd()), *config.package_dirs]
    missing = allow_missing_meshes or config.allow_missing_meshes
    config = config.model_copy(update={"package_dirs": entries, "allow_missing_meshes": missing})
    progress("reading the model")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RobotWarning)  # all notes of the robot are in the report
        return _report(config, path, progress)


def _report(config: RobotConfig, path: Path, progress: Callable[[str], None]) -> Report:
    urdf = find_resource(config.urdf, path.parent, f"{path}: urdf")
    model = read_model(urdf, config.root_joint)
    report = Report(config.name, str(path), model.nq, model.nv)
    report.frames = [f.name for f in model.frames if f.type in (pin.BODY, pin.OP_FRAME)]
    report.end_effectors = list(config.end_effectors) or end_effectors(model)
    pieces = _check_geometry(report, config, path, urdf, model)
    robot = None
    if report.usable:
        progress("making the robot")
        begin = perf_counter()
        try:
            robot = Robot.from_config(config, path)
        except ConfigError as error:
            report.add("error", NoteKind.FILE, (), str(error), "mend what it names")
        report.load_seconds, report.robot = perf_counter() - begin, robot
    report.joints = list_joints(urdf, model if robot is None else robot.model, config, model)
    report.notes += joint_notes(report.joints, config)
    if robot is not None:
        report.notes += robot.notes
        _check_built_robot(report, robot, pieces, progress)
    if massless := sum(inertia.mass <= 0.0 for inertia in list(model.inertias)[1:]):
        clause = f"{massless} moving links have no mass"
        report.add("note", NoteKind.LINK, (), clause, "none is needed unless torques are asked for")
    report.notes.sort(key=lambda note: SEVERITIES.index(note.severity))
    return report


def _check_geometry(report: Report, config: RobotConfig, path: Path, urdf: Path, model: Any) -> list[Piece]:
    """Read the collision geometry; return its pieces, none where a mesh is missing or cannot be read."""
    packages = absolute_entries(config.package_dirs, path.parent)
    folders = mesh_folders(urdf, packages)
    names = [] if is_mjcf(urdf) else mesh_names(urdf, "collision")  # an MJCF finds its meshes by its own rules
    missing = [name for name in names if find_mesh(name, folders) is None]
    if missing and not config.allow_missing_meshes:
        clause = (
            f"{len(missing)} collision meshes are missing, such as {missing[0]!r}; looked for in "
            f"{abbreviate(folders, 8)}"
        )
        remedy = (
            "name the folder that holds the package with --package-dir or --package NAME=FOLDER (`package_dirs` of a "
            "robot.yaml), set ROS_PACKAGE_PATH, or go on without them: --allow-missing-meshes"
        )
        report.add("error", NoteKind.MESH, (), clause, remedy)
        return []
    try:
        geometry = read_pieces(
            urdf, model, packages, path, visuals=config.visuals, allow_missing=config.allow_missing_meshes
        ).geometryObjects
    except ConfigError as error:
        report.add("error", NoteKind.MESH, (), str(error), "export that mesh again, or take it out")
        return []
    report.shapes = dict(Counter(_shape_name(piece.geometry) for piece in geometry))
    meshes = [piece.geometry for piece in geometry if isinstance(piece.geometry, coal.BVHModelBase)]
    report.triangles = sum(int(mesh.num_tris) for mesh in meshes)
    return pieces_of(geometry, model)


def _shape_name(geometry: Any) -> str:
    if isinstance(geometry, coal.BVHModelBase):
        return "mesh"
    return "convex mesh" if isinstance(geometry, coal.ConvexBase) else type(geometry).__name__.lower()


def _check_built_robot(report: Report, robot: Robot, pieces: Sequence[Piece], progress: Callable[[str], None]) -> None:
    report.nq, report.nv = robot.model.nq, robot.model.nv
    report.bodies, report.pairs = len(robot.bodies.geometryObjects), len(robot.bodies.collisionPairs)
    if not report.bodies:
        remedy = "`qpavoid robot add` fits them to what is meant to be seen; or list `bodies` in a robot.yaml"
        report.add("error", NoteKind.SHAPE, (), "it has no collision bodies: nothing would be avoided", remedy)
    _check_home(report, robot)
    progress("comparing with the geometry")
    report.notes += [note for entry in find_unchecked(robot, pieces) for note in entry.notes()]
    if not report.end_effectors:
        remedy = "list the frames of your tools under `end_effectors`"
        report.add("note", NoteKind.FRAME, (), "no frame looks like a tool", remedy)
    feet = [name for name in report.end_effectors if "foot" in name.lower() or "sole" in name.lower()]
    if feet and not any(joint.kind in ("floating", "planar") for joint in report.joints):
        clause = f"it has feet ({abbreviate(feet)}) and a fixed base"
        report.add("note", NoteKind.JOINT, (), clause, "`root_joint: free_flyer`, or --root")
    progress("timing a control step")
    try:
        report.tick_us = _step_time(robot, report.end_effectors)
    except QpavoidError as error:
        report.add("error", NoteKind.FILE, (), f"a controller cannot be made: {error}", "mend what it names")
        return
    if report.tick_us > _SLOW_STEP:
        clause = f"a control step takes {report.tick_us:.0f} µs with {report.pairs} pairs"
        remedy = "`qpavoid robot add` finds pairs that never collide, and capsules; `lock` joints that you do not use"
        report.add("warning", NoteKind.PAIR, (), clause, remedy)


def _check_home(report: Report, robot: Robot) -> None:
    """Describe the home pose; pairs that are near there are notes of the robot's own."""
    report.clearance = min(robot.home_distances.values(), default=None)
    report.home_collisions = [pair for pair in robot.near_at_home(0.0) if pair[2] <= 0.0]
    report.conditioning = Limbs(robot, report.end_effectors).at(robot.home)
    if singular := [name for name, limb in report.conditioning.items() if limb.ratio < MIN_CONDITIONING]:
        clause = "the home pose is singular or nearly so: they cannot move well in every direction there"
        remedy = "start scenarios elsewhere (`q0`), or give a `home` with bent joints"
        report.add("note", NoteKind.HOME, singular, clause, remedy)


def _step_time(robot: Robot, frames: Sequence[str]) -> float:
    """Time a control step near the home pose whose tasks keep all end effectors where they are; the median [µs]."""
    known = [frame for frame in frames if robot.model.existFrame(frame)]
    tasks = build_tasks([Task(frame=frame) for frame in known], robot, robot.home)
    controller = Controller(build_scene(robot), tasks)
    space, random = Space(robot.model, robot.bounds()), np.random.default_rng(0)
    times: list[float] = []
    while len(times) < _MAX_STEPS and sum(times) <= _MAX_SECONDS:
        q = space.move(robot.home, random.normal(0.0, 0.05, robot.model.nv))
        begin = perf_counter()
        controller.step(q)
        times.append(perf_counter() - begin)
    return 1e6 * float(np.median(times))
