"""What a scenario file and a robot file may say: one frozen pydantic model per block, each field with its unit.

Nothing here imports a robot library: a configuration can be read, checked and compared on its own. Files are found
and read by `qpavoid.loading`; `qpavoid.scene` and `qpavoid.motion` turn these models into live objects.
"""

from qpavoid.config.base import Block
from qpavoid.config.control import Avoidance, Cbf, Damper, Detour, Limits, Progress, Sensing, Switching, Task
from qpavoid.config.motion import Circle, Csv, Fixed, Line, Motion, Waypoints
from qpavoid.config.robot import Body, Hull, JointLimits, RobotConfig
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
from qpavoid.config.solver import Eq10Solver, QpSolver, SolverConfig, TrackingSolver, expand_solver

__all__ = [
    "Avoidance", "Block", "Body", "Box", "Capsule", "Cbf", "Circle", "Cone", "Csv", "Cylinder", "Damper", "Detour",
    "Ellipsoid", "Eq10Solver", "Fixed", "HalfSpace", "Hull", "JointLimits", "Limits", "Line", "Mesh", "Motion",
    "ObstacleConfig", "ObstacleShape", "PointCloud", "Progress", "QpSolver", "RobotConfig", "ScenarioConfig",
    "Sensing", "Shape", "SolverConfig", "Sphere", "Switching", "Task", "TrackingSolver", "Waypoints", "expand_solver",
]  # fmt: skip
