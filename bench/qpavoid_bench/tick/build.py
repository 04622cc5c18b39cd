"""Builds the workloads: a smooth recorded swing of a robot among seeded obstacles, with a target one period ahead."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import Obstacle, Robot, Scene, build_scene
from qpavoid.config import Box, Sphere
from qpavoid_bench.libraries import setup
from qpavoid_bench.tick.robots import ROBOTS, RobotSpec, load
from qpavoid_bench.tick.workloads import Array, Body, Workload

DT = 0.01
TICKS = 1000
D_MIN = 0.03
CLEARANCE = 0.035
"""Nothing comes closer than this on the recorded swing, so that no library has to get out of a violation."""
NEAR = 0.05
"""Obstacles that are put near a tool come at least this close to it."""
INFLUENCES = (0.10, 0.30)
SIZES = {"panda": (0, 5, 20, 50, 500), "baxter": (0, 50), "g1": (8,)}
"""Numbers of obstacles."""
VARIANTS = ("held", "sample1", "sample50", "pose1", "pose50")
_NAME = re.compile(r"(panda|baxter|g1)-(\d+)@(0\.\d+)(?:\+(held|(?:sample|pose)[1-9]\d*))?")


def recorded_names() -> list[str]:
    """Return the workloads for all libraries: ROBOT-OBSTACLES@INFLUENCE."""
    return [f"{robot}-{n}@{d:.2f}" for robot, sizes in SIZES.items() for n in sizes for d in INFLUENCES]


def variant_names() -> list[str]:
    """Return those for qpavoid alone: ROBOT-OBSTACLES@INFLUENCE+VARIANT."""
    return [f"panda-50@{d:.2f}+{variant}" for d in INFLUENCES for variant in VARIANTS]


def is_recorded(name: str) -> bool:
    """Return whether a name is one that `build` understands, listed or not."""
    return _NAME.fullmatch(name) is not None


def build(name: str) -> Workload:
    """Return the workload of that name; the same at every call."""
    match = _NAME.fullmatch(name)
    assert match is not None, name
    robot, obstacles, influence, variant = match.groups()
    workload = _build(robot, int(obstacles))
    return replace(workload, name=name, influence=float(influence), variant=variant or "")


def make_scene(workload: Workload) -> Scene:
    """The live scene of a workload."""
    robot = load(ROBOTS[workload.robot], workload.disabled_pairs)
    return build_scene(robot, [_obstacle(body) for body in workload.obstacles])


def reference(scene: Scene, workload: Workload, q: Array) -> tuple[Array, Array]:
    """Frames (k, f, 4, 4) and distances (k, m) at configurations (k, nq), by Pinocchio and coal."""
    model, geometry = scene.robot.model, scene.geometry
    data, bodies = model.createData(), geometry.createData()
    ids = [model.getFrameId(name) for name in workload.frames]
    frames, distances = [], []
    for configuration in q:
        pin.updateGeometryPlacements(model, data, geometry, bodies, configuration)
        pin.updateFramePlacements(model, data)
        frames.append([data.oMf[i].homogeneous for i in ids])
        pin.computeDistances(geometry, bodies)
        distances.append([result.min_distance for result in bodies.distanceResults])
    return np.array(frames), np.array(distances).reshape(len(frames), -1)


@cache
def _build(name: str, count: int) -> Workload:
    spec = ROBOTS[name]
    robot = load(spec)
    q = _swing(robot, spec)
    disabled = close_pairs(robot, q)
    robot = load(spec, disabled)
    obstacles = _scatter(robot, spec, q, count)
    scene = build_scene(robot, [_obstacle(body) for body in obstacles])
    pairs, first = np.array(scene.pairs), len(scene.body_names)
    is_box = np.array([False] * first + [body.shape == "box" for body in obstacles])
    workload = Workload(
        name="",
        robot=name,
        influence=0.0,
        d_min=D_MIN,
        dt=DT,
        nv=robot.model.nv,
        obstacles=tuple(obstacles),
        pairs=pairs,
        boxes=is_box[pairs].any(axis=1),
        disabled_pairs=disabled,
        frames=spec.frames,
        q=q,
        targets=np.empty(0),
    )
    poses, distances = reference(scene, workload, q)
    if distances.size and distances.min() < D_MIN:
        raise AssertionError(f"{name}-{count}: the swing comes to {distances.min():.3f} m")
    return replace(workload, targets=np.roll(poses, -1, axis=0))


def _swing(robot: Robot, spec: RobotSpec) -> Array:
    """(T, nq): every joint swings about the home pose at 0.2 to 0.5 Hz, each with a phase of its own."""
    model, random = robot.model, np.random.default_rng(1)
    cycles, phase = random.integers(2, 6, model.nv), random.uniform(0.0, 2.0 * np.pi, model.nv)
    amplitude = np.full(model.nv, spec.swing)
    home = np.array(robot.home)
    if spec.root_joint == "free_flyer":
        home[2] = spec.base_height
        amplitude[:6] = 0.05
    scalar = [joint for joint in list(model.joints)[1:] if joint.nq == joint.nv == 1]
    for joint in scalar:
        low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
        amplitude[joint.idx_v] = min(amplitude[joint.idx_v], 0.3 * (high - low))
        border = amplitude[joint.idx_v] + 0.02
        home[joint.idx_q] = np.clip(home[joint.idx_q], low + border, high - border)
    angle = 2.0 * np.pi * np.arange(TICKS)[:, None] / TICKS * cycles + phase
    return np.array([pin.integrate(model, home, step) for step in amplitude * np.sin(angle)])


def close_pairs(robot: Robot, q: Array) -> tuple[tuple[str, str], ...]:
    """Return pairs of the robot's own bodies that come nearer than the clearance in every fifth of q (T, nq)."""
    geometry = robot.bodies
    data, bodies = robot.model.createData(), geometry.createData()
    closest = np.full(len(geometry.collisionPairs), np.inf)
    for configuration in q[::5]:
        pin.updateGeometryPlacements(robot.model, data, geometry, bodies, configuration)
        pin.computeDistances(geometry, bodies)
        closest = np.minimum(closest, [result.min_distance for result in bodies.distanceResults])
    names = [body.name for body in geometry.geometryObjects]
    pairs = list(geometry.collisionPairs)
    return tuple((names[pairs[i].first], names[pairs[i].second]) for i in np.flatnonzero(closest < CLEARANCE))


def _scatter(robot: Robot, spec: RobotSpec, q: Array, count: int) -> list[Body]:
    """Spheres and boxes by turns, clear of the whole swing; a tenth (at least 3) beside a tool, the rest all around."""
    random = np.random.default_rng(2)
    points, radius, link = _samples(robot, q[::10])
    tools = np.isin(link, spec.tools)
    center, spread = points.mean(axis=0), 1.3
    bodies: list[Body] = []
    while len(bodies) < count:
        near = len(bodies) < max(3, count // 10)
        pose, half, inflate = np.eye(4), np.zeros(3), 0.0
        if len(bodies) % 2 == 0:
            shape, size = "sphere", (inflate := random.uniform(0.03, 0.08),)
        else:
            shape, size = "box", tuple(random.uniform(0.05, 0.15, 3).tolist())
            half, pose[:3, :3] = np.array(size) / 2.0, _random_rotation(random)
        if near:
            direction = random.normal(size=3)
            distance = random.uniform(0.05, 0.4)
            place = points[tools][random.integers(tools.sum())] + distance * direction / np.linalg.norm(direction)
        else:
            place = center + spread * random.uniform(-1.0, 1.0, 3)
        pose[:3, 3] = place
        local = np.abs((points - place) @ pose[:3, :3])
        gap = np.linalg.norm(np.maximum(local - half, 0.0), axis=1) - inflate - radius
        if gap.min() >= CLEARANCE and (not near or gap[tools].min() <= NEAR):
            bodies.append(Body(f"obstacle{len(bodies)}", shape, size, pose))
    return bodies


def _samples(robot: Robot, q: Array) -> tuple[Array, Array, Any]:
    """Points on the axes of all capsules along the swing (n, 3), their radii (n,) and their bodies' names (n,)."""
    geometry = robot.bodies
    data, bodies = robot.model.createData(), geometry.createData()
    axis = np.linspace(-1.0, 1.0, 9)[:, None] * np.array([0.0, 0.0, 1.0])
    points, radius, names = [], [], []
    for configuration in q:
        pin.updateGeometryPlacements(robot.model, data, geometry, bodies, configuration)
        for body, placement in zip(geometry.geometryObjects, bodies.oMg, strict=True):
            half = getattr(body.geometry, "halfLength", 0.0)
            points.append(half * axis @ placement.rotation.T + placement.translation)
            radius += [body.geometry.radius] * 9
            names += [body.name] * 9
    return np.concatenate(points), np.array(radius), np.array(names)


def _random_rotation(random: np.random.Generator) -> Array:
    q = random.normal(size=4)
    return np.asarray(pin.Quaternion(q / np.linalg.norm(q)).toRotationMatrix())


def _obstacle(body: Body) -> Obstacle:
    shape = Sphere(radius=body.size[0]) if body.shape == "sphere" else Box(size=body.size)  # type: ignore[arg-type]
    return Obstacle.at(body.name, shape, body.placement[:3, 3], body.placement[:3, :3])


def describe(scene: Scene, workload: Workload, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a workload's scene as other libraries take it."""
    robot = scene.robot
    return setup.describe(
        scene,
        workload.q[0],
        [(robot.model.getFrameId(name), 1.0, 1.0) for name in workload.frames],
        workload.pairs,
        workload.dt,
        (workload.d_min, workload.influence),
        robot.bounds(),
        options=options,
    )
