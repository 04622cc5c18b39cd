"""Figures of one run by which entrants are compared; a row of the results."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from typing import Any

import numpy as np

from qpavoid.config import ScenarioConfig
from qpavoid.problem import Array, Status
from qpavoid.run.log import STATUSES
from qpavoid.run.metrics import path_deviation
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.checker import Findings
from qpavoid_bench.arena.families.reach import is_reachable
from qpavoid_bench.arena.rollout import Rollout
from qpavoid_bench.arena.world import World, surface_safety_distance

REST_SPEED = 1e-3
"""Speed of a tool below which it is at rest [m/s]."""
REST_DURATION = 1.0
"""Time for which tools are at rest at the end of a run that is stuck [s]."""
CHATTER_TIME = 0.5
"""Time at the end of a run in which chatter is looked for [s]."""
_REACH_PERIOD = 0.1
"""Time between two targets of which it is found out whether they are in reach [s]."""
_ROUND_OFF = 1e-6


@dataclass(frozen=True)
class Score:
    """Figures of one run.

    Distances and limits are the checker's; a failure counts at its limit, and every run has all figures.
    """

    family: str
    seed: int
    robot: str
    case: str
    """`Case.key`: digest of the scenario."""
    entrant: str
    settings: str
    """Digest of the entrant and its settings."""
    version: str
    """Version of qpavoid."""
    reachable: bool
    """Whether the goals can be reached."""
    success: bool
    """No contact, and all goals reached; where they cannot be, at rest at the end."""
    collided: bool
    """At least one pair touched."""
    avoidable: bool
    """A contact that could have been avoided: any where a solution is proved to exist, else by `arena.verdict`."""
    verdict: str
    """Proof of that, of a contact in a case without proved solution; else empty."""
    contacts: int
    """Number of pairs that touched."""
    min_distance: float
    """Smallest distance of the pairs that the robot can move [m]."""
    d1: float
    """Safety distance between surfaces [m]."""
    below_d1: float
    """Fraction of the time with a distance below d1 [-]."""
    arrived: bool
    """Every tool ended within the goal tolerance."""
    final_error: float
    """Distance of the worst tool from its goal at the end [m]."""
    tracking_error: float
    """Root mean square of the distances between tools and their moving targets [m]."""
    deviation: float
    """Largest distance of a tool from the path of its target [m]."""
    path_length: float
    """Length of the tools' paths together, over that of their targets [-]."""
    time_to_goal: float
    """Time after which every tool stayed within the goal tolerance, over the duration; 1 where that was never [-]."""
    stuck: bool
    """Not arrived, no contact, and the tools rested for the last second."""
    jerk: float
    """Root mean square of the joints' jerk [rad/s³ or m/s³]."""
    jitter: float
    """Σ|Δq̇| over joints and ticks, per second [rad/s² or m/s²]."""
    frozen: float
    """Fraction of the time with all tools at rest and a target away that is in reach, whatever is in the way; 0 of a
    robot whose base floats, of whose reach nothing is known [-]."""
    lurch: float
    """Largest Σ|Δq̇| of a step over joints, from rest [rad/s or m/s]."""
    chatter: float
    """Mean Σ|Δq̇| of a step over joints, in the last half second [rad/s or m/s]."""
    peak_velocity: float
    """Largest velocity of a joint, over its limit [-]."""
    violations: float
    """Fraction of steps that exceed a velocity, position, acceleration or jerk limit; of a plant, one of velocity,
    position or torque [-]."""
    torque: float
    """Largest commanded torque over its limit; 0 where velocities are followed, as the three below [-]."""
    torque_jitter: float
    """Σ|Δτ| over motors and ticks, per second [Nm/s or N/s]."""
    slip: float
    """Largest way of a contact point along the floor [m]."""
    fallen: float
    """Share of the duration after the robot fell [-]."""
    relaxed: float
    """Fraction of steps whose constraints were relaxed [-]."""
    stopped: float
    """Fraction of steps in which the robot was braked or at rest, the entrant's failures among them [-]."""
    failed: float
    """Fraction of steps in which the entrant raised, or gave no finite velocity [-]."""
    failure: str
    """Message of the first failure; empty without one."""
    tick_p50: float
    """Median computation time of a step [µs]."""
    tick_p99: float
    """99th percentile of the computation time of a step [µs]."""
    tick_max: float
    """Longest computation time of a step [µs]."""
    ticks: int
    dt: float
    """Control period [s]."""
    duration: float
    """Duration of the run [s]."""
    seconds: float
    """Time that the run took to compute, checker included [s]."""

    def row(self) -> dict[str, Any]:
        """Return the figures as a row of a table."""
        return asdict(self)


COLUMNS = {field.name: str(field.type) for field in fields(Score)}
"""Type of each column: `str`, `int`, `float` or `bool`."""
KEY = ("case", "entrant", "settings", "version")
"""Columns that identify a run."""


def score(
    case: Case, world: World, entrant: str, settings: str, rollout: Rollout, findings: Findings, seconds: float
) -> Score:
    """Compute the figures of a run.

    Args:
        case: what was run.
        world: of the same case.
        entrant: who ran it.
        settings: digest of the entrant.
        rollout: what it did.
        findings: result of the checker.
        seconds: what the run took [s].
    """
    scenario, ticks = case.scenario, len(rollout.t)
    error = np.linalg.norm(rollout.target - rollout.tool, axis=2).max(axis=1, initial=0.0)
    goal_error = np.linalg.norm(rollout.target[-1] - rollout.tool, axis=2).max(axis=1, initial=0.0)
    outside_tolerance = np.flatnonzero(goal_error > scenario.goal_tolerance)
    arrived = bool(goal_error[-1] <= scenario.goal_tolerance)
    settled = rollout.tool[-1 - min(ticks - 1, round(REST_DURATION / scenario.dt)) :]
    rests = bool(np.ptp(settled, axis=0).max(initial=0.0) <= REST_SPEED * REST_DURATION)
    change = np.diff(rollout.v, axis=0)
    limit = world.scene.robot.bounds().velocity
    return Score(
        family=case.family,
        seed=case.seed,
        robot=world.scene.robot.name,
        case=case.key,
        entrant=entrant,
        settings=settings,
        version=version("qpavoid"),
        reachable=case.reachable,
        success=not findings.contacts and not rollout.fallen and (arrived if case.reachable else rests),
        collided=bool(findings.contacts),
        avoidable=bool(findings.contacts),
        verdict="",
        contacts=len(findings.contacts),
        min_distance=findings.distance,
        d1=surface_safety_distance(scenario),
        below_d1=float(np.mean(findings.nearest < surface_safety_distance(scenario))),
        arrived=arrived,
        final_error=float(goal_error[-1]),
        tracking_error=float(np.sqrt(np.mean(error**2))),
        deviation=float(path_deviation(rollout.tool, rollout.target).max(initial=0.0)),
        path_length=_path_length(rollout.tool) / max(_path_length(rollout.target), 1e-9),
        time_to_goal=(int(outside_tolerance[-1]) + 1 if len(outside_tolerance) else 0) / ticks if arrived else 1.0,
        stuck=case.reachable and not arrived and not findings.contacts and rests,
        jerk=float(np.sqrt(np.mean(np.square(np.diff(change, axis=0))))) / scenario.dt**2,
        jitter=float(np.abs(change).sum()) / scenario.duration,
        frozen=_frozen_fraction(case, world, rollout),
        lurch=float(np.abs(np.diff(rollout.v, axis=0, prepend=0.0)).sum(axis=1).max(initial=0.0)),
        chatter=float(np.abs(change[-round(CHATTER_TIME / scenario.dt) :]).sum(axis=1).mean()) if ticks > 1 else 0.0,
        peak_velocity=float(np.max(np.abs(rollout.v) / limit, initial=0.0)),
        violations=float(np.mean(_violates_limits(world, scenario, rollout, findings))),
        torque=float(np.max(np.abs(rollout.torque) / rollout.torque_limit, initial=0.0)),
        torque_jitter=float(np.abs(np.diff(rollout.torque, axis=0)).sum()) / (scenario.dt * ticks),
        slip=rollout.slip,
        fallen=rollout.fallen,
        relaxed=_status_fraction(rollout, Status.RELAXED),
        stopped=_status_fraction(rollout, Status.STOPPED),
        failed=float(np.mean(rollout.failed)),
        failure=rollout.failure,
        tick_p50=1e6 * float(np.median(rollout.tick)),
        tick_p99=1e6 * float(np.quantile(rollout.tick, 0.99)),
        tick_max=1e6 * float(rollout.tick.max()),
        ticks=ticks,
        dt=scenario.dt,
        duration=scenario.duration,
        seconds=seconds,
    )


def _frozen_fraction(case: Case, world: World, rollout: Rollout) -> float:
    """Return the fraction of the time with all tools at rest, and one away from a target in reach."""
    dt = case.scenario.dt
    speed = np.linalg.norm(np.diff(rollout.tool, axis=0), axis=2).max(axis=1, initial=0.0) / dt
    away = np.linalg.norm(rollout.target - rollout.tool, axis=2) > case.scenario.goal_tolerance
    at_rest = np.append(speed < REST_SPEED, False)
    is_floating = world.contacts is not None
    if is_floating or not (at_rest[:, None] & away).any():
        return 0.0
    every, robot = max(1, round(_REACH_PERIOD / dt)), world.scene.robot
    points = np.round(rollout.target[::every], 3)
    in_reach = np.ones(points.shape[:2], dtype=bool)
    for tool, task in enumerate(world.tools):
        known = {p: is_reachable(robot, task.settings.frame, np.array(p)) for p in set(map(tuple, points[:, tool]))}
        in_reach[:, tool] = [known[p] for p in map(tuple, points[:, tool])]
    return float(np.mean(at_rest & (away & np.repeat(in_reach, every, axis=0)[: len(away)]).any(axis=1)))


def _status_fraction(rollout: Rollout, status: Status) -> float:
    """Return the fraction of steps with a status."""
    return float(np.mean(rollout.status == STATUSES.index(status)))


def _path_length(path: Array) -> float:
    """Return the length of all tools' paths (N, k, 3) together [m]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=2).sum())


def _violates_limits(world: World, scenario: ScenarioConfig, rollout: Rollout, findings: Findings) -> Array:
    """Return for each step (N,) whether it exceeds a limit by more than round-off."""
    bounds = world.scene.robot.bounds().within(scenario.limits)
    q = findings.q[:, bounds.q_index]
    passed = (np.abs(rollout.v) > bounds.velocity + _ROUND_OFF).any(axis=1)
    passed |= ((q < bounds.lower - _ROUND_OFF) | (q > bounds.upper + _ROUND_OFF)).any(axis=1)
    if scenario.plant is not None:
        return np.asarray(passed | (np.abs(rollout.torque) > rollout.torque_limit + _ROUND_OFF).any(axis=1))
    acceleration = np.diff(rollout.v, axis=0, prepend=0.0) / scenario.dt
    jerk = np.diff(acceleration, axis=0, prepend=0.0) / scenario.dt
    return np.asarray(
        passed
        | (np.abs(acceleration) > bounds.acceleration + _ROUND_OFF / scenario.dt).any(axis=1)
        | (np.abs(jerk) > bounds.jerk + _ROUND_OFF / scenario.dt**2).any(axis=1)
    )
