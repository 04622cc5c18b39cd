"""Pink: its velocities filtered, or the avoidance rows as one of its limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pink
from pink.exceptions import NoSolutionFound
from pink.limits import Limit

from qpavoid.adapters.joints import JointMap
from qpavoid.adapters.velocities import RowLimit, VelocityFilter
from qpavoid.controller import Controller
from qpavoid.problem import Array


def velocity_filter(controller: Controller, configuration: pink.Configuration) -> VelocityFilter:
    """Return the filter to call with `configuration.q` and what `pink.solve_ik` returns.

    Raises:
        UnknownName: Pink's model lacks a joint of the controller's robot.
    """
    return VelocityFilter(controller, JointMap.of_pinocchio(controller.scene.robot, configuration.model))


class AvoidanceLimit(RowLimit, Limit):  # type: ignore[misc]
    """Avoidance rows and joint bounds of a controller as a limit of Pink; `solve_ik` uses it."""

    def __init__(self, controller: Controller, configuration: pink.Configuration) -> None:
        """Limit for a configuration of Pink.

        Raises:
            UnknownName: Pink's model lacks a joint of the controller's robot.
        """
        super().__init__(controller, JointMap.of_pinocchio(controller.scene.robot, configuration.model))

    def compute_qp_inequalities(self, configuration: pink.Configuration, dt: float) -> tuple[Array, Array]:
        """Begin a control step; return G and h of G Δq <= h, as Pink asks for them.

        Raises:
            ConfigError: dt is not the controller's.
        """
        return self.inequalities(configuration.q, dt)


def solve_ik(
    configuration: pink.Configuration,
    tasks: Sequence[Any],
    dt: float,
    limit: AvoidanceLimit,
    limits: Sequence[Any] | None = None,
    **options: Any,
) -> Array:
    """Return the safe velocity of `pink.solve_ik` with the avoidance rows in its QP; a stop where it finds none.

    Args:
        configuration: of Pink.
        tasks: of Pink.
        dt: control period [s], the controller's.
        limit: of the controller; set its `obstacles` before.
        limits: others; those of Pink's model if left out.
        options: all else of `pink.solve_ik`; solver daqp, and no exception outside position limits, if left out.
    """
    model = configuration.model
    others = (model.configuration_limit, model.velocity_limit) if limits is None else limits
    options = {"solver": "daqp", "safety_break": False, **options}
    return limit.solve(
        lambda: pink.solve_ik(configuration, tasks, dt, limits=[*others, limit], **options), NoSolutionFound
    )
