"""What a scenario file and a robot file may say: one frozen pydantic model per block, each field with its unit.

Nothing here imports a robot library: a configuration can be read, checked and compared on its own. Files are found
and read by `qpavoid.loading`; `qpavoid.scene` and `qpavoid.motion` turn these models into live objects.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PrivateAttr, model_validator

Vec3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


class Block(BaseModel):
    """Base of every block: unknown keys, NaN and infinity are errors, and a block never changes once read."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


# --- shapes -------------------------------------------------------------------------------------------------


class Sphere(Block):
    """Ball about the origin."""

    type: Literal["sphere"]
    radius: Positive
    """Radius [m]."""


class Capsule(Block):
    """Segment along z, centred on the origin, swept by a ball."""

    type: Literal["capsule"]
    radius: Positive
    """Radius [m]."""
    length: Positive
    """Length of the axis between the centres of the two caps [m]."""


class Box(Block):
    """Cuboid centred on the origin."""

    type: Literal["box"]
    size: tuple[Positive, Positive, Positive]
    """Full side lengths along x, y, z [m]."""


class Cylinder(Block):
    """Cylinder along z, centred on the origin."""

    type: Literal["cylinder"]
    radius: Positive
    """Radius [m]."""
    length: Positive
    """Height along z [m]."""


Shape = Annotated[Sphere | Capsule | Box | Cylinder, Field(discriminator="type")]


# --- motions of targets and obstacles ------------------------------------------------------------------------


class Fixed(Block):
    """A pose that does not change. For a task, what is left out is taken from the frame's pose at the start."""

    type: Literal["fixed"]
    position: Vec3 | None = None
    """World position [m]."""
    rpy: Vec3 | None = None
    """Roll, pitch, yaw about the fixed world axes x, y, z [rad]."""


class Line(Block):
    """Straight line, then rest at its end."""

    type: Literal["line"]
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
    """Constant orientation: roll, pitch, yaw about the fixed world axes [rad]."""

    @model_validator(mode="after")
    def _one_end(self) -> Line:
        if (self.end is None) == (self.displacement is None):
            raise ValueError("give exactly one of `end` and `displacement`")
        return self


class Waypoints(Block):
    """Piecewise motion through timed positions (and orientations); rests before the first and after the last."""

    type: Literal["waypoints"]
    times: Annotated[list[float], Field(min_length=2)]
    """Times of the waypoints [s], increasing."""
    positions: Annotated[list[Vec3], Field(min_length=2)]
    """World positions [m], one a time."""
    rpys: list[Vec3] | None = None
    """Orientations as roll, pitch, yaw about the fixed world axes [rad], one a time; the shortest turn between."""
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

    type: Literal["circle"]
    center: Vec3 | None = None
    """World position of the centre [m]; a task that leaves it out starts on the circle, where its frame is."""
    radius: Positive
    """Radius [m]."""
    normal: Vec3 = (0.0, 0.0, 1.0)
    """Axis of the turn, in world axes; the motion is counter-clockwise about it."""
    start_direction: Vec3 = (1.0, 0.0, 0.0)
    """Direction from the centre to the start, in world axes; only its part in the circle's plane counts."""
    period: Positive
    """Time of one turn [s]."""
    turns: Positive | None = None
    """Number of turns after which it rests; left out, it goes on."""
    rpy: Vec3 | None = None
    """Constant orientation: roll, pitch, yaw about the fixed world axes [rad]."""


class Csv(Block):
    """Time-stamped poses from a CSV file with the header `t,x,y,z` or `t,x,y,z,qx,qy,qz,qw`.

    Times in s and increasing, positions in m and quaternions in world axes; linear and shortest turn between.
    """

    type: Literal["csv"]
    path: str
    """The file, relative to the scenario file."""


Motion = Annotated[Fixed | Line | Waypoints | Circle | Csv, Field(discriminator="type")]


# --- robots -------------------------------------------------------------------------------------------------


class Body(Block):
    """A collision body given by hand."""

    name: str
    """Name by which pairs, logs and messages know it."""
    frame: str
    """Link or frame of the URDF that carries it."""
    shape: Shape
    position: Vec3 = (0.0, 0.0, 0.0)
    """Position of the shape's origin in `frame` [m]."""
    rpy: Vec3 = (0.0, 0.0, 0.0)
    """Orientation of the shape in `frame`: roll, pitch, yaw about its fixed axes [rad]."""


class JointLimits(Block):
    """Limits that replace those of the URDF, by joint name."""

    position: dict[str, tuple[float, float]] = {}
    """Joint: [lower, upper] [rad or m]."""
    velocity: dict[str, Positive] = {}
    """Joint: largest speed [rad/s or m/s]."""

    @model_validator(mode="after")
    def _ordered(self) -> JointLimits:
        for joint, (lower, upper) in self.position.items():
            if lower > upper:
                raise ValueError(f"position of {joint!r}: lower limit {lower} lies above upper limit {upper}")
        return self


class RobotConfig(Block):
    """A robot.yaml: everything that a URDF alone does not say."""

    name: str
    """Name for tables and figures."""
    urdf: str
    """URDF: a path relative to this file, an absolute path, or `example-robot-data:PATH` below its robots folder."""
    srdf: str | None = None
    """SRDF whose `disable_collisions` are honoured; found like `urdf`."""
    package_dirs: list[str] = []
    """Folders in which `package://NAME/…` mesh paths are looked up, relative to this file."""
    root_joint: Literal["fixed", "planar", "free_flyer"] = "fixed"
    """How the root link is attached to the world."""
    end_effectors: list[str] = []
    """Frames that are meant as tools."""
    bodies: Literal["convex", "capsule", "mesh"] | list[Body] = "convex"
    """Collision bodies: `convex` hulls of the URDF's collision geometry, one enclosing `capsule` for each piece of
    it, the triangle `mesh` as it is (slow: 50 to 200 µs a pair), or a list of bodies."""
    disabled_pairs: list[tuple[str, str]] = []
    """Pairs of bodies never checked; `*` and `?` match as in file names."""
    limits: JointLimits = JointLimits()
    home: dict[str, float] = {}
    """Joint: position of the home pose [rad or m]; joints left out are at 0, or at the middle
    of their range where 0 is outside it."""
    lock: dict[str, float] = {}
    """Joint: position [rad or m] at which it is fixed for good, as if the joint were not there."""


# --- control ------------------------------------------------------------------------------------------------


class Task(Block):
    """One frame that follows a motion: v_frame = v_ref(t) + gain (x_ref(t) - x)."""

    frame: str
    """Frame of the robot that is to follow."""
    type: Literal["position", "pose"] = "position"
    """`position`: 3 rows; `pose`: position and orientation, 6 rows."""
    motion: Motion
    gain: NonNegative = 2.0
    """Feedback gain K [1/s]."""
    weight: Positive = 1.0
    """Cost of the position rows [(m/s)⁻²]."""
    orientation_weight: Positive = 1.0
    """Cost of the orientation rows [(rad/s)⁻²]."""
    max_speed: Positive | None = None
    """Cap on the commanded linear speed [m/s]; left out: no cap."""
    max_turn_rate: Positive | None = None
    """Cap on the commanded angular speed [rad/s]; left out: no cap."""


class Switching(Block):
    """Row of the task-switching QP: ḋ >= -(1 - β(d)) ξ (d - d1); below d1 it backs away."""

    type: Literal["switching"]
    gain: Positive = 5.0
    """ξ [1/s]."""


class Damper(Block):
    """Velocity damper: ḋ >= -ξ (d - d_safe); below d_safe it backs away, at most at `recovery_speed`."""

    type: Literal["damper"]
    gain: Positive = 5.0
    """ξ [1/s]."""
    d_safe: Positive | None = None
    """Distance that is held [m], measured as d1 is; left out: d1."""


class Cbf(Block):
    """Control barrier function h = d - d_safe with linear class-K gain: ḋ >= -γ h, recovery speed not capped."""

    type: Literal["cbf"]
    gain: Positive = 5.0
    """γ [1/s]."""
    d_safe: Positive | None = None
    """Distance that is held [m], measured as d1 is; left out: d1."""


AvoidanceRow = Annotated[Switching | Damper | Cbf, Field(discriminator="type")]


class Avoidance(Block):
    """When and how the robot keeps clear."""

    d1: float = 0.03
    """Distance below which avoiding has taken over entirely (eq. 12) [m]."""
    d2: float = 0.10
    """Influence distance: farther pairs are ignored (eqs. 11, 12) [m]."""
    offset: NonNegative = 0.0
    """Added to the distance between surfaces before d1, d2 and d_safe are compared with it [m]. The paper measures
    between axes: its figures want the sum of the two radii here."""
    row: AvoidanceRow = Switching(type="switching")
    """Form of the QP's avoidance rows."""
    recovery_speed: Positive = 0.2
    """Cap on the speed at which rows ask a pair that is too close to part [m/s]."""

    @model_validator(mode="after")
    def _ordered(self) -> Avoidance:
        if not 0 < self.d1 < self.d2:
            raise ValueError(f"needs 0 < d1 < d2, got d1 = {self.d1}, d2 = {self.d2}")
        if self.d1 <= self.offset:
            raise ValueError(f"d1 = {self.d1} must exceed offset = {self.offset}, else it lies inside the bodies")
        d_safe = getattr(self.row, "d_safe", None)
        if d_safe is not None and not self.offset <= d_safe < self.d2:
            raise ValueError(f"needs offset <= row.d_safe < d2, got {self.offset}, {d_safe}, {self.d2}")
        return self


class Limits(Block):
    """Joint limits as bounds on the velocity."""

    position_gain: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Share of the range left to a position limit that one tick may use [-]."""
    velocity_scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of the velocity limits that may be used [-]."""
    saturate: bool = True
    """Whether the laws that know no limits (all but the QP) are scaled and clipped to them afterwards."""


# --- solvers ------------------------------------------------------------------------------------------------


class TrackingSolver(Block):
    """Damped least squares on the tracking task; does not avoid."""

    name: Literal["tracking"]

    @property
    def label(self) -> str:
        """Short form that names it."""
        return self.name


class Eq10Solver(Block):
    """Eq. 10: `eq10` with the consistent bracket and α while approaching only, `eq10-literal` as printed."""

    name: Literal["eq10", "eq10-literal"]
    damping: NonNegative = 0.05
    """λ of the damped (J_d N)⁺ [-]."""
    retreat_speed: NonNegative = 0.1
    """ẋ0: speed of backing away along the shortest distance [m/s]."""
    alpha_cap: Positive = 1e6
    """Largest α; eq. 11 grows without bound as d goes to 0 [-]."""

    @property
    def label(self) -> str:
        """Short form that names it."""
        return self.name


class QpSolver(Block):
    """QP: tracking as cost, avoidance rows as inequalities, joint limits as bounds."""

    name: Literal["qp"]
    backend: str = "daqp"
    """`daqp`, `proxqp`, `osqp`, `quadprog`, or whatever else qpsolvers finds installed."""
    regularization: Positive = 1e-3
    """λ: cost of leaving the tracking law's velocity [(rad/s)⁻²]."""

    @property
    def label(self) -> str:
        """Short form that names it."""
        return self.name if self.backend == "daqp" else f"{self.name}:{self.backend}"


def expand_solver(value: Any) -> Any:
    """`qp:proxqp` -> {name: qp, backend: proxqp}; `eq10` -> {name: eq10}."""
    if not isinstance(value, str):
        return value
    name, _, backend = value.partition(":")
    return {"name": name, "backend": backend} if backend else {"name": name}


SolverConfig = Annotated[
    Annotated[TrackingSolver | Eq10Solver | QpSolver, Field(discriminator="name")], BeforeValidator(expand_solver)
]


# --- scenario -----------------------------------------------------------------------------------------------


class Obstacle(Block):
    """A body that the robot must stay clear of."""

    name: str
    shape: Shape
    motion: Motion
    """Where its origin is; what a task could take from its frame must be given here."""


class ScenarioConfig(Block):
    """A file of tasks/: one closed-loop run from start to end."""

    title: str = ""
    """One line for tables and figures."""
    tags: list[str] = []
    """Free labels."""
    robot: str
    """Shipped name, robot.yaml, or URDF; a path is relative to the scenario file."""
    q0: list[float] | dict[str, float] = {}
    """Initial configuration [rad or m]: all of q, or by joint name over the home pose."""
    lock: list[str] = []
    """Joints held at q0 for the whole run; `*` and `?` match as in file names."""
    tasks: Annotated[list[Task], Field(min_length=1)]
    obstacles: list[Obstacle] = []
    tracking_damping: NonNegative = 0.01
    """λ of the damped J⁺ of the tracking task, the same for every solver [-]; 0 gives the plain pseudo-inverse."""
    avoidance: Avoidance = Avoidance()
    limits: Limits = Limits()
    solver: SolverConfig = QpSolver(name="qp")
    """A name (`eq10`, `qp:osqp`) or a mapping with that solver's settings."""
    dt: Annotated[float, Field(gt=0, le=0.1)] = 0.01
    """Control period [s]."""
    duration: Positive
    """Length of the run [s]."""
    goal_tolerance: Positive = 0.005
    """A run has arrived when every task ends this close to its target [m]."""
    thresholds: list[float] = [0.0]
    """Surface distances [m] for which the time spent below is reported."""
    _source: Path = PrivateAttr(default=Path("scenario"))

    @property
    def source(self) -> Path:
        """The file that it was read from: named in messages, and the folder that relative paths start from."""
        return self._source

    def read_from(self, source: Path) -> ScenarioConfig:
        """The same scenario, as if it had been read from `source`."""
        copy = self.model_copy()
        copy._source = source
        return copy

    @model_validator(mode="after")
    def _unique(self) -> ScenarioConfig:
        for what, names in (
            ("obstacle", [o.name for o in self.obstacles]),
            ("task frame", [t.frame for t in self.tasks]),
        ):
            twice = sorted({n for n in names if names.count(n) > 1})
            if twice:
                raise ValueError(f"{what} {twice[0]!r} is given twice: names must differ")
        for obstacle in self.obstacles:
            if isinstance(obstacle.motion, Fixed) and obstacle.motion.position is None:
                raise ValueError(f"obstacle {obstacle.name!r}: motion.position is missing")
            if isinstance(obstacle.motion, Line) and obstacle.motion.start is None:
                raise ValueError(f"obstacle {obstacle.name!r}: motion.start is missing")
            if isinstance(obstacle.motion, Circle) and obstacle.motion.center is None:
                raise ValueError(f"obstacle {obstacle.name!r}: motion.center is missing")
        return self
