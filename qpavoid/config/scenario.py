"""A file of tasks/: one closed-loop run from start to end."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PrivateAttr, model_validator

from qpavoid.config.base import Block, NonNegative, Number, Positive
from qpavoid.config.control import Avoidance, Dynamics, Limits, Planning, Progress, Sensing
from qpavoid.config.motion import Circle, Fixed, Line, Motion
from qpavoid.config.plant import PlantSettings
from qpavoid.config.shapes import HalfSpace, Mesh, ObstacleShape, PointCloud
from qpavoid.config.solver import QpSolver, SolverConfig
from qpavoid.config.tasks import AnyTask, Contact

MAX_SPARE = 100
"""Most obstacles that may come at run time: each of them has pairs with all others."""
MAX_LATENCY = 0.5
"""Longest time after which actuators may follow a command [s]: a longer one is in milliseconds."""
_MAX_STEPS = 1_000_000
"""Control steps of a run, at most: their log takes a gigabyte or two of memory; at 10 ms they are 2.8 hours."""


class ObstacleConfig(Block):
    """A body that the robot must stay clear of."""

    name: str
    """Name by which pairs, logs and messages know it."""
    shape: ObstacleShape
    motion: Motion
    """Where its origin is; what a task could take from its frame must be given here."""
    uncertainty: NonNegative = 0.0
    """How far it may be from where it is said to be [m]: that much is taken off its distances."""
    graspable: bool = False
    """Whether it may be attached to a frame of the robot for a while; costs pairs with the other obstacles."""
    attached_to: str | None = None
    """Frame of the robot that it is attached to from the start, where `motion` puts it at first."""
    source: Literal["scene", "external"] = "scene"
    """Where its pose comes from: `scene`, from `motion`, unless a program gives it in `step`; `external`, from such a
    program from the start, without which the robot stops after `sensing.stop_after`; `motion` is then a `fixed` one,
    where it is taken to be at first."""

    @model_validator(mode="after")
    def _is_graspable(self) -> ObstacleConfig:
        if self.source == "external" and not isinstance(self.motion, Fixed):
            raise ValueError(f"an external obstacle has no motion of type {self.motion.type}; give `type: fixed`")
        whole = not isinstance(self.shape, HalfSpace | PointCloud)
        if isinstance(self.shape, Mesh):
            whole = self.shape.method == "convex"
        if (self.graspable or self.attached_to is not None) and not whole:
            raise ValueError(
                f"a {self.shape.type} cannot be carried; give a primitive, or a mesh with `method: convex`"
            )
        return self


class ScenarioConfig(Block):
    """A file of tasks/: one closed-loop run from start to end."""

    title: str = ""
    """One line for tables and figures."""
    tags: list[str] = []
    """Free labels."""
    robot: str
    """Shipped name, robot.yaml, or URDF; a path is relative to the scenario file."""
    q0: list[Number] | dict[str, Number] = {}
    """Initial configuration [rad or m]: all of q, or by joint name over the home pose."""
    lock: list[str] = []
    """Joints locked at q0 for the whole run; `*` and `?` match as in file names."""
    tasks: Annotated[list[AnyTask], Field(min_length=1)]
    contacts: list[Contact] = []
    """Frames that stay where they are at q0, such as feet; for `qp` and `hqp`."""
    obstacles: list[ObstacleConfig] = []
    spare_obstacles: Annotated[int, Field(ge=0, le=MAX_SPARE)] = 0
    """How many more a program may add by `Controller.add_obstacle`, at the same time [-]."""
    avoidance: Avoidance = Avoidance()
    limits: Limits = Limits()
    sensing: Sensing = Sensing()
    progress: Progress = Progress()
    dynamics: Dynamics | None = None
    """Torque level; left out, or `null`: what is commanded is a velocity."""
    plant: PlantSettings | None = None
    """Robot with torque motors in MuJoCo that the run is played on; left out, or `null`: what is commanded is followed
    exactly."""
    planning: Planning | None = None
    """Forecasts and plans; left out, or `null`: none."""
    solver: SolverConfig = QpSolver()
    """A name (`eq10`, `qp:osqp`) or a mapping with that solver's settings."""
    dt: Annotated[float, Field(gt=0, le=0.1)] = 0.01
    """Control period [s]."""
    latency: Annotated[float, Field(ge=0, le=MAX_LATENCY)] = 0.0
    """Time after which the actuators follow a command [s]: states are predicted by so much."""
    budget: Positive | None = None
    """Time after which a control step leaves out what is left of relaxation, look-ahead and backup search, and brakes
    or follows its backup trajectory instead [s]; runs are then not reproducible. Left out, or `null`: none."""
    duration: Positive
    """Length of the run [s]."""
    goal_tolerance: Positive = 0.005
    """A run has arrived when every task ends this close to its target [m]."""
    thresholds: list[Number] = [0.0]
    """Surface distances [m] for which the time spent below is reported."""
    _source: Path = PrivateAttr(default=Path("scenario"))

    @property
    def source(self) -> Path:
        """The file that it was read from: named in messages, and the folder that relative paths start from."""
        return self._source

    @property
    def planning_in_time(self) -> Planning | None:
        """The block `planning`, with the end of the run as its deadline unless it has one: that is when goals count."""
        if self.planning is None or self.planning.deadline is not None:
            return self.planning
        return self.planning.model_copy(update={"deadline": self.duration})

    def with_source(self, source: Path) -> ScenarioConfig:
        """Return the same scenario, as if it had been read from `source`."""
        copy = self.model_copy()
        copy._source = source
        return copy

    @model_validator(mode="after")
    def _checked(self) -> ScenarioConfig:
        if self.duration / self.dt > _MAX_STEPS:
            steps = f"{self.duration / self.dt:.3g} control steps"
            raise ValueError(f"duration / dt is {steps}; at most {_MAX_STEPS} are run and logged")
        if self.plant is not None and self.dynamics is None:
            raise ValueError("plant: its motors take torques; give `dynamics`, or leave `plant` out")
        for clause, names in (
            ("obstacle", [o.name for o in self.obstacles]),
            ("task", [t.label for t in self.tasks]),
            ("contact frame", [c.frame for c in self.contacts]),
        ):
            twice = sorted({n for n in names if names.count(n) > 1})
            if twice:
                raise ValueError(f"{clause} {twice[0]!r} is given twice: names must differ")
        needed = {Fixed: "position", Line: "start", Circle: "center"}
        for obstacle in self.obstacles:
            field = needed.get(type(obstacle.motion))
            if field is not None and getattr(obstacle.motion, field) is None:
                raise ValueError(f"obstacle {obstacle.name!r}: motion.{field} is missing")
        return self
