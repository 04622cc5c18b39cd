"""Generator of random scenes in which obstacles come at the robot from everywhere; not all contacts can be avoided."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.config import ObstacleConfig
from qpavoid.geometry.bodies import make_shape
from qpavoid.model.robot import Robot
from qpavoid.model.trajectory import build_motion
from qpavoid.problem import Array
from qpavoid_bench.arena.families.arms import Arm, arms, position_task, scenario_fields, straight_path
from qpavoid_bench.arena.families.free_space import PlacedShape, min_distance, placed_bodies
from qpavoid_bench.arena.families.inverse_kinematics import JointRanges
from qpavoid_bench.arena.families.moving import MOTIONS, draw_shape
from qpavoid_bench.arena.families.parameters import Draw, Redraw
from qpavoid_bench.arena.families.tool_path import OVERSHOOT, ToolPath, line_motion, path_motion

MARGIN = 0.01
"""Distance beyond d1 that obstacles have from the robot at the start, and from what it cannot move at all times [m]."""
_TRIES = 50
"""Places that are tried for each obstacle; without a free one, it is left out."""
_PERIOD = 0.05
"""Time between two samples of a motion past what the robot cannot move [s]."""
_REST_TIME = 2.0
"""Time from the end of the slowest task to that of the run [s]."""


def adversarial(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Move all tools from one configuration to another, among `count` obstacles of which some aim at the robot.

    Nothing is nearer than d1 at the start, obstacles at rest neither at the goal. What no joint can move, such as a
    base, is passed at d1.
    """
    start, goal = _configurations(draw, robot)
    paths = []
    for arm in arms(robot):
        here, there = (_tool(robot, arm, q) for q in (start, goal))
        paths.append((arm, straight_path(here, there, draw("speed"))))
    tasks = [position_task(arm.tool, path_motion(path)) for arm, path in paths]
    fields = scenario_fields(robot, start, tasks, [], _REST_TIME)
    midway = [placement.getTranslation() for _, _, placement in placed_bodies(robot, 0.5 * (start + goal))]
    at_start, at_goal = placed_bodies(robot, start), placed_bodies(robot, goal)
    parents = robot.model.parents
    immovable = [(shape, place) for joint, shape, place in at_start if joint == 0 or parents[joint] == 0]
    everything = [(shape, place) for _, shape, place in at_start]
    while_at_rest = [*everything, *((shape, place) for _, shape, place in at_goal)]
    for i in range(draw("count")):
        for _ in range(_TRIES):
            arm, path = paths[int(draw("pick") * len(paths))]
            body = midway[int(draw("pick") * len(midway))]
            motion = _motion(draw, arm, path, body)
            obstacle = {"name": f"obstacle{i}", "shape": draw_shape(draw), "motion": motion}
            near = while_at_rest if motion["type"] == "fixed" else everything
            if _is_clear(obstacle, near, immovable, draw("d1") + MARGIN, fields["duration"]):
                fields["obstacles"].append(obstacle)
                break
    return fields


def _configurations(draw: Draw, robot: Robot) -> tuple[Array, Array]:
    """Draw start and goal (nv,): `posture` is a fraction of each joint's range, `travel` the change [rad]."""
    ranges = JointRanges.of(robot)
    low, high = np.maximum(ranges.lower, -np.pi), np.minimum(ranges.upper, np.pi)
    start = low + (high - low) * np.array([draw("posture") for _ in low])
    border = 0.1 * (high - low)
    goal = np.clip(start + [draw("travel") for _ in low], low + border, high - border)
    for q in (start, goal):
        data = robot.bodies.createData()
        pin.updateGeometryPlacements(robot.model, robot.model.createData(), robot.bodies, data, q)
        pin.computeDistances(robot.bodies, data)
        if min((result.min_distance for result in data.distanceResults), default=np.inf) < draw("d1") + MARGIN:
            raise Redraw("the robot is too near to itself")
    return start, goal


def _tool(robot: Robot, arm: Arm, q: Array) -> Array:
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return np.array(data.oMf[robot.frame_id(arm.tool, "tool")].translation)


def _motion(draw: Draw, arm: Arm, path: ToolPath, body: Array) -> dict[str, Any]:
    """Draw a motion: across or along a tool's path, through a body, in a circle, or none."""
    aim = path.point(draw("share")) if draw("pick") < 2.0 / 3.0 else body
    center = (aim + draw("beside") * np.array(draw("direction"))).tolist()
    direction, speed, radius = np.array(draw("direction")), draw("obstacle_speed"), draw("circle")
    circle = {"type": "circle", "center": center, "radius": radius, "period": 2.0 * np.pi * radius / speed}
    begin = body - speed * path.time(draw("share")) * direction
    motions = {  # all of them are drawn: a change of the choice leaves the rest of a scene as it is
        "fixed": {"type": "fixed", "position": center},
        "circling": {**circle, "normal": draw("direction"), "start_direction": draw("direction")},
        "at_body": line_motion(begin, body + OVERSHOOT * direction, speed),
        **{name: motion(draw, arm, path) for name, motion in MOTIONS.items()},
    }
    return motions[draw("motion")]


def _is_clear(
    obstacle: dict[str, Any], bodies: list[PlacedShape], immovable: list[PlacedShape], distance: float, end: float
) -> bool:
    """Return whether an obstacle is clear of bodies at the start, and of immovable ones until the end [s]."""
    config = ObstacleConfig.model_validate(obstacle)
    motion, shape = build_motion(config.motion, None, Path()), make_shape(config.shape)  # type: ignore[arg-type]

    def is_apart(t: float, others: list[PlacedShape]) -> bool:
        pose = motion.sample(t)
        return min_distance(shape, coal.Transform3s(pose.rotation, pose.position), others) > distance

    times = () if obstacle["motion"]["type"] == "fixed" else np.arange(_PERIOD, end, _PERIOD).tolist()
    return is_apart(0.0, bodies) and all(is_apart(t, immovable) for t in times)
