"""Avoidance, joint limits, obstacles that are not updated and tasks without progress."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from qpavoid.config.base import Block, NonNegative, Positive
from qpavoid.config.observer import Observer

Fraction = Annotated[float, Field(gt=0, le=1)]


class Beta(Block):
    """Velocity damper weighted with eq. 12 far from d1: ḋ >= -max((1 - β(d)) ξ h, min(ξ h, near_speed)), h = d - d1;
    below d1 it backs away.
    """

    type: Literal["beta"] = "beta"
    gain: Positive = 5.0
    """ξ [1/s]."""
    near_speed: NonNegative = 0.02
    """Speed at which a pair may close near d1, where 1 - β lets it creep [m/s]; 0: it creeps; 10, or any beyond
    ξ (d2 - d1): a plain velocity damper."""


class TaskSwitching(Block):
    """Rate of eq. 10 as a lower bound: ḋ >= (1 - β)(1 - α) min(u, ẋ0) + β ẋ0, u that of tracking alone; below d1 it
    backs away.
    """

    type: Literal["task-switching"] = "task-switching"
    gain: Positive = 5.0
    """ξ [1/s], of backing away below d1."""
    retreat_speed: NonNegative = 0.0
    """ẋ0 [m/s]; more than 0 asks pairs that cannot separate, as of neighbouring links, for what no velocity gives."""
    alpha_cap: Positive = 50.0
    """Largest α; eq. 11 grows without bound as d goes to 0 [-]. At most 1 counts between two bodies of the robot."""


AvoidanceRow = Annotated[Beta | TaskSwitching, Field(discriminator="type")]


class Avoidance(Block):
    """Avoidance of collisions: distances, rows, and what checks the command."""

    d1: float = 0.03
    """Distance below which avoiding has taken over entirely (eq. 12) [m]."""
    d2: float = 0.10
    """Influence distance: farther pairs are ignored (eqs. 11, 12) [m]."""
    offset: NonNegative = 0.0
    """Added to the distance between surfaces before d1 and d2 are compared with it [m]. The paper measures
    between axes: its figures want the sum of the two radii here."""
    row: AvoidanceRow = Beta()
    """Form of the QP's avoidance rows."""
    recovery_speed: Positive | None = 0.2
    """Cap on the speed at which rows ask a pair that is too close to part [m/s]; `null`: none."""
    look_ahead: bool = True
    """Whether a velocity of the QP is checked over its control period and the braking trajectory after it, and reduced
    where that leads nearer than the safety distance."""

    backup: bool = True
    """Whether tasks are followed only while a backup trajectory stays clear of moving obstacles, see
    `qpavoid.safety.backup`. Takes time where these come near; not with contacts, nor for laws that keep no limits."""

    @model_validator(mode="after")
    def _ordered(self) -> Avoidance:
        if not 0 < self.d1 < self.d2:
            raise ValueError(f"needs 0 < d1 < d2, got d1 = {self.d1}, d2 = {self.d2}")
        if self.d1 <= self.offset:
            raise ValueError(f"d1 = {self.d1} must exceed offset = {self.offset}, else it lies inside the bodies")
        return self


class Limits(Block):
    """Joint limits as bounds on the velocity."""

    position_gain: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Share of the margin to a position limit that one control period may use [-]; joints with an acceleration limit
    keep to the speeds from which they can brake instead."""
    velocity_scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of the velocity limits that may be used [-]."""
    acceleration: Positive | None = None
    """Acceleration limit of the joints to which the robot gives none [rad/s² or m/s²]; left out: they have none."""
    acceleration_scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of the acceleration limits that may be used [-]."""
    jerk: Positive | None = None
    """Jerk limit of the joints to which the robot gives none [rad/s³ or m/s³]; needs acceleration limits of all of
    them; left out: they have none."""
    relax_acceleration: bool = True
    """Whether the QP passes acceleration and jerk limits before it lets a pair come too near; false: it never does."""
    saturate: bool = True
    """Whether the solvers that know no limits (all but the QP) are scaled and clipped to them afterwards."""


class Dynamics(Block):
    """Torque level: v is the velocity at the end of the control period, and torques within their limits lead to it."""

    torque_limits: Fraction | None = 1.0
    """Share of the torque limits that may be used [-]; `null`: torques have no limits, and braking counts on the
    accelerations as they are."""
    braking_fraction: Fraction = 0.75
    """Share of these torques on which braking counts [-]: what is left covers errors of the model, and that dynamics
    change during a stop."""
    holding_fraction: Fraction | None = 0.6
    """Share of these torques that gravity may take [-], below `braking_fraction`; `null`: rows do not keep to it."""
    support_margin: NonNegative | None = None
    """Of a robot that stands: least distance of its capture point from the edges of what it stands on [m]; `null`: rows
    do not keep to it."""
    tracking_rate: Positive = 100.0
    """k_v [1/s]: the rate at which the measured velocity approaches the one that the tasks ask for. A task of gain K
    then has the stiffness K k_v and the damping k_v."""
    row_rate: Positive = 100.0
    """α2 [1/s]: the rate at which rows are approached, at least four times the gain of the avoidance rows."""
    observer: Observer | None = None
    """What touches the robot, see `Solution.external`; left out, or `null`: it is not observed."""
    armature: NonNegative | dict[str, NonNegative] = {}
    """Inertia of rotor and gear, of all joints or by joint name [kg m² or kg]; what is left out is that of the robot's
    file."""

    @model_validator(mode="after")
    def _ordered(self) -> Dynamics:
        if self.holding_fraction is not None and self.holding_fraction >= self.braking_fraction:
            raise ValueError(
                f"holding_fraction = {self.holding_fraction:g} must be below braking_fraction = "
                f"{self.braking_fraction:g}, else no torque is left to brake with"
            )
        return self


class Sensing(Block):
    """Treatment of external obstacles that are not updated: those that a program gives in `step`."""

    stale_after: Positive | None = 0.1
    """Age of the last update after which an obstacle's distances shrink by a margin that grows at 0.1 m/s [s], but no
    less than three control periods; `null`: never, it goes on at its last twist."""
    stop_after: Positive | None = 0.5
    """Age of the last update after which the robot stops [s], but no less than three control periods; left out: five
    times `stale_after`; `null`: never."""

    @model_validator(mode="before")
    @classmethod
    def _stop_left_out(cls, fields: Any) -> Any:
        if isinstance(fields, dict) and "stale_after" in fields and "stop_after" not in fields:
            stale = fields["stale_after"]
            if stale is None or (isinstance(stale, int | float) and 0.0 < stale < _LONG):
                return {**fields, "stop_after": None if stale is None else 5.0 * stale}
        return fields

    @model_validator(mode="after")
    def _ordered(self) -> Sensing:
        if self.stop_after is not None and (self.stale_after is None or self.stop_after < self.stale_after):
            raise ValueError("stop_after needs a stale_after that is not longer")
        return self


_LONG = 1e8
"""Longest `stale_after` whose fivefold is still a number that a file may give [s]."""


class Progress(Block):
    """When a task counts as stalled."""

    stalled_after: Positive = 0.5
    """Time without progress after which a task counts as stalled [s]."""


class FastFinish(Block):
    """How targets are approached where the law would come too late: plain velocity dampers, more feedback."""

    gain: Positive = 5.0
    """Least feedback gain K of frames that follow motions [1/s]."""
    row_gain: Positive = 10.0
    """ξ of the rows [1/s]."""


class Planning(Block):
    """Forecast of the law, and other ways to drive its QP where the forecast does not arrive."""

    horizon: Positive = 20.0
    """Longest time that a forecast looks ahead [s]."""
    settle: Positive = 3.0
    """Time after the end of the motions within which their targets are to be reached [s]."""
    deadline: Positive | None = None
    """Time at which they are to be reached at the latest [s]; left out: in a scenario its `duration`, else none."""
    period: Positive = 0.4
    """Time between two forecasts where obstacles move [s]."""
    lead: Positive = 0.3
    """Time after a forecast at which another drive begins [s]; what is not ready by then is dropped."""
    goal_tolerance: Positive = 0.005
    """Error of every frame below which a forecast has arrived [m, rad]."""
    fast: FastFinish | None = FastFinish()
    """Drive that is tried first; `null`: never."""
    clearances: list[NonNegative] = [0.03, 0.015, 0.006, 0.0015]
    """Distances beyond d1 that paths keep, tried in turn [m]; none: nothing is planned."""
    speed: Annotated[float, Field(gt=0, le=1)] = 0.6
    """Share of the joints' speed limits that paths use [-], no more than 1.8 rad/s or m/s."""
    stalled_after: Positive = 0.3
    """Time at rest after which a path is followed no longer [s]."""
    worker: Literal["inline", "process"] = "inline"
    """Where forecasts and plans are computed: `inline`, in the step that asks for them, which takes tenths of a second,
    reproducibly; `process`, in a process of their own, which no step waits for."""
