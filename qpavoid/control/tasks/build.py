"""Tasks of a scenario, made of its blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pinocchio as pin

from qpavoid import config
from qpavoid.control.tasks.axis import Axis
from qpavoid.control.tasks.base import RowTask
from qpavoid.control.tasks.com import Com
from qpavoid.control.tasks.frame import FrameTask
from qpavoid.control.tasks.manipulability import Manipulability
from qpavoid.control.tasks.momentum import Momentum
from qpavoid.control.tasks.posture import Damping, Posture
from qpavoid.control.tasks.relative import Relative
from qpavoid.control.tasks.start import Start
from qpavoid.model.robot import Robot
from qpavoid.problem import Array, require_finite

_KINDS: dict[type[config.TaskBlock], Callable[[Any, Start], RowTask]] = {
    config.Task: FrameTask,
    config.RelativeTask: Relative,
    config.ComTask: Com,
    config.MomentumTask: Momentum,
    config.PostureTask: Posture,
    config.DampingTask: Damping,
    config.LookAtTask: Axis,
    config.AlignTask: Axis,
    config.ManipulabilityTask: Manipulability,
}


def build_tasks(
    configs: Sequence[config.AnyTask], robot: Robot, q0: Array, source: Path = Path("tasks")
) -> list[RowTask]:
    """Make the tasks of a scenario; what motions and postures leave out is taken from where things are at q0.

    Args:
        configs: the scenario's `tasks`.
        robot: the robot that is controlled.
        q0: initial configuration (nq,).
        source: scenario file, named in errors and the start of relative paths.

    Raises:
        ConfigError, UnknownName: unknown frame or joint, motion or axis that cannot be used.
        NumericalError: q0 of another shape, or not finite.
    """
    q0, data = require_finite("q0", q0, (robot.model.nq,)), robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q0)
    pin.centerOfMass(robot.model, data, q0)
    return [
        _KINDS[type(settings)](settings, Start(robot, q0, data, source.parent, f"{source}: tasks.{index}"))
        for index, settings in enumerate(configs)
    ]
