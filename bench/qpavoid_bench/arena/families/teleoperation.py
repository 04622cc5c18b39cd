"""Generators of what an operator's hand does to a controller: jumps, targets out of reach, wiggles, bad starts.

Nothing moves but the target, so that a robot that starts clear can stay clear by standing still.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.model.robot import Robot
from qpavoid.problem import Array
from qpavoid_bench.arena.families.arms import Arm, arms, joint_values, posture
from qpavoid_bench.arena.families.free_space import min_distance, placed_bodies
from qpavoid_bench.arena.families.parameters import Draw, Redraw
from qpavoid_bench.arena.families.reach import chain, is_reachable
from qpavoid_bench.arena.families.tool_path import waypoint_motion

GAIN, MAX_SPEED = 10.0, 1.0
"""Of the tasks: stiff, as a hand that is followed has to be [1/s], up to a speed [m/s]."""
_INSTANT = 1e-4
"""Time that a jump takes, between two control steps [s]."""
_REST = 2.0
"""Time at the last target [s]."""
_PRECISION = 1e-3
"""To which reach is known [m]."""


def jumps(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Let the target jump between `count` places around the tool's home, and stay `hold` seconds at each."""
    arm = arms(robot)[0]
    places = [arm.home, *(_near_home(draw, robot, arm) for _ in range(draw("count")))]
    times, points, t = [0.0], [places[0]], 0.505
    for previous, following in pairwise(places):
        times += [t, t + _INSTANT]
        points += [previous, following]
        t += draw("hold")
    return _scenario(robot, arm, robot.home, points, times)


def leaving_reach(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Take the target out of reach by `beyond`, hold it there, and bring it back."""
    arm = arms(robot)[0]
    direction = _outwards(draw)
    root, _ = chain(robot, robot.frame_id(arm.tool, "tool"))
    outside = root + (reach_along(robot, arm, direction) + draw("beyond")) * direction
    t = float(np.linalg.norm(outside - arm.home)) / draw("speed")
    points = [arm.home, outside, outside, arm.home]
    return _scenario(robot, arm, robot.home, points, [0.5, 0.5 + t, 1.5 + t, 1.5 + 2.0 * t])


def singular(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Lead the target across the first axis, `beside` it, and out to where the arm is all but stretched, and back."""
    arm = arms(robot)[0]
    root, _ = chain(robot, robot.frame_id(arm.tool, "tool"))
    height = draw("height") * arm.length
    turn = np.array([np.cos(draw("angle")), np.sin(draw("angle")), 0.0])
    across = np.array([-turn[1], turn[0], 0.0]) * draw("beside")
    ends = [
        root + across + height * np.array([0.0, 0.0, 1.0]) + side * 0.25 * arm.length * turn for side in (1.0, -1.0)
    ]
    direction = _outwards(draw)
    stretched = root + 0.995 * reach_along(robot, arm, direction) * direction
    points = [arm.home, *ends, ends[0], arm.home, stretched, arm.home]
    return _scenario(robot, arm, robot.home, points, _times(points, draw("speed")))


def behind(draw: Draw, robot: Robot) -> dict[str, Any]:
    """End behind a plate that stands across the straight way: the target is in reach, the way to it leads round."""
    arm = arms(robot)[0]
    goal = _near_home(draw, robot, arm)
    chord = goal - arm.home
    if np.linalg.norm(chord) < 0.25 * arm.length:
        raise Redraw("the goal is too near")
    yaw, half = float(np.arctan2(chord[1], chord[0])), draw("size")
    center = arm.home + draw("share") * chord
    plate = {
        "name": "plate",
        "shape": {"type": "box", "size": [0.02, 2.0 * half, 2.0 * half]},
        "motion": {"type": "fixed", "position": center, "rpy": [0.0, 0.0, yaw]},
    }
    t = float(np.linalg.norm(chord)) / draw("speed")
    return _scenario(robot, arm, robot.home, [arm.home, goal], [0.5, 0.5 + t], [plate])


def edge(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Wiggle the target at the edge of reach, `frequency` times a second, and end `inside` it."""
    arm, direction = arms(robot)[0], _outwards(draw)
    root, _ = chain(robot, robot.frame_id(arm.tool, "tool"))
    at_edge = root + reach_along(robot, arm, direction) * direction
    t = 0.5 + float(np.linalg.norm(at_edge - arm.home)) / draw("speed")
    aside, amplitude, frequency = np.array(draw("aside")), draw("amplitude"), draw("frequency")
    wiggle = np.arange(0.0, 3.0, 0.05)
    phase = 2.0 * np.pi * frequency * wiggle[:, None]
    hand = at_edge + amplitude * (np.sin(phase) * direction + 0.5 * np.sin(1.3 * phase) * aside)
    points = [arm.home, at_edge, *hand[1:], root + (1.0 - draw("inside")) * (at_edge - root)]
    return _scenario(robot, arm, robot.home, points, [0.5, t, *(t + wiggle[1:]), t + 3.5], profile="constant")


def bad_start(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Start with a ball nearer than d1 to the tool's link by `depth`, or in it; the target is clear."""
    arm = arms(robot)[0]
    goal, radius = _near_home(draw, robot, arm), draw("radius")
    link = robot.model.frames[robot.frame_id(arm.tool, "tool")].parentJoint
    bodies = placed_bodies(robot, robot.home)
    own, others = ([(s, p) for joint, s, p in bodies if (joint == link) == mine] for mine in (True, False))
    direction, required = np.array(draw("aside")), draw("d1") - draw("depth")

    def clearance(distance: float, solids: Any) -> float:
        place = coal.Transform3s(np.eye(3), arm.home + distance * direction)
        return float(min_distance(coal.Sphere(radius), place, solids))

    low, high = 0.0, 0.5
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if clearance(middle, own) < required else (low, middle)
    center = arm.home + high * direction
    if abs(clearance(high, own) - required) > 1e-3 or clearance(high, others) < draw("d1"):
        raise Redraw("the ball is not where it is to be")
    if np.linalg.norm(goal - center) < radius + 0.15:
        raise Redraw("the target is too near to the ball")
    ball = {
        "name": "ball",
        "shape": {"type": "sphere", "radius": radius},
        "motion": {"type": "fixed", "position": center},
    }
    t = float(np.linalg.norm(goal - arm.home)) / draw("speed")
    return _scenario(robot, arm, robot.home, [arm.home, goal], [0.5, 0.5 + t], [ball])


def reach_along(robot: Robot, arm: Arm, direction: Array) -> float:
    """Return how far from the root of its chain a tool comes in a direction (3,), by bisection [m].

    Raises:
        Redraw: it does not come that way at all.
    """
    root, low = chain(robot, robot.frame_id(arm.tool, "tool"))[0], 0.4 * arm.length
    high = 1.5 * arm.length
    if not is_reachable(robot, arm.tool, root + low * direction):
        raise Redraw("the tool does not come that way")
    while high - low > _PRECISION:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_reachable(robot, arm.tool, root + middle * direction) else (low, middle)
    return low


def _outwards(draw: Draw) -> Array:
    """Draw a direction (3,) forwards and up: `turn` about the vertical and `rise` above the horizontal [rad]."""
    turn, rise = draw("turn"), draw("rise")
    return np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])


def _near_home(draw: Draw, robot: Robot, arm: Arm) -> Array:
    """Draw a place (3,) for the tool, `forward`, `sideways` and `up` of its home, clear of the robot itself."""
    place = arm.place(draw("forward"), draw("sideways"), draw("up"))
    q = posture(robot, {arm.tool: place})
    data = robot.bodies.createData()
    pin.updateGeometryPlacements(robot.model, robot.model.createData(), robot.bodies, data, q)
    pin.computeDistances(robot.bodies, data)
    if min((result.min_distance for result in data.distanceResults), default=np.inf) < 0.03:
        raise Redraw("the robot is too near to itself")
    return place


def _times(points: Sequence[Array], speed: float) -> list[float]:
    """Return the times (n,) at which a target at a mean speed is at some points [s]."""
    steps = [max(float(np.linalg.norm(b - a)) / speed, 0.3) for a, b in pairwise(points)]
    return [float(t) for t in 0.5 + np.cumsum([0.0, *steps])]


def _scenario(
    robot: Robot,
    arm: Arm,
    q: Array,
    points: Sequence[Array],
    times: Sequence[float],
    obstacles: Sequence[dict[str, Any]] = (),
    profile: str = "",
) -> dict[str, Any]:
    """Return fields of a scenario whose tool follows points (3,) at their times."""
    motion = waypoint_motion(points, times, profile or "smooth")
    task = {"frame": arm.tool, "type": "position", "motion": motion, "gain": GAIN, "max_speed": MAX_SPEED}
    duration = round(times[-1] + _REST, 1)
    return {"q0": joint_values(robot, q), "tasks": [task], "obstacles": list(obstacles), "duration": duration}
