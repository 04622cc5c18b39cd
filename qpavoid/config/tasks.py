"""Tasks of a robot, and frames that stay in contact with the ground.

Every task is rows A v = b with a `weight`, for solvers that weigh tasks against each other (`qp`), and a `priority`,
for those that keep strict order (`hqp`).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from qpavoid.config.base import Block, NonNegative, Number, Positive, Vec3
from qpavoid.config.motion import Fixed, Motion

Priority = Annotated[int, Field(ge=1, le=100)]


class TaskBlock(Block):
    """What all tasks share."""

    name: str | None = None
    """Name by which targets, logs and messages know it; left out: that of its frame, or its type."""
    weight: Positive = 1.0
    """Cost of the rows [their unit⁻²]; of a frame that follows a motion, of its position rows."""
    priority: Priority = 1
    """Level of `hqp` [-], 1 before 2: a later level moves only what the earlier ones leave free. Others: no effect."""

    @property
    def label(self) -> str:
        """Its name, given or taken: of a frame that follows a motion that of the frame, else the type."""
        return self.name or str(getattr(self, "frame" if isinstance(self, Task) else "type"))


class Task(TaskBlock):
    """One frame that follows a motion: v_frame = v_ref(t) + gain (x_ref(t) - x)."""

    frame: str
    """Frame of the robot that is to follow."""
    type: Literal["position", "pose", "orientation"] = "position"
    """`position`: 3 rows; `pose`: position and orientation, 6 rows; `orientation`: 3 rows."""
    motion: Motion = Fixed()
    """What it follows; left out, it stays where it is at the start."""
    gain: NonNegative = 2.0
    """Feedback gain K [1/s]."""
    orientation_weight: Positive = 1.0
    """Cost of the orientation rows [(rad/s)⁻²]."""
    max_speed: Positive | None = None
    """Cap on the commanded linear speed [m/s]; left out: no cap."""
    max_turn_rate: Positive | None = None
    """Cap on the commanded angular speed [rad/s]; left out: no cap."""


class RelativeTask(TaskBlock):
    """One frame that follows a motion seen from another frame: two hands on one object."""

    type: Literal["relative"] = "relative"
    frame: str
    """Frame that is to follow."""
    relative_to: str
    """Frame from which it is seen; both move."""
    rows: Literal["position", "orientation", "pose"] = "pose"
    """What of it counts."""
    motion: Motion = Fixed()
    """Where `frame` is in the axes of `relative_to`; left out, it stays as it is at the start."""
    gain: NonNegative = 2.0
    """Feedback gain K [1/s]."""
    orientation_weight: Positive = 1.0
    """Cost of the orientation rows [(rad/s)⁻²]."""


class ComTask(TaskBlock):
    """The centre of mass of the whole robot follows a motion."""

    type: Literal["com"] = "com"
    motion: Motion = Fixed()
    """What it follows, world; left out, it stays where it is at the start."""
    axes: Literal["xy", "xyz"] = "xyz"
    """Which coordinates count: `xy` keeps it over the feet."""
    gain: NonNegative = 2.0
    """Feedback gain K [1/s]."""


class MomentumTask(TaskBlock):
    """The angular momentum of the whole robot about its centre of mass: arms swing against legs."""

    type: Literal["momentum"] = "momentum"
    angular: Vec3 = (0.0, 0.0, 0.0)
    """What it is to be, world [kg m²/s]; with `dynamics`, it is approached at `tracking_rate`."""


class PostureTask(TaskBlock):
    """Joints go to a posture: v = gain (q_ref ⊖ q)."""

    type: Literal["posture"] = "posture"
    joints: list[str] = ["*"]
    """Which joints; `*` and `?` match as in file names. A floating or planar base counts only if it is named."""
    q: dict[str, Number] = {}
    """Joint: position [rad or m]; those left out go to where they are at the start."""
    gain: NonNegative = 1.0
    """Feedback gain K [1/s]."""


class DampingTask(TaskBlock):
    """Joints rest: v = 0. With a small weight, or as the last priority, it keeps what is free from drifting."""

    type: Literal["damping"] = "damping"
    joints: list[str] = ["*"]
    """Which joints; `*` and `?` match as in file names. A floating or planar base counts, too."""


class LookAtTask(TaskBlock):
    """An axis of a frame points at a moving point; the turn about it is free."""

    type: Literal["look_at"] = "look_at"
    frame: str
    """Frame that carries the axis, such as a camera's."""
    axis: Vec3 = (0.0, 0.0, 1.0)
    """The axis in the frame [-]; of a camera, z."""
    motion: Motion
    """Where the point is, world."""
    gain: NonNegative = 2.0
    """Feedback gain K [1/s]."""


class AlignTask(TaskBlock):
    """An axis of a frame points in a direction of the world: a cup that stays upright, a drill across a wall."""

    type: Literal["align"] = "align"
    frame: str
    """Frame that carries the axis."""
    axis: Vec3 = (0.0, 0.0, 1.0)
    """The axis in the frame [-]."""
    direction: Vec3
    """Where it is to point, world [-]."""
    gain: NonNegative = 2.0
    """Feedback gain K [1/s]."""


class ManipulabilityTask(TaskBlock):
    """A frame keeps away from singularities: ascent of Yoshikawa's measure w = √det(J Jᵀ)."""

    type: Literal["manipulability"] = "manipulability"
    frame: str
    """Frame of the Jacobian J."""
    rows: Literal["position", "orientation", "pose"] = "position"
    """Which of its rows count in J."""
    gain: NonNegative = 1.0
    """Rate of ascent: v = gain ∇w along the gradient, free across it [1/s]."""


def _position_unless_said(value: Any) -> Any:
    return {"type": "position", **value} if isinstance(value, dict) and "type" not in value else value


AnyTask = Annotated[
    Annotated[
        Task
        | RelativeTask
        | ComTask
        | MomentumTask
        | PostureTask
        | DampingTask
        | LookAtTask
        | AlignTask
        | ManipulabilityTask,
        Field(discriminator="type"),
    ],
    BeforeValidator(_position_unless_said),
]
"""A block of `tasks:`; without a `type`, it is a position."""


class Contact(Block):
    """A frame that stays where it is, with priority over all tasks: a foot on the ground."""

    frame: str
    """Frame that rests."""
    type: Literal["surface", "point"] = "surface"
    """`surface`: neither slides nor turns, 6 rows; `point`: may turn, 3 rows."""
    gain: NonNegative = 10.0
    """Feedback on what it has slid all the same [1/s]."""
    vertices: list[Vec3] = []
    """With `dynamics`: corners of a surface in the frame, where forces act [m]; of a point, its place, at first the
    frame's origin."""
    normal: Vec3 = (0.0, 0.0, 1.0)
    """With `dynamics`: direction in the frame in which the ground pushes [-]."""
    friction: Positive = 0.5
    """With `dynamics`: friction coefficient μ on which forces count [-]."""
    force: tuple[NonNegative, Positive] = (2.0, 1000.0)
    """With `dynamics`: least and largest normal force of each corner [N]."""
    rate: Positive = 60.0
    """With `dynamics`: rate at which a frame that moves is brought to rest [1/s]."""
