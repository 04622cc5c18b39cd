"""mink: its velocities filtered, or the avoidance rows as one of its limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mink

from qpavoid.adapters.joints import JointMap
from qpavoid.adapters.velocities import RowLimit, VelocityFilter
from qpavoid.controller import Controller
from qpavoid.problem import Array


def velocity_filter(controller: Controller, configuration: mink.Configuration) -> VelocityFilter:
    """Return the filter to call with `configuration.q` and what `mink.solve_ik` returns.

    Raises:
        UnknownName: mink's model lacks a joint of the controller's robot.
        ConfigError: a joint that is neither a hinge, a slide nor a floating base.
    """
    return VelocityFilter(controller, JointMap.of_mujoco(controller.scene.robot, configuration.model))


class AvoidanceLimit(RowLimit, mink.Limit):  # type: ignore[misc]
    """Avoidance rows and joint bounds of a controller as a limit of mink; `solve_ik` uses it."""

    def __init__(self, controller: Controller, configuration: mink.Configuration) -> None:
        """Limit for a configuration of mink.

        Raises:
            UnknownName: mink's model lacks a joint of the controller's robot.
            ConfigError: a joint that is neither a hinge, a slide nor a floating base.
        """
        super().__init__(controller, JointMap.of_mujoco(controller.scene.robot, configuration.model))

    def compute_qp_inequalities(self, configuration: mink.Configuration, dt: float) -> mink.Constraint:
        """Begin a control step; return G and h of G Δq <= h, as mink asks for them.

        Raises:
            ConfigError: dt is not the controller's.
        """
        return mink.Constraint(*self.inequalities(configuration.q, dt))


def solve_ik(
    configuration: mink.Configuration,
    tasks: Sequence[Any],
    dt: float,
    limit: AvoidanceLimit,
    limits: Sequence[Any] | None = None,
    **options: Any,
) -> Array:
    """Return the safe velocity of `mink.solve_ik` with the avoidance rows in its QP; a stop where it finds none.

    Args:
        configuration: of mink.
        tasks: of mink.
        dt: control period [s], the controller's.
        limit: of the controller; set its `obstacles` before.
        limits: others; mink's configuration limit if left out.
        options: all else of `mink.solve_ik`; solver daqp if left out.
    """
    others = (mink.ConfigurationLimit(configuration.model),) if limits is None else limits
    options = {"solver": "daqp", **options}
    return limit.solve(
        lambda: mink.solve_ik(configuration, tasks, dt, limits=[*others, limit], **options), mink.NoSolutionFound
    )
