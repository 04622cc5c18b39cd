"""Plan from a configuration to goals: RRT-Connect on the bodies and pairs that the controller looks at.

Clearances are tried in turn, the largest first: a path with more is easier to follow. A pair that begins nearer than
that needs what it has, less 1 mm, so that a start next to something can be left. Budgets are counts, never times: the
same arguments give the same path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qpavoid import kernels
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.kernels.planning import FINE, PlanningArrays
from qpavoid.kernels.planning_goals import FrameTargets
from qpavoid.kernels.planning_search import BACK_OFF, DONE, NO_CLEAR_GOAL, NOT_ATTAINED
from qpavoid.model.scene import Scene
from qpavoid.planning.goals import NO_TARGETS, Frame, read_goals, read_targets
from qpavoid.planning.layout import PlanLayout, describe
from qpavoid.planning.path import Path, no_path
from qpavoid.problem import Array, require_finite
from qpavoid.reason import Reason, ReasonKind

_SEED = 0x7FFFFFFF


@dataclass(frozen=True)
class PlannerSettings:
    """How plans are made."""

    safety_distance: float = 0.03
    """Distance between surfaces that every pair keeps, d1 less the offset [m]; the robot's pairs with a smaller one of
    their own keep that."""
    clearances: Sequence[float] = (0.03, 0.015, 0.006, 0.0015)
    """Distances beyond it that are tried in turn [m]."""
    velocity_scale: float = 0.6
    """Fraction of the joints' speed limits that the times of a path use [-]."""
    max_speed: float = 1.8
    """Speed that they use at most [rad/s or m/s]."""
    longest: float = 0.5
    """Length of an edge of the search trees at most [m]: roughly the travel of the fastest point of the robot."""
    first_nodes: int = 80
    """Nodes of the first trees, with each clearance: a path with less, soon found, is better than a long search."""
    max_nodes: int = 10_000
    """Nodes of the last trees, with the least clearance."""
    max_checks: int = 200_000
    """Configurations that a plan checks before it ends: about half a second."""
    max_goals: int = 8
    """Goal configurations of targets."""
    tries: int = 400
    """Searches for them."""
    shortcuts: int = 120
    """Straight motions that are tried in place of parts of a path."""
    tolerance: float = 1e-4
    """Distance up to which positions of targets are attained [m]; orientations, to ten times as many radians."""


class Planner:
    """Plans paths of one robot among the obstacles of a scene."""

    def __init__(
        self, scene: Scene, settings: PlannerSettings | None = None, distances: DistanceQuery | None = None
    ) -> None:
        """Lay the memory out.

        Args:
            scene: robot and obstacles; these are where they are at time 0, until `place`.
            settings: how plans are made.
            distances: of `Controller.distances()`, which know what is attached; overwritten by plans.

        Raises:
            ConfigError: a joint has several coordinates, or slides without a limit.
        """
        self.scene, self.settings = scene, settings or PlannerSettings()
        self._distances = distances or DistanceQuery(scene)
        self._layout = PlanLayout(scene, self._distances)
        s, speeds = self.settings, scene.robot.bounds().velocity
        self._speed: Array = np.minimum(s.velocity_scale * speeds, s.max_speed)

    def place(self, obstacles: ObstacleStates) -> None:
        """Move the obstacles to other states: where they are at the time 0 of later plans, and at which twists."""
        self._distances.place(obstacles)

    def plan(
        self,
        q: Array,
        goals: Any = None,
        targets: Mapping[Frame, Any] | None = None,
        clearances: Sequence[float] | None = None,
        seed: int = 0,
        max_nodes: int | None = None,
        arrivals: Sequence[float] = (),
        near: Array | None = None,
    ) -> Path:
        """Plan a path from a configuration to one of some goals.

        Args:
            q: start (nq,).
            goals: configurations (nq,) or (k, nq), any of which is one; or None, where `targets` are given.
            targets: where frames should be, see `read_targets`; goals are found by inverse kinematics.
            clearances: distances beyond the safety distance to try in turn [m]; those of the settings if left out.
            seed: of the random numbers.
            max_nodes: of a search; that of the settings if left out.
            arrivals: times at which to arrive, tried in turn [s]: obstacles go on at their twists. Left out: obstacles
                rest where they are.
            near: configuration (nq,) next to which goals are looked for first; the start if left out.

        Returns:
            The path, which is false and has a reason where none was found.

        Raises:
            NumericalError, UnknownName: an argument that cannot be meant.
            ConfigError: only coal can compute the distance of a pair.
        """
        layout, s = self._layout, self.settings
        q = require_finite("q", q, (self.scene.robot.model.nq,))
        start = layout.coordinates(q)
        points = [start] if near is None else [start, layout.coordinates(require_finite("near", near, q.shape), start)]
        frames, poses = list[int](), None
        if targets is not None:
            poses, frames = read_targets(self.scene.robot, targets)
        given = read_goals(goals, len(q)) if targets is None else np.zeros((0, len(q)))
        ends = np.array([layout.coordinates(goal, start) for goal in given]).reshape(-1, len(start))
        layout.update()
        self._distances.arrays.guesses[:] = 0.0  # so that nothing depends on earlier plans
        states = self._distances.arrays.states.copy()
        if arrivals and (refusal := self._refuse_times(states)):
            return no_path(self.scene, Reason.of(ReasonKind.NO_PLAN, detail=refusal))
        x = layout.arrays(states, np.vstack((*points, *ends)), self._speed, s.longest, frames)
        return self._search(
            x, start, ends, poses or NO_TARGETS, points[-1], tuple(arrivals) or (0.0,), seed & _SEED,
            tuple(s.clearances if clearances is None else clearances), max_nodes or s.max_nodes,
        )  # fmt: skip

    def _search(
        self, x: PlanningArrays, start: Array, goals: Array, targets: FrameTargets, near: Array,
        arrivals: Sequence[float], seed: int, clearances: Sequence[float], max_nodes: int,
    ) -> Path:  # fmt: skip
        """Search with one arrival after the other, see `kernels.search`; x has the memory of the plan."""
        plan, s = kernels.pack(x), self.settings
        least = self._layout.needs(s.safety_distance)
        steps = np.sort(np.asarray(clearances, dtype=np.float64))[::-1]
        limit, distances = float(least.max(initial=0.0) + steps.max(initial=0.0) + 0.1), np.empty(len(least))
        kernels.pair_clearances(plan, start, 0.0, limit, distances)
        if len(distances) and not distances.min() >= FINE:
            return self._none(ReasonKind.START_TOO_NEAR, distances)
        needs = np.minimum(least + steps[:, None] - FINE, np.maximum(distances - BACK_OFF, 0.0))
        nodes, ending, count = 0, NOT_ATTAINED, 0
        for arrival in arrivals:
            points, level, nodes, count, ending = kernels.search(
                plan, start, goals, targets, near, arrival, needs.copy(), np.minimum(least, needs.min(axis=0)),
                s.first_nodes, max_nodes, s.max_checks, s.max_goals, s.tries, s.shortcuts, s.tolerance, seed,
            )  # fmt: skip
            if ending == DONE:
                x_path = np.ascontiguousarray(points[:, :-1])
                return Path(
                    self._layout.configurations(x_path), points[:, -1].copy(), x_path, float(steps[level]),
                    int(x.checks[0]), nodes, count, None,
                )  # fmt: skip
        if ending == NO_CLEAR_GOAL and len(goals):
            kernels.pair_clearances(plan, goals[0], arrivals[-1], limit, distances)
            return self._none(ReasonKind.GOAL_TOO_NEAR, distances, least)
        kind = {NOT_ATTAINED: ReasonKind.NOT_ATTAINED, NO_CLEAR_GOAL: ReasonKind.GOAL_TOO_NEAR}
        checks = int(x.checks[0])
        reason = Reason.of(kind[ending]) if ending in kind else Reason.of(ReasonKind.NO_PATH, amount=checks, unit="-")
        return no_path(self.scene, reason, checks, nodes, count)

    def clearance(self, q: Array) -> float:
        """Return the least distance of all pairs at a configuration (nq,), -∞ where cores of bodies meet [m].

        Of pairs that only coal can compute, the hull stands for what is not convex.
        """
        layout = self._layout
        layout.update()
        start = layout.coordinates(require_finite("q", q, (self.scene.robot.model.nq,)))
        x = layout.arrays(self._distances.arrays.states.copy(), start[None], self._speed, 1.0, [])
        distances = np.empty(len(x.pairs))
        kernels.pair_clearances(kernels.pack(x), start, 0.0, np.inf, distances)
        return float(distances.min(initial=np.inf))

    def _refuse_times(self, states: Array) -> str:
        """Return why obstacles cannot be followed in time, empty if they can."""
        turning = np.any(states[:, 15:] != 0.0, axis=1) & np.isinf(self._distances.obstacle_radii)
        if turning.any():
            return f"{self.scene.slots[int(np.argmax(turning))].name} is a half-space that turns"
        return ""

    def _none(self, kind: ReasonKind, distances: Array, needed: Array | float = 0.0) -> Path:
        """Return no path because of the pair with the least distance (k,) beyond what is needed [m]."""
        worst = int(np.argmin(distances - needed))
        pair = describe(self.scene, int(self._layout.pairs[worst]), self._layout.hulls)
        return no_path(self.scene, Reason.of(kind, *pair, amount=float(distances[worst]), unit="m"))
