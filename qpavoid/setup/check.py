"""The check of a robot before it is used: its parts, its faults, and their remedies."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
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
from qpavoid.geometry.bodies import convert_bodies, triangle_meshes
from qpavoid.model.end_effectors import end_effectors
from qpavoid.model.kinematics import MIMIC
from qpavoid.model.notes import Note, NoteKind, RobotWarning, abbreviate
from qpavoid.model.packages import absolute_entries, find_mesh, mesh_folders
from qpavoid.model.robot import Robot
from qpavoid.model.scene import build_scene
from qpavoid.model.urdf import find_resource, is_mjcf, mesh_names, read_model, read_pieces
from qpavoid.model.xml_file import read_robot_xml
from qpavoid.setup.findings import Joint, Report
from qpavoid.setup.home import MIN_CONDITIONING, Limbs
from qpavoid.setup.poses import mimics
from qpavoid.setup.reasons import find_unchecked
from qpavoid.setup.sampling import D1, Space, touching
from qpavoid.setup.shapes import Piece, pieces_of

_MAX_STEPS, _MAX_SECONDS = 300, 5.0
"""Control steps that are timed for the median, and the time after which timing ends [s]."""
_SLOW_STEP = 1000.0
"""Median control step from which a warning is given: the whole period of a 1 kHz loop [µs]."""
_MAX_SPEED = {"revolute": 50.0, "continuous": 50.0, "prismatic": 10.0}
"""Speed limits above which one is probably an error [rad/s, m/s]."""
_MAX_RANGE = {"revolute": 8.0 * math.pi, "prismatic": 20.0}
"""Ranges above which one is probably an error [rad, m]."""
_MIN_RANGE = 1e-3
"""Range below which a joint is better locked [rad, m]."""


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
    report.without_mass = sum(inertia.mass <= 0.0 for inertia in list(model.inertias)[1:])
    pieces = _check_geometry(report, config, path, urdf, model)
    robot = None
    if report.usable:
        progress("making the robot")
        begin = perf_counter()
        try:
            robot = Robot.from_config(config, path)
        except ConfigError as error:
            report.notes.append(Note(NoteKind.FILE, (), str(error), "mend what it names", "error"))
        report.load_seconds = perf_counter() - begin
    report.joints = _joints(urdf, model if robot is None else robot.model, config, model)
    _check_joints(report, config)
    if robot is not None:
        report.notes += robot.notes
        _check_built_robot(report, with_hulls(robot), pieces, progress)
    if report.without_mass:
        clause = f"{report.without_mass} moving links have no mass"
        report.notes.append(Note(NoteKind.LINK, (), clause, "none is needed: inertias are not used"))
    order = {"error": 0, "warning": 1, "note": 2}
    report.notes.sort(key=lambda note: order[note.severity])
    return report


def with_hulls(robot: Robot) -> Robot:
    """Replace each triangle mesh by its convex hull.

    Meshes cost up to ms a pair; few robots are run with them.
    """
    if not triangle_meshes(robot.bodies):
        return robot
    bodies = convert_bodies(robot.bodies, "convex")
    for pair in robot.bodies.collisionPairs:
        bodies.addCollisionPair(pair)
    return replace(robot, bodies=bodies)


# --- geometry -----------------------------------------------------------------------------------------------


def _check_geometry(report: Report, config: RobotConfig, path: Path, urdf: Path, model: Any) -> list[Piece]:
    packages = absolute_entries(config.package_dirs, path.parent)
    report.searched = mesh_folders(urdf, packages)
    absent = {tag: _absent(urdf, tag, report.searched) for tag in ("collision", "visual")}
    report.missing_meshes = absent["collision"]
    if report.missing_meshes and not config.allow_missing_meshes:
        clause = (
            f"{len(report.missing_meshes)} collision meshes are missing, such as {report.missing_meshes[0]!r}; "
            f"looked for in {abbreviate(report.searched, 8)}"
        )
        remedy = (
            "name the folder that holds the package with --package-dir or --package NAME=FOLDER (`package_dirs` of a "
            "robot.yaml), set ROS_PACKAGE_PATH, or go on without them: --allow-missing-meshes"
        )
        report.notes.append(Note(NoteKind.MESH, (), clause, remedy, "error"))
        return []
    if absent["visual"]:
        clause = f"{len(absent['visual'])} visual meshes are missing"
        report.notes.append(Note(NoteKind.MESH, (), clause, "none is needed where there are collision shapes"))
    try:
        geometry = read_pieces(
            urdf, model, packages, path, visuals=config.visuals, allow_missing=config.allow_missing_meshes
        ).geometryObjects
    except ConfigError as error:
        remedy = "export that mesh again, or take it out"
        report.notes.append(Note(NoteKind.MESH, (), str(error), remedy, "error"))
        return []
    report.shapes = dict(Counter(_shape_name(piece.geometry) for piece in geometry))
    meshes = [piece.geometry for piece in geometry if isinstance(piece.geometry, coal.BVHModelBase)]
    report.triangles = sum(int(mesh.num_tris) for mesh in meshes)
    return pieces_of(geometry, model)


def _absent(urdf: Path, tag: str, folders: list[str]) -> list[str]:
    if is_mjcf(urdf):  # its meshes are found by its own rules
        return []
    return [name for name in mesh_names(urdf, tag) if find_mesh(name, folders) is None]


def _shape_name(geometry: Any) -> str:
    if isinstance(geometry, coal.BVHModelBase):
        return "mesh"
    return "convex mesh" if isinstance(geometry, coal.ConvexBase) else type(geometry).__name__.lower()


# --- joints -------------------------------------------------------------------------------------------------

_KINDS = {
    "JointModelRUBX": "continuous", "JointModelRUBY": "continuous", "JointModelRUBZ": "continuous",
    "JointModelRevoluteUnboundedUnaligned": "continuous", "JointModelPX": "prismatic", "JointModelPY": "prismatic",
    "JointModelPZ": "prismatic", "JointModelPrismaticUnaligned": "prismatic", "JointModelFreeFlyer": "floating",
    "JointModelPlanar": "planar", "JointModelSpherical": "spherical", "JointModelSphericalZYX": "spherical",
    "JointModelTranslation": "prismatic",
}  # fmt: skip


def _joints(urdf: Path, model: Any, config: RobotConfig, whole: Any) -> list[Joint]:
    """List all joints: those that move, with the limits in force, locked and fixed ones."""
    followers = {name: source for name, (source, _, _) in mimics(urdf).items()}
    elements = [] if is_mjcf(urdf) else read_robot_xml(urdf, "URDF").findall("joint")
    kinds = {joint.get("name", ""): joint.get("type", "") for joint in elements}
    joints = []
    for name, joint in zip(list(whole.names)[1:], list(whole.joints)[1:], strict=True):
        kind, leader = _KINDS.get(joint.shortname(), "revolute"), followers.get(name)
        is_follower = joint.shortname() == MIMIC
        kind = kinds[name] if is_follower else kind
        if name in config.lock or (is_follower and leader in config.lock):
            joints.append(Joint(name, kind, leader, locked=True))
            continue
        if is_follower:
            joints.append(Joint(name, kind, leader, led=True))
            continue
        if not model.existJointName(name):  # its limits leave it no range
            joints.append(Joint(name, kind, leader, locked=True))
            continue
        live = model.joints[model.getJointId(name)]
        velocity = _limit(float(np.max(model.velocityLimit[live.idx_v : live.idx_v + live.nv])))
        lower = upper = None
        if live.nq == live.nv == 1:
            lower, upper = (_limit(float(bound[live.idx_q])) for bound in (
                model.lowerPositionLimit, model.upperPositionLimit))  # fmt: skip
        joints.append(Joint(name, kind, leader, lower, upper, velocity or None))
    return joints + [Joint(name, "fixed") for name, kind in kinds.items() if kind == "fixed"]


def _limit(value: float) -> float | None:
    return value if abs(value) < 1e9 else None


def _check_joints(report: Report, config: RobotConfig) -> None:
    moving = [joint for joint in report.joints if joint.kind in _MAX_SPEED and not (joint.locked or joint.led)]
    spans = {
        joint.name: (joint, joint.upper - joint.lower)
        for joint in moving
        if joint.kind in _MAX_RANGE and joint.lower is not None and joint.upper is not None
    }
    example = "`limits: {%s: {%s: %s}}` in a robot.yaml"
    for severity, kind, clause, names, remedy in (
        ("warning", NoteKind.LIMIT, "no position limits",
         [j.name for j in moving if j.kind in _MAX_RANGE and (j.name not in spans or j.lower == j.upper == 0.0)],
         example % ("position", "JOINT", "[-2.0, 2.0]")),
        ("warning", NoteKind.LIMIT, "no velocity limit", [j.name for j in moving if j.velocity is None],
         example % ("velocity", "JOINT", "1.5")),
        ("warning", NoteKind.LIMIT, "a velocity limit beyond what such joints do",
         [j.name for j in moving if j.velocity is not None and j.velocity > _MAX_SPEED[j.kind]],
         example % ("velocity", "JOINT", "1.5")),
        ("warning", NoteKind.LIMIT, "a range wider than such joints have",
         [name for name, (joint, span) in spans.items() if span > _MAX_RANGE[joint.kind]],
         example % ("position", "JOINT", "[-2.0, 2.0]")),
        ("warning", NoteKind.JOINT, "hardly any range",
         [name for name, (_, span) in spans.items() if 0.0 < span < _MIN_RANGE],
         "`lock: {JOINT: 0.0}` in a robot.yaml"),
        ("warning", NoteKind.JOINT, "mimic joints that move on their own here", [j.name for j in moving if j.mimics],
         "`qpavoid robot add` holds them and those that they follow; or list them under `lock`"),
        ("note", NoteKind.LIMIT, "no acceleration limit (a URDF has no field for it)",
         [j.name for j in moving if j.name not in config.limits.acceleration],
         example % ("acceleration", "JOINT", "10.0")),
    ):  # fmt: skip
        if names:
            report.notes.append(Note(kind, tuple(names), clause, remedy, severity))  # type: ignore[arg-type]


# --- the robot as it loads ----------------------------------------------------------------------------------


def _check_built_robot(report: Report, robot: Robot, pieces: Sequence[Piece], progress: Callable[[str], None]) -> None:
    report.nq, report.nv = robot.model.nq, robot.model.nv
    report.bodies, report.pairs = len(robot.bodies.geometryObjects), len(robot.bodies.collisionPairs)
    if not report.bodies:
        clause = "it has no collision bodies: nothing would be avoided"
        remedy = "`qpavoid robot add` fits them to what is meant to be seen; or list `bodies` in a robot.yaml"
        report.notes.append(Note(NoteKind.SHAPE, (), clause, remedy, "error"))
    _check_home(report, robot)
    progress("comparing with the geometry")
    report.notes += [note for entry in find_unchecked(robot, pieces) if (note := entry.note()) is not None]
    if not report.end_effectors:
        remedy = "list the frames of your tools under `end_effectors`"
        report.notes.append(Note(NoteKind.FRAME, (), "no frame looks like a tool", remedy))
    feet = [name for name in report.end_effectors if "foot" in name.lower() or "sole" in name.lower()]
    if feet and not any(joint.kind in ("floating", "planar") for joint in report.joints):
        clause = f"it has feet ({abbreviate(feet)}) and a fixed base"
        report.notes.append(Note(NoteKind.JOINT, (), clause, "`root_joint: free_flyer`, or --root"))
    progress("timing a control step")
    try:
        report.tick_us = step_time(robot, report.end_effectors)
    except QpavoidError as error:
        clause = f"a controller cannot be made: {error}"
        report.notes.append(Note(NoteKind.FILE, (), clause, "mend what it names", "error"))
        return
    if report.tick_us > _SLOW_STEP:
        clause = f"a control step takes {report.tick_us:.0f} µs with {report.pairs} pairs"
        remedy = "`qpavoid robot add` finds pairs that never collide, and capsules; `lock` joints that you do not use"
        report.notes.append(Note(NoteKind.PAIR, (), clause, remedy, "warning"))


def _check_home(report: Report, robot: Robot) -> None:
    pairs_at_home = touching(robot, robot.home, np.inf)
    report.clearance = pairs_at_home[0][2] if pairs_at_home else None
    report.home_collisions = [pair for pair in pairs_at_home if pair[2] <= 0.0]
    remedy = (
        "`qpavoid robot add` looks for a clear pose and leaner bodies; or set `home`, or `disabled_pairs` for shapes "
        "that overlap by design"
    )
    for a, b, d in report.home_collisions:
        clause = f"touch at the home pose ({1e3 * d:.1f} mm)"
        report.notes.append(Note(NoteKind.PAIR, (a, b), clause, remedy, "warning"))
    close = [(a, b, d) for a, b, d in pairs_at_home if 0.0 < d < robot.safety_distance(a, b, D1)]
    for a, b, d in close:
        clause = f"{1e3 * d:.1f} mm apart at the home pose, less than the default safety distance"
        remedy = "another `home`, a smaller `d1`, or `pair_margins`; `qpavoid robot add` writes them"
        report.notes.append(Note(NoteKind.PAIR, (a, b), clause, remedy))
    limbs = Limbs(robot, report.end_effectors)
    report.conditioning = dict(zip(limbs.names, limbs.at(robot.home), strict=True))
    if singular := [name for name, limb in report.conditioning.items() if limb.ratio < MIN_CONDITIONING]:
        clause = "the home pose is singular or nearly so: they cannot move well in every direction there"
        remedy = "start scenarios elsewhere (`q0`), or give a `home` with bent joints"
        report.notes.append(Note(NoteKind.HOME, tuple(singular), clause, remedy))


def step_time(robot: Robot, frames: Sequence[str]) -> float:
    """Time a control step near the home pose; the median [µs].

    Its tasks keep all end effectors where they are at home.
    """
    known = [frame for frame in frames if robot.model.existFrame(frame)]
    tasks = build_tasks([Task(frame=frame) for frame in known], robot, robot.home)
    controller = Controller(build_scene(robot), tasks)
    space, random = Space(robot), np.random.default_rng(0)
    states = [space.move(robot.home, random.normal(0.0, 0.05, robot.model.nv)) for _ in range(_MAX_STEPS)]
    times = []
    for q in states:
        begin = perf_counter()
        controller.step(q)
        times.append(perf_counter() - begin)
        if sum(times) > _MAX_SECONDS:
            break
    return 1e6 * float(np.median(times))
