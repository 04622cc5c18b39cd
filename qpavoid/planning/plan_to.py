"""A collision-free path from here, in one call: for programs that want no more than that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

from qpavoid.config import Avoidance
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.errors import ConfigError, UnknownName
from qpavoid.model.scene import Scene
from qpavoid.planning.goals import Frame
from qpavoid.planning.path import Path, no_path
from qpavoid.planning.planner import Planner, PlannerSettings
from qpavoid.problem import Array
from qpavoid.reason import Reason, ReasonKind


class SceneOwner(Protocol):
    """A `Controller`, as far as a plan needs it."""

    scene: Scene
    avoidance: Avoidance

    @property
    def obstacle_states(self) -> ObstacleStates:
        """Where obstacles are."""

    @property
    def has_contacts(self) -> bool:
        """Whether the robot stands on something."""

    def distances(self) -> DistanceQuery:
        """Return distances that know what is attached."""


def make_planner(source: Scene | SceneOwner, settings: PlannerSettings | None = None) -> Planner:
    """Make a planner for a scene, or for the scene of a controller as it is now, with what is attached.

    Args:
        source: a scene, whose obstacles are where they are at time 0, or a controller.
        settings: how plans are made; the safety distance of the controller's avoidance if left out.

    Raises:
        ConfigError: a joint has several coordinates, or slides without a limit; the robot stands on contacts.
    """
    if isinstance(source, Scene):
        return Planner(source, settings)
    if source.has_contacts:
        raise ConfigError("no plans with contacts: a path would not hold them")
    if settings is None:
        settings = replace(PlannerSettings(), safety_distance=source.avoidance.d1 - source.avoidance.offset)
    planner = Planner(source.scene, settings, source.distances())
    planner.place(source.obstacle_states)
    return planner


def plan_to(
    source: Scene | SceneOwner,
    q: Array,
    q_goal: Any = None,
    targets: Mapping[Frame, Any] | None = None,
    *,
    seed: int = 0,
    settings: PlannerSettings | None = None,
) -> Path:
    """Plan a path from a configuration to a goal that no body of a scene comes too near on.

    It has the bodies and pairs of the controller: the robot's own, obstacles, point clouds, what is attached. Obstacles
    rest where they are. Nothing is sampled: between its configurations the path is straight, and clear all along. The
    same arguments give the same path.

    Args:
        source: scene, whose obstacles are where they are at time 0, or `Controller`: as it was in its last step.
        q: start (nq,).
        q_goal: goal configuration (nq,), or several (k, nq), any of which is one.
        targets: in place of it, where frames should be at the end, by name: a `Pose`, `Sample`, `pin.SE3` or 4×4
            matrix, a position (3,), or an orientation (3, 3). A pair of frames instead of a name: the pose of the first
            one in the axes of the second.
        seed: of the random numbers.
        settings: safety distance, clearances and budgets.

    Returns:
        The path; where none was found, it is false and has a `reason`. Joints of several coordinates, contacts and
        shapes that only coal knows are refused that way, too.

    Raises:
        NumericalError, UnknownName: an argument that cannot be meant.
    """
    if (q_goal is None) == (targets is None):
        raise ConfigError("plan_to: give one of q_goal and targets")
    scene = source if isinstance(source, Scene) else source.scene
    try:
        return make_planner(source, settings).plan(q, q_goal, targets, seed=seed)
    except UnknownName:
        raise
    except ConfigError as error:
        return no_path(scene, Reason.of(ReasonKind.NO_PLAN, detail=str(error)))
