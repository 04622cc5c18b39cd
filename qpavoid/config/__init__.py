"""What a scenario file and a robot file may say: one frozen pydantic model per block, each field with its unit.

Nothing here imports a robot library: a configuration can be read, checked and compared on its own. Files are found
and read by `qpavoid.config.loading`; `qpavoid.model` turns these models into live objects.
"""

from qpavoid.config.base import Block
from qpavoid.config.control import (
    Avoidance,
    Beta,
    Dynamics,
    FastFinish,
    Limits,
    Planning,
    Progress,
    Sensing,
    TaskSwitching,
)
from qpavoid.config.motion import Circle, Csv, Fixed, Line, Motion, Waypoints
from qpavoid.config.observer import Observer
from qpavoid.config.plant import Payload, PlantSettings, Push
from qpavoid.config.robot import Body, Hull, JointLimits, PairMargin, Polytope, RobotConfig
from qpavoid.config.scenario import ObstacleConfig, ScenarioConfig
from qpavoid.config.shapes import (
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Mesh,
    ObstacleShape,
    PointCloud,
    Shape,
    Sphere,
)
from qpavoid.config.solver import (
    Eq10Solver,
    GradientProjectionSolver,
    HqpSolver,
    PotentialFieldSolver,
    QpSolver,
    SolverConfig,
    StepSearchSolver,
    TrackingSolver,
    expand_solver,
)
from qpavoid.config.tasks import (
    AlignTask,
    AnyTask,
    ComTask,
    Contact,
    DampingTask,
    LookAtTask,
    ManipulabilityTask,
    MomentumTask,
    PostureTask,
    RelativeTask,
    Task,
    TaskBlock,
)

__all__ = [
    "AlignTask", "AnyTask", "Avoidance", "Beta", "Block", "Body", "Box", "Capsule", "Circle", "ComTask", "Cone",
    "Contact", "Csv", "Cylinder", "DampingTask", "Dynamics", "Ellipsoid", "Eq10Solver", "FastFinish", "Fixed",
    "GradientProjectionSolver", "HalfSpace", "HqpSolver", "Hull", "JointLimits", "Limits", "Line", "LookAtTask",
    "ManipulabilityTask", "Mesh", "MomentumTask", "Motion", "Observer", "ObstacleConfig", "ObstacleShape", "PairMargin",
    "Payload", "Planning", "PlantSettings", "PointCloud", "Polytope", "PostureTask", "PotentialFieldSolver", "Progress",
    "Push",
    "QpSolver", "RelativeTask", "RobotConfig", "ScenarioConfig", "Sensing", "Shape", "SolverConfig", "Sphere",
    "StepSearchSolver", "Task", "TaskBlock", "TaskSwitching", "TrackingSolver", "Waypoints", "expand_solver",
]  # fmt: skip
