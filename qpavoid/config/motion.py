"""Off-line motions of targets and obstacles."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from qpavoid.config.base import Block, NonNegative, Number, Positive, Vec3


class Fixed(Block):
    """A pose that does not change. For a task, what is left out is taken from the frame's pose at the start."""

    type: Literal["fixed"] = "fixed"
    position: Vec3 | None = None
    """World position [m]."""
    rpy: Vec3 | None = None
    """Roll, pitch, yaw about the fixed world axes x, y, z [rad]; left out, a task holds the orientation of the start,
    an obstacle has that of the world."""


class Line(Block):
    """Straight line, then rest at its end."""

    type: Literal["line"] = "line"
    start: Vec3 | None = None
    """World position of the start [m]; a task that leaves it out starts where its frame is."""
    end: Vec3 | None = None
    """World position of the end [m]; give either this or `displacement`."""
    displacement: Vec3 | None = None
    """End minus start, in world axes [m]; give either this or `end`."""
    speed: Positive
    """Mean speed along the line [m/s]."""
    start_time: NonNegative = 0.0
    """Time at which the motion begins [s]; it rests at the start until then."""
    profile: Literal["constant", "smooth"] = "constant"
    """`constant` speed, or `smooth`: the rest-to-rest quintic (peak speed 1.875 times the mean)."""
    rpy: Vec3 | None = None
    """Constant orientation: roll, pitch, yaw about the fixed world axes [rad]; left out, as of `fixed`."""

    @model_validator(mode="after")
    def _one_end(self) -> Line:
        if (self.end is None) == (self.displacement is None):
            raise ValueError("give exactly one of `end` and `displacement`")
        return self


class Waypoints(Block):
    """Piecewise motion through timed positions (and orientations); rests before the first and after the last."""

    type: Literal["waypoints"] = "waypoints"
    times: Annotated[list[Number], Field(min_length=2)]
    """Times of the waypoints [s], increasing."""
    positions: Annotated[list[Vec3], Field(min_length=2)]
    """World positions [m], one a time."""
    rpys: list[Vec3] | None = None
    """Orientations as roll, pitch, yaw about the fixed world axes [rad], one a time; the shortest turn between.
    Left out, as of `fixed`."""
    profile: Literal["constant", "smooth"] = "constant"
    """How each piece is timed: `constant` speed, or `smooth` (rest-to-rest quintic)."""

    @model_validator(mode="after")
    def _lengths(self) -> Waypoints:
        if len(self.positions) != len(self.times):
            raise ValueError(f"{len(self.times)} times but {len(self.positions)} positions: give one of each")
        if self.rpys is not None and len(self.rpys) != len(self.times):
            raise ValueError(f"{len(self.times)} times but {len(self.rpys)} rpys: give one of each")
        if any(b <= a for a, b in zip(self.times, self.times[1:], strict=False)):
            raise ValueError("times must increase from one waypoint to the next")
        return self


class Circle(Block):
    """Circle at constant speed, for ever or for a number of turns."""

    type: Literal["circle"] = "circle"
    center: Vec3 | None = None
    """World position of the centre [m]; a task that leaves it out starts on the circle, where its frame is."""
    radius: Positive
    """Radius [m]."""
    normal: Vec3 = (0.0, 0.0, 1.0)
    """Axis of the turn, in world axes [-]; the motion is counter-clockwise about it."""
    start_direction: Vec3 = (1.0, 0.0, 0.0)
    """Direction from the centre to the start, in world axes [-]; only its part in the circle's plane counts."""
    period: Positive
    """Time of one turn [s]."""
    turns: Positive | None = None
    """Number of turns after which it rests [-]; left out, it goes on."""
    rpy: Vec3 | None = None
    """Constant orientation: roll, pitch, yaw about the fixed world axes [rad]; left out, as of `fixed`."""


class Csv(Block):
    """Time-stamped poses from a CSV file with the header `t,x,y,z` or `t,x,y,z,qx,qy,qz,qw`.

    Times in s and increasing, positions in m and quaternions in world axes; linear and shortest turn between.
    """

    type: Literal["csv"] = "csv"
    path: str
    """The file, relative to the scenario file."""


Motion = Annotated[Fixed | Line | Waypoints | Circle | Csv, Field(discriminator="type")]
