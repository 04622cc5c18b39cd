"""Whether a scenario has a solution at all, or, of one whose goals are meant to be out of reach, whether they are."""

from __future__ import annotations

import numpy as np

from qpavoid.arena.families.clearance import Clearance
from qpavoid.arena.families.out_of_reach import out_of_reach
from qpavoid.arena.families.parameters import Redraw
from qpavoid.arena.families.planner import Plan, plan
from qpavoid.arena.families.reach import Ranges, Want, configuration_at
from qpavoid.arena.scores import to_keep
from qpavoid.arena.world import World
from qpavoid.config import ScenarioConfig
from qpavoid.control.tasks.frames import FrameTask
from qpavoid.errors import ConfigError
from qpavoid.problem import Array

_MOST_GOALS, _TRIES = 6, 40
"""Configurations that attain the goal: how many are wanted, how many searches are made."""
_PRECISE = 0.2
"""Share of the goal's tolerance that they use [-]."""
_HOLD = 1.0
"""Where obstacles move, how long before the end the goal is attained, and held [s]."""
_SPEED_SHARE, _FASTEST = 0.5, 1.5
"""Share of the joints' speed limits that plans use [-], and what they use at most [rad/s or m/s]."""


def solved_by(scenario: ScenarioConfig, world: World, reachable: bool, random: np.random.Generator) -> str:
    """How it is known that a scenario is what it should be, in words.

    Args:
        scenario: what is run.
        world: of the same.
        reachable: whether its goals are meant to be reached.
        random: where samples come from.

    Raises:
        ConfigError: no task is that of a frame with a position.
        Redraw: it starts too near to something, or no solution, or no proof that there is none, was found.
    """
    if not world.tools:
        raise ConfigError(f"{scenario.source}: tasks: none is that of a frame with a position; give one")
    clearance = Clearance(world, scenario.duration, to_keep(scenario))
    if not clearance.clear(world.q0, 0.0):
        raise Redraw("the start is too near to something")
    if not clearance.roots_clear(world.q0):
        raise Redraw("an obstacle comes too near to what cannot move")
    if reachable:
        found = find_plan(scenario, world, clearance, random)
        return (
            f"RRT-Connect{' in space and time' * clearance.timed}: path of {found.length:.1f} rad in "
            f"{found.t[-1]:.1f} s, {found.nodes} nodes, clear by {1e3 * to_keep(scenario):.0f} mm"
        )
    for task in world.tools:
        why = out_of_reach(world, task, scenario.duration, scenario.goal_tolerance)
        if why:
            return why
    raise Redraw("no goal is out of reach")


def find_plan(scenario: ScenarioConfig, world: World, clearance: Clearance, random: np.random.Generator) -> Plan:
    """A motion from the start to where all frames attain their targets, always clear. It can rest at its last node
    until the end of the run.

    Raises:
        Redraw: none was found.
    """
    ranges, bounds = Ranges.of(world.scene.robot), world.scene.robot.bounds().within(scenario.limits)
    latest = max(scenario.duration - _HOLD, 0.0) if clearance.timed else scenario.duration
    goals = _goals(scenario, world, ranges, clearance, latest, random)
    speed = np.minimum(_SPEED_SHARE * bounds.velocity, _FASTEST)
    found = plan(clearance, ranges, world.q0, goals, speed, latest, random)
    if found is None:
        raise Redraw("no plan was found")
    return found


def _goals(
    scenario: ScenarioConfig,
    world: World,
    ranges: Ranges,
    clearance: Clearance,
    since: float,
    random: np.random.Generator,
) -> Array:
    """(g, nv) configurations that attain the targets of the end, clear of everything from some time on [s]; those near
    the start first.
    """
    robot, end = world.scene.robot, scenario.duration
    wants = []
    for task in world.tasks:
        if isinstance(task, FrameTask):
            there = task.motion.sample(end)
            wants.append(
                Want(task.frame_id, there.position if task.moves else None, there.rotation if task.turns else None)
            )
    found: list[Array] = []
    attained = False
    for number in range(_TRIES):
        spread = number / _TRIES
        begin = world.q0 + spread * (random.uniform(ranges.lower, ranges.upper) - world.q0)
        q = configuration_at(robot, wants, begin, ranges, _PRECISE * scenario.goal_tolerance)
        attained |= q is not None
        if q is not None and clearance.clear_between(q, since, q, end):
            found.append(q)
            if len(found) == _MOST_GOALS:
                break
    if not found:
        raise Redraw("nothing that attains the goal is clear" if attained else "the goal is not attained")
    return np.array(found)
