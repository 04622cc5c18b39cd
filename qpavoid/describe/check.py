"""Looks a robot over before it is used: what it is made of, what is wrong with it, and what to do about it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.config import RobotConfig, Task
from qpavoid.controller import Controller
from qpavoid.describe.findings import Joint, Problem, Report
from qpavoid.describe.poses import mimics
from qpavoid.describe.sampling import Space, touching
from qpavoid.errors import ConfigError, QpavoidError
from qpavoid.files.loading import read_config
from qpavoid.files.packages import find_mesh, mesh_folders
from qpavoid.files.safe_xml import read_robot_xml
from qpavoid.files.shipped import find_robot
from qpavoid.geometry.ends import end_effectors
from qpavoid.geometry.joints import frame_index
from qpavoid.geometry.urdf import find_resource, is_mjcf, mesh_names, read_collision, read_model
from qpavoid.kinematics import MIMIC
from qpavoid.robot import Robot
from qpavoid.scene import build_scene
from qpavoid.tasks import build_tasks

_TICKS, _PATIENCE = 300, 5.0
"""Timed for the median, as far as they take no longer than so many seconds."""
_SLOW = 1000.0
"""Median tick from which it is worth a word [µs]."""
_FAST = {"revolute": 50.0, "continuous": 50.0, "prismatic": 10.0}
"""Speed limits [rad/s, m/s] above which one is hardly meant."""
_WIDE = {"revolute": 8.0 * math.pi, "prismatic": 20.0}
"""Ranges [rad, m] above which one is hardly meant."""
_NARROW = 1e-3
"""Range [rad, m] below which a joint is better locked."""


def check_robot(name_or_path: str, root: str = "fixed", package_dirs: Sequence[Path] = ()) -> Report:
    """Looks over a URDF, an MJCF, a robot.yaml or a robot that ships.

    Args:
        name_or_path: which one.
        root: how its root link is attached to the world; a robot.yaml says so itself.
        package_dirs: folders to look for meshes in; a robot.yaml names its own.

    Raises:
        ConfigError, UnknownName: it cannot be read at all.
    """
    path = find_robot(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        config = read_config(path, RobotConfig)
    else:
        folders = [str(folder.resolve()) for folder in package_dirs]
        config = RobotConfig(name=path.stem, urdf=path.name, root_joint=root, package_dirs=folders)  # type: ignore[arg-type]
    urdf = find_resource(config.urdf, path.parent, f"{path}: urdf")
    model = read_model(urdf, config.root_joint)
    report = Report(config.name, str(path), model.nq, model.nv)
    report.frames = [f.name for f in model.frames if f.type in (pin.BODY, pin.OP_FRAME)]
    report.end_effectors = list(config.end_effectors) or end_effectors(model)
    report.without_mass = sum(inertia.mass <= 0.0 for inertia in list(model.inertias)[1:])
    _look_at_geometry(report, config, path, urdf, model)
    robot = None
    if not report.missing_meshes:
        begin = perf_counter()
        try:
            robot = Robot.from_config(config, path)
        except ConfigError as error:
            report.problems.append(Problem("error", str(error), "mend what it names"))
        report.load_seconds = perf_counter() - begin
    report.joints = _joints(urdf, model if robot is None else robot.model, config, model)
    _judge_joints(report, config)
    if robot is not None:
        _look_at_robot(report, robot)
    if report.without_mass:
        report.problems.append(
            Problem("note", f"{report.without_mass} moving links have no mass", "none is needed: inertias are not used")
        )
    order = {"error": 0, "warning": 1, "note": 2}
    report.problems.sort(key=lambda problem: order[problem.severity])
    return report


# --- geometry -----------------------------------------------------------------------------------------------


def _look_at_geometry(report: Report, config: RobotConfig, path: Path, urdf: Path, model: Any) -> None:
    package_dirs = [str(path.parent / folder) for folder in config.package_dirs]
    report.searched = mesh_folders(urdf, package_dirs)
    absent = {tag: _absent(urdf, tag, report.searched) for tag in ("collision", "visual")}
    report.missing_meshes = absent["collision"]
    if report.missing_meshes:
        report.problems.append(
            Problem(
                "error",
                f"{len(report.missing_meshes)} collision meshes are missing, such as {report.missing_meshes[0]!r}; "
                f"looked for in {_some(report.searched, 8)}",
                "name the folder that holds the package with --package-dir (`package_dirs` of a robot.yaml), or set "
                "ROS_PACKAGE_PATH",
            )
        )
        return
    if absent["visual"]:
        report.problems.append(
            Problem("note", f"{len(absent['visual'])} visual meshes are missing", "none is needed: they are not used")
        )
    try:
        pieces = read_collision(urdf, model, package_dirs, path).geometryObjects
    except ConfigError as error:
        report.problems.append(Problem("error", str(error), "export that mesh again, or take it out"))
        return
    report.shapes = dict(Counter(_shape_name(piece.geometry) for piece in pieces))
    meshes = [piece.geometry for piece in pieces if isinstance(piece.geometry, coal.BVHModelBase)]
    report.triangles = sum(int(mesh.num_tris) for mesh in meshes)


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
    """All joints: those that move with the limits that hold, those that are locked, and those that never moved."""
    followers = {name: source for name, (source, _, _) in mimics(urdf).items()}
    written = [] if is_mjcf(urdf) else read_robot_xml(urdf, "URDF").findall("joint")
    kinds = {joint.get("name", ""): joint.get("type", "") for joint in written}
    joints = []
    for name, joint in zip(list(whole.names)[1:], list(whole.joints)[1:], strict=True):
        kind, leader = _KINDS.get(joint.shortname(), "revolute"), followers.get(name)
        led = joint.shortname() == MIMIC
        kind = kinds[name] if led else kind
        if name in config.lock or (led and leader in config.lock):
            joints.append(Joint(name, kind, leader, locked=True))
            continue
        if led:
            joints.append(Joint(name, kind, leader, led=True))
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


def _judge_joints(report: Report, config: RobotConfig) -> None:
    moving = [joint for joint in report.joints if joint.kind in _FAST and not (joint.locked or joint.led)]
    spans = {
        joint.name: (joint, joint.upper - joint.lower)
        for joint in moving
        if joint.kind in _WIDE and joint.lower is not None and joint.upper is not None
    }
    example = "`limits: {%s: {%s: %s}}` in a robot.yaml"
    for severity, what, names, remedy in (
        ("warning", "no position limits",
         [j.name for j in moving if j.kind in _WIDE and (j.name not in spans or j.lower == j.upper == 0.0)],
         example % ("position", "JOINT", "[-2.0, 2.0]")),
        ("warning", "no velocity limit", [j.name for j in moving if j.velocity is None],
         example % ("velocity", "JOINT", "1.5")),
        ("warning", "a velocity limit beyond what such joints do",
         [j.name for j in moving if j.velocity is not None and j.velocity > _FAST[j.kind]],
         example % ("velocity", "JOINT", "1.5")),
        ("warning", "a range wider than such joints have",
         [name for name, (joint, span) in spans.items() if span > _WIDE[joint.kind]],
         example % ("position", "JOINT", "[-2.0, 2.0]")),
        ("warning", "hardly any range", [name for name, (_, span) in spans.items() if 0.0 < span < _NARROW],
         "`lock: {JOINT: 0.0}` in a robot.yaml"),
        ("warning", "mimic joints that move on their own here", [j.name for j in moving if j.mimics],
         "`qpavoid robot add` holds them and those that they follow; or list them under `lock`"),
        ("note", "no acceleration limit (a URDF has no field for it)",
         [j.name for j in moving if j.name not in config.limits.acceleration],
         example % ("acceleration", "JOINT", "10.0")),
    ):  # fmt: skip
        if names:
            report.problems.append(Problem(severity, f"{what}: {_some(names)}", remedy))  # type: ignore[arg-type]


def _some(names: Sequence[str], most: int = 5) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


# --- the robot as it loads ----------------------------------------------------------------------------------


def _look_at_robot(report: Report, robot: Robot) -> None:
    report.nq, report.nv = robot.model.nq, robot.model.nv
    report.bodies, report.pairs = len(robot.bodies.geometryObjects), len(robot.bodies.collisionPairs)
    if not report.bodies:
        report.problems.append(
            Problem(
                "error",
                "it has no collision bodies: nothing would be avoided",
                "`qpavoid robot add` fits them to what is meant to be seen; or list `bodies` in a robot.yaml",
            )
        )
    report.home_collisions = touching(robot, robot.home)
    if report.home_collisions:
        pairs = [f"{a} - {b} ({1000 * d:.1f} mm)" for a, b, d in report.home_collisions]
        report.problems.append(
            Problem(
                "warning",
                f"{len(pairs)} pairs touch at the home pose: {_some(pairs)}",
                "`qpavoid robot add` looks for a clear pose and leaner bodies; or set `home`, or `disabled_pairs` for "
                "shapes that overlap by design",
            )
        )
    if robot.always_touching:
        pairs = [f"{a} - {b}" for a, b in robot.always_touching]
        report.problems.append(
            Problem("note", f"{len(pairs)} pairs touch in every configuration and are off: {_some(pairs)}", "none")
        )
    if not report.end_effectors:
        report.problems.append(
            Problem("note", "no frame looks like a tool", "list the frames of your tools under `end_effectors`")
        )
    if stretched := [name for name in report.end_effectors if _is_stretched(robot, name)]:
        report.problems.append(
            Problem(
                "note",
                f"the home pose is singular: {_some(stretched)} cannot move in every direction there",
                "start scenarios elsewhere (`q0`), or give a `home` with bent joints",
            )
        )
    feet = [name for name in report.end_effectors if "foot" in name.lower() or "sole" in name.lower()]
    if feet and not any(joint.kind in ("floating", "planar") for joint in report.joints):
        report.problems.append(
            Problem("note", f"it has feet ({_some(feet)}) and a fixed base", "`root_joint: free_flyer`, or --root")
        )
    try:
        report.tick_us = tick_time(robot, report.end_effectors)
    except QpavoidError as error:
        report.problems.append(Problem("error", f"a controller cannot be made: {error}", "mend what it names"))
        return
    if report.tick_us > _SLOW:
        report.problems.append(
            Problem(
                "warning",
                f"a control step takes {report.tick_us:.0f} µs with {report.pairs} pairs",
                "`qpavoid robot add` finds pairs that never collide, and capsules; `lock` joints that you do not use",
            )
        )


def _is_stretched(robot: Robot, frame: str) -> bool:
    """Whether a frame on a limb of six joints or more has lost a direction of motion at home."""
    if not robot.model.existFrame(frame):
        return False
    data, frame_id = robot.model.createData(), frame_index(robot.model, frame)
    J = pin.computeFrameJacobian(robot.model, data, robot.home, frame_id, pin.LOCAL_WORLD_ALIGNED)
    J = J[:, np.any(J != 0.0, axis=0)]
    return J.shape[1] >= 6 and bool(np.linalg.svd(J, compute_uv=False)[5] < _SINGULAR)


_SINGULAR = 1e-3
"""Smallest singular value of a Jacobian [m or 1] below which a pose counts as singular."""


def tick_time(robot: Robot, frames: Sequence[str]) -> float:
    """Median time of a control step that holds frames where they are at home, from configurations near it [µs]."""
    known = [frame for frame in frames if robot.model.existFrame(frame)]
    tasks = build_tasks([Task(frame=frame) for frame in known], robot, robot.home)
    controller = Controller(build_scene(robot), tasks)
    space, random = Space(robot), np.random.default_rng(0)
    states = [space.move(robot.home, random.normal(0.0, 0.05, robot.model.nv)) for _ in range(_TICKS)]
    times = []
    for q in states:
        begin = perf_counter()
        controller.step(q)
        times.append(perf_counter() - begin)
        if sum(times) > _PATIENCE:
            break
    return 1e6 * float(np.median(times))
