"""Momentum observer: what touches a torque-controlled robot."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from qpavoid.config.base import Block, Positive


class Observer(Block):
    """Torques from outside, from the robot's momentum, and thresholds beyond which it counts as touched."""

    rate: Positive = 50.0
    """K [1/s]: the rate at which the observed torque follows the one from outside."""
    threshold: dict[str, Positive] = {}
    """Joint: observed torque beyond which it is touched [Nm or N], as learnt from motion without contact; joints that
    are left out are never touched until thresholds are learnt, see `MomentumObserver.learn`."""
    margin: Annotated[float, Field(ge=1, le=100)] = 1.3
    """Threshold over the largest torque that was observed while it was learnt [-]."""
    stop: bool = False
    """Whether a robot that is touched brakes, and rests until `Controller.reset`."""
