"""Random scenarios, one per seed: a robot that moves from one configuration to another, among obstacles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from bench.safety.obstacles import draw_obstacle
from qpavoid import Robot, ScenarioConfig
from qpavoid.config import Fixed, ObstacleConfig
from qpavoid.geometry.bodies import make_shape
from qpavoid.model.scene import build_obstacles
from qpavoid.problem import Array
from qpavoid_bench.arena.families.free_space import PlacedShape, min_distance, placed_bodies
from qpavoid_bench.arena.families.tool_path import ToolPath

FOLDER = Path(__file__).parent


class Kind(NamedTuple):
    """A robot of the campaign."""

    robot: str
    """Name in a scenario."""
    tools: tuple[str, ...]
    """Frames, with a task each, except those of a locked arm."""
    roots: tuple[tuple[float, float, float, float], ...]
    """Balls x, y, z, radius [m] around what no joint moves."""


KINDS = (
    Kind("panda", ("panda_hand_tcp",), ((0.0, 0.0, 0.05, 0.15), (0.0, 0.0, 0.30, 0.15))),
    Kind("paper-dual-arm", ("left_tool", "right_tool"), ((0.0, 0.3, 1.2, 0.06), (0.0, -0.3, 1.2, 0.06))),
    Kind("robots/ur5.yaml", ("tool0",), ((0.0, 0.0, 0.09, 0.15),)),
)


@dataclass(frozen=True)
class Ranges:
    """Distributions of scenarios; every pair of numbers is a range of equally likely values."""

    dt: tuple[float, ...] = (0.001, 0.002, 0.005, 0.010, 0.020, 0.050)
    """Control period: one of these [s]."""
    dt_weights: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 4.0, 2.0)
    """Relative frequency of each: short ones cost many control steps [-]."""
    joint_range: float = 0.8
    """Fraction of the joints' ranges, about their middle, for start and goal; a range counts up to ±π [-]."""
    travel: tuple[float, float] = (0.3, 1.5)
    """Largest difference of start and goal in each joint [rad]."""
    pose_fraction: float = 0.3
    """Fraction of tasks with the goal's orientation; the others are positions [-]."""
    locked_fraction: float = 0.3
    """Fraction of two-armed scenarios with one arm locked [-]."""
    smooth_fraction: float = 0.5
    """Fraction of tasks from rest to rest; the others at constant speed [-]."""
    start_time: tuple[float, float] = (0.0, 0.5)
    """Start of the tasks [s]."""
    tool_speed: tuple[float, float] = (0.05, 0.3)
    """Mean speed of the targets [m/s]."""
    duration: tuple[float, float] = (3.0, 8.0)
    """Time of the slowest task and 2 s more, clipped to this range [s]."""
    d1: tuple[float, float] = (0.02, 0.04)
    """`avoidance.d1` [m]. At the start, and of what does not move at the goal too, everything is at least d1 apart."""
    influence: tuple[float, float] = (0.06, 0.15)
    """d2 - d1 [m]."""
    accelerated_fraction: float = 0.25
    """Fraction of scenarios with an acceleration limit [-]."""
    acceleration: tuple[float, float] = (5.0, 30.0)
    """That limit, the same for all joints [rad/s²]."""
    obstacles: tuple[int, int] = (1, 20)
    """Number, log-uniform; one without a free place in 50 tries is not used."""
    radius: tuple[float, float] = (0.02, 0.10)
    """Of balls, capsules and cylinders [m]."""
    length: tuple[float, float] = (0.05, 0.40)
    """Of capsules and cylinders, of the sides of boxes and of the two long ones of plates [m]."""
    thickness: tuple[float, float] = (0.004, 0.010)
    """Of plates [m]."""
    moving_fraction: float = 0.5
    """Fraction of obstacles that move [-]."""
    tumbling_fraction: float = 0.3
    """Fraction of obstacles on lines that turn as well [-]."""
    obstacle_speed: tuple[float, float] = (0.05, 0.40)
    """Of their centres [m/s]."""
    turn_rate: float = 1.0
    """Of those that tumble, at most [rad/s]."""
    root_fraction: float = 0.1
    """Fraction of scenarios in which obstacles may hit what no joint moves: the root of an arm, a locked arm. In the
    others they pass it at a distance of d1 or more [-]."""


RANGES = Ranges()


def draw(seed: int, ranges: Ranges = RANGES) -> ScenarioConfig:
    """Return the scenario of a seed, the same at every call."""
    random = np.random.default_rng(seed)
    kind = KINDS[random.integers(len(KINDS))]
    d1 = random.uniform(*ranges.d1)
    tools, locked = list(kind.tools), []
    if len(tools) > 1 and random.random() < ranges.locked_fraction:
        locked = [tools.pop(random.integers(2)).replace("_tool", "_joint")]
    robot = _robot(kind.robot)
    locked_joints = np.array([joint.startswith(tuple(locked)) for joint in robot.joint_names], dtype=bool)
    start = _configuration(robot, random, d1, ranges)
    goal = _goal(robot, random, d1, start, locked_joints, ranges)
    tasks, ways = [], []
    for tool in tools:
        task, way = _task(robot, random, tool, start, goal, ranges)
        tasks.append(task)
        ways.append(way)
    duration = float(np.clip(max(way.end for way in ways) + 2.0, *ranges.duration))
    midway = placed_bodies(robot, start + random.uniform() * (goal - start))
    targets = np.array([place.getTranslation() for joint, _, place in midway if joint > 0])
    roots = [(coal.Sphere(radius), coal.Transform3s(np.eye(3), np.array(at))) for *at, radius in kind.roots]
    roots += [
        (shape, place) for joint, shape, place in placed_bodies(robot, start) if joint > 0 and locked_joints[joint - 1]
    ]
    if random.random() < ranges.root_fraction:
        roots = []
    obstacles: list[dict[str, Any]] = []
    fewest, most = ranges.obstacles
    for i in range(int(np.exp(random.uniform(np.log(fewest), np.log(most + 1))))):
        moving = random.random() < ranges.moving_fraction
        for _ in range(50):
            way = ways[random.integers(len(ways))]
            obstacle = draw_obstacle(random, f"obstacle{i}", moving, way, targets, ranges)
            if _is_clear(robot, obstacle, start, goal, roots, duration, d1):
                obstacles.append(obstacle)
                break
    config: dict[str, Any] = {
        "title": f"seed {seed}",
        "robot": kind.robot,
        "q0": start.tolist(),
        "lock": [f"{prefix}*" for prefix in locked],
        "tasks": tasks,
        "obstacles": obstacles,
        "avoidance": {"d1": d1, "d2": d1 + random.uniform(*ranges.influence)},
        "dt": float(random.choice(ranges.dt, p=np.divide(ranges.dt_weights, sum(ranges.dt_weights)))),
        "duration": round(duration, 1),
        "goal_tolerance": 0.01,
    }
    if random.random() < ranges.accelerated_fraction:
        config["limits"] = {"acceleration": random.uniform(*ranges.acceleration)}
    return ScenarioConfig.model_validate(config).with_source(FOLDER / f"seed-{seed}.yaml")


@cache
def _robot(name: str) -> Robot:
    return Robot.load(name, FOLDER)


def _configuration(robot: Robot, random: np.random.Generator, d1: float, ranges: Ranges) -> Array:
    """Return a configuration (nq,) in which the robot's own bodies are at least d1 apart."""
    bounds = robot.bounds()
    low, high = np.maximum(bounds.lower, -np.pi), np.minimum(bounds.upper, np.pi)
    middle, half = 0.5 * (low + high), 0.5 * ranges.joint_range * (high - low)
    while True:
        q = random.uniform(middle - half, middle + half)
        if _clearance(robot, q) > d1:
            return np.asarray(q)


def _goal(
    robot: Robot, random: np.random.Generator, d1: float, start: Array, locked_joints: Any, ranges: Ranges
) -> Array:
    """Return a configuration (nq,) at some distance from the start, with locked joints unchanged."""
    bounds = robot.bounds()
    low, high = np.maximum(bounds.lower, -np.pi), np.minimum(bounds.upper, np.pi)
    border = 0.5 * (1.0 - ranges.joint_range) * (high - low)
    while True:
        travel = random.uniform(*ranges.travel)
        q = np.clip(start + random.uniform(-travel, travel, len(start)), low + border, high - border)
        q[locked_joints] = start[locked_joints]
        if _clearance(robot, q) > d1:
            return np.asarray(q)


def _task(
    robot: Robot, random: np.random.Generator, tool: str, start: Array, goal: Array, ranges: Ranges
) -> tuple[dict[str, Any], ToolPath]:
    """Return a task along the straight line of a tool from its pose at the start to that at the goal."""
    model = robot.model
    data, frame = model.createData(), model.getFrameId(tool)
    here, there = ((pose.rotation.copy(), pose.translation.copy()) for pose in _frames(model, data, frame, start, goal))
    length = float(np.linalg.norm(there[1] - here[1]))
    begin = random.uniform(*ranges.start_time)
    end = begin + length / random.uniform(*ranges.tool_speed) + 1e-3
    pose = random.random() < ranges.pose_fraction
    motion: dict[str, Any] = {
        "type": "waypoints",
        "times": [begin, end],
        "positions": [here[1].tolist(), there[1].tolist()],
        "profile": "smooth" if random.random() < ranges.smooth_fraction else "constant",
    }
    if pose:
        motion["rpys"] = [pin.rpy.matrixToRpy(rotation).tolist() for rotation, _ in (here, there)]
    task = {"frame": tool, "type": "pose" if pose else "position", "motion": motion}
    return {**task, "max_speed": 0.5, "max_turn_rate": 1.5}, ToolPath(here[1], there[1], begin, end)


def _frames(model: Any, data: Any, frame: int, *configurations: Array) -> Any:
    for q in configurations:
        pin.framesForwardKinematics(model, data, q)
        yield data.oMf[frame]


def _clearance(robot: Robot, q: Array) -> float:
    """Return the least distance among the robot's own bodies [m]."""
    data = robot.bodies.createData()
    pin.updateGeometryPlacements(robot.model, robot.model.createData(), robot.bodies, data, q)
    pin.computeDistances(robot.bodies, data)
    return min(result.min_distance for result in data.distanceResults)


def _is_clear(
    robot: Robot, obstacle: dict[str, Any], start: Array, goal: Array, roots: list[Any], duration: float, d1: float
) -> bool:
    """Return whether an obstacle is d1 off the robot at the start, off its roots always, and off the goal if static."""
    config = ObstacleConfig.model_validate(obstacle)
    motion, shape = build_obstacles([config], FOLDER)[0].motion, make_shape(config.shape)

    def is_apart(t: float, bodies: list[PlacedShape]) -> bool:
        pose = motion.sample(t)
        return min_distance(shape, coal.Transform3s(pose.rotation, pose.position), bodies) > d1

    still = isinstance(config.motion, Fixed)
    robots = [
        (body, place) for q in ((start, goal) if still else (start,)) for _, body, place in placed_bodies(robot, q)
    ]
    return is_apart(0.0, robots) and all(
        is_apart(t, roots) for t in ((0.0,) if still else np.arange(0.0, duration, 0.1))
    )
