"""Proof that a scenario has a solution, or that its goals are out of reach as intended."""

from __future__ import annotations

import numpy as np

from qpavoid.config import ScenarioConfig
from qpavoid.control.tasks import FrameTask
from qpavoid.errors import ConfigError
from qpavoid.problem import Array
from qpavoid_bench.arena.families.clearance import Clearance
from qpavoid_bench.arena.families.inverse_kinematics import FrameGoal, JointRanges, solve_inverse_kinematics
from qpavoid_bench.arena.families.parameters import Redraw
from qpavoid_bench.arena.families.planner import Plan, plan
from qpavoid_bench.arena.families.reach import out_of_reach
from qpavoid_bench.arena.world import World, surface_safety_distance

_MAX_GOALS, MAX_TRIES = 6, 40
"""Configurations that attain the goal: largest number, and number of searches."""
_GOAL_PRECISION = 0.2
"""Fraction of the goal's tolerance within which they attain it [-]."""
_GOAL_TIME = 1.0
"""Time before the end for which a plan is at the goal, where obstacles move [s]."""
_SPEED_FRACTION, _MAX_SPEED = 0.5, 1.5
"""Fraction of the joints' speed limits that plans use [-], and their largest speed [rad/s or m/s]."""


STAYS = "the robot can stay where it starts"
"""Why contacts of a static family are avoidable."""


def solved_by(
    scenario: ScenarioConfig, world: World, reachable: bool | None, random: np.random.Generator, stays: bool = False
) -> str:
    """Describe the proof that a scenario is as intended.

    Args:
        scenario: what is run.
        world: of the same.
        reachable: whether its goals are meant to be reached; None: that is not to be proved, and the answer is empty.
        random: where samples come from.
        stays: whether it is proved that nothing touches the robot where it starts, in place of a way to the goals.

    Raises:
        ConfigError: no task is that of a frame with a position.
        Redraw: it starts too near to something, or no solution, or no proof that there is none, was found.
    """
    if not world.tools:
        raise ConfigError(f"{scenario.source}: tasks: none is that of a frame with a position; give one")
    clearance = Clearance(world, scenario.duration, surface_safety_distance(scenario))
    if not clearance.is_clear(world.q0, 0.0):
        raise Redraw("the start is too near to something")
    if not clearance.immovable_pairs_are_clear(world.q0):
        raise Redraw("an obstacle comes too near to what cannot move")
    if stays:
        if not clearance.stays_clear(world.q0):
            raise Redraw("an obstacle comes too near to where the robot starts")
        return STAYS
    if reachable is None:
        return ""
    if reachable:
        motion, d1 = find_plan(scenario, world, clearance, random), surface_safety_distance(scenario)
        return (
            f"RRT-Connect{' in space and time' * clearance.depends_on_time}: path of {motion.length:.1f} rad in "
            f"{motion.t[-1]:.1f} s, {motion.nodes} nodes, clear by {1e3 * d1:.0f} mm"
        )
    for task in world.tools:
        proof = out_of_reach(world, task, scenario.duration, scenario.goal_tolerance)
        if proof:
            return proof
    raise Redraw("no goal is out of reach")


def find_plan(scenario: ScenarioConfig, world: World, clearance: Clearance, random: np.random.Generator) -> Plan:
    """Plan a clear motion from the start to where all frames attain their targets.

    The robot can rest at the last node until the end of the run.

    Raises:
        Redraw: none was found.
    """
    ranges, bounds = JointRanges.of(world.scene.robot), world.scene.robot.bounds().within(scenario.limits)
    latest = max(scenario.duration - _GOAL_TIME, 0.0) if clearance.depends_on_time else scenario.duration
    goals = _goals(scenario, world, ranges, clearance, latest, random)
    speed = np.minimum(_SPEED_FRACTION * bounds.velocity, _MAX_SPEED)
    motion = plan(clearance, ranges, world.q0, goals, speed, latest, random)
    if motion is None:
        raise Redraw("no plan was found")
    return motion


def _goals(
    scenario: ScenarioConfig,
    world: World,
    ranges: JointRanges,
    clearance: Clearance,
    t_from: float,
    random: np.random.Generator,
) -> Array:
    """Find configurations (g, nv) at the final targets, clear from `t_from` [s] on.

    Those near the start come first.
    """
    robot, end = world.scene.robot, scenario.duration
    goals = []
    for task in world.tasks:
        if isinstance(task, FrameTask):
            target = task.motion.sample(end)
            goals.append(
                FrameGoal(
                    task.frame_id, target.position if task.moves else None, target.rotation if task.turns else None
                )
            )
    motion: list[Array] = []
    configurations = False
    for number in range(MAX_TRIES):
        spread = number / MAX_TRIES
        begin = world.q0 + spread * (random.uniform(ranges.lower, ranges.upper) - world.q0)
        q = solve_inverse_kinematics(robot, goals, begin, ranges, _GOAL_PRECISION * scenario.goal_tolerance)
        configurations |= q is not None
        if q is not None and clearance.is_clear_between(q, t_from, q, end):
            motion.append(q)
            if len(motion) == _MAX_GOALS:
                break
    if not motion:
        raise Redraw("nothing that attains the goal is clear" if configurations else "the goal is not attained")
    return np.array(motion)
