"""A robot.yaml: everything that a URDF alone does not say."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Annotated, Literal

from pydantic import Field, model_validator

from qpavoid.config.base import Block, Number, Positive, Vec3
from qpavoid.config.shapes import Shape


class Hull(Block):
    """Convex hull of a piece of the URDF's collision geometry, where it stands in its link; primitives as they are.

    Where the URDF has no collision geometry at all, of what is meant to be seen.
    """

    type: Literal["hull"] = "hull"
    geometry: str
    """Name of the piece: that of its link, with `_0`, `_1`, … in the order of the file."""


class Polytope(Block):
    """Convex hull of some points: a piece of a link that is not convex itself."""

    type: Literal["polytope"] = "polytope"
    corners: Annotated[list[Vec3], Field(min_length=4, max_length=1000)]
    """The points [m]."""


BodyShape = Annotated[Shape | Hull | Polytope, Field(discriminator="type")]


class Body(Block):
    """A collision body given one by one."""

    name: str
    """Name by which pairs, logs and messages know it."""
    frame: str
    """Link or frame of the URDF that it is fixed to."""
    shape: BodyShape
    position: Vec3 = (0.0, 0.0, 0.0)
    """Position of the shape's origin in `frame` [m]."""
    rpy: Vec3 = (0.0, 0.0, 0.0)
    """Orientation of the shape in `frame`: roll, pitch, yaw about its fixed axes [rad]."""


class JointLimits(Block):
    """Limits that replace those of the URDF, by joint name.

    `*` and `?` match as in file names; a name itself comes before a pattern, a later pattern before an earlier one.
    """

    position: dict[str, tuple[Number, Number]] = {}
    """Joint: from lower to upper [rad or m]."""
    velocity: dict[str, Positive | list[Positive]] = {}
    """Joint: largest speed [rad/s or m/s]; a list for a joint of several coordinates, such as `root_joint`."""
    acceleration: dict[str, Positive] = {}
    """Joint: largest acceleration [rad/s² or m/s²]; a URDF has no field for it."""
    jerk: dict[str, Positive] = {}
    """Joint: largest jerk [rad/s³ or m/s³]; needs an acceleration limit of the same joint."""
    torque: dict[str, Positive] = {}
    """Joint: largest torque or force [Nm or N], for scenarios with `dynamics`."""

    @model_validator(mode="after")
    def _ordered(self) -> JointLimits:
        for joint, (lower, upper) in self.position.items():
            if lower >= upper:
                raise ValueError(f"position of {joint!r}: needs lower < upper, got {lower}, {upper}; see `lock`")
        for joint in self.jerk:
            if not any(fnmatchcase(joint, other) or fnmatchcase(other, joint) for other in self.acceleration):
                raise ValueError(f"jerk of {joint!r}: needs a limit under `acceleration`, too")
        return self


class PairMargin(Block):
    """Safety distance of a pair of the robot's own bodies that are near each other by design."""

    bodies: tuple[str, str]
    """Their names, in either order."""
    d1: Positive
    """Safety distance [m], where it is less than that of the scenario."""


class RobotConfig(Block):
    """A robot.yaml: everything that a URDF alone does not say."""

    name: str
    """Name for tables and figures."""
    urdf: str
    """URDF (also in xacro), or MJCF (`.xml`): a path relative to this file, an absolute path, or
    `example-robot-data:PATH` below its robots folder."""
    srdf: str | None = None
    """SRDF whose `disable_collisions` are honoured; found like `urdf`."""
    package_dirs: list[str] = []
    """Folders in which `package://NAME/…` mesh paths are looked up, relative to this file; `NAME=FOLDER` for the folder
    of one package."""
    allow_missing_meshes: bool = False
    """Whether shapes whose mesh cannot be found are left out, with a warning; else the robot is refused."""
    visuals: bool = True
    """Whether links without a collision shape get what is meant to be seen of them, with a warning. A list of bodies
    makes up for both."""
    root_joint: Literal["fixed", "planar", "free_flyer"] = "fixed"
    """How the root link is attached to the world."""
    end_effectors: list[str] = []
    """Frames that are meant as tools; left out, the ends of its limbs."""
    bodies: Literal["convex", "capsule", "mesh"] | list[Body] = "convex"
    """Collision bodies: `convex` hulls of the URDF's collision geometry, one enclosing `capsule` for each piece of
    it, the triangle `mesh` as it is (slow: 100 to 500 µs a pair on average, some several ms, against about 1 µs for
    hulls and 0.1 µs for capsules), or a list of bodies."""
    disabled_pairs: list[tuple[str, str]] = []
    """Pairs of bodies never checked; `*` and `?` match as in file names."""
    pair_margins: list[PairMargin] = []
    """Pairs of bodies with a smaller safety distance of their own."""
    limits: JointLimits = JointLimits()
    home: dict[str, Number] = {}
    """Joint: position of the home pose [rad or m]; joints left out are at 0, or at the middle
    of their range where 0 is outside it."""
    lock: dict[str, Number] = {}
    """Joint: position [rad or m] at which it is fixed for good, as if the joint were not there."""
