"""qpavoid: follow a planned motion and stay clear of obstacles, other arms and yourself."""

from qpavoid.batch import BatchError, Steps, WorkerDied, Workers, simulate_many, steps
from qpavoid.config import Avoidance, Limits, Progress, ScenarioConfig, Sensing
from qpavoid.contacts import build_contacts
from qpavoid.controller import Controller, Tick
from qpavoid.errors import ConfigError, NumericalError, QpavoidError, SolverNotInstalled, UnknownName
from qpavoid.files.loading import load_scenario
from qpavoid.geometry.cloud import Points, Voxels
from qpavoid.log import Log
from qpavoid.motion import Sample
from qpavoid.notes import Note, NoteKind, RobotWarning
from qpavoid.obstacles.sensing import Pose
from qpavoid.problem import Problem, Solution, Status
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.robot import Robot
from qpavoid.scene import Obstacle, Scene, build_scene
from qpavoid.simulate import simulate
from qpavoid.solvers import SOLVERS, Solver, make_solver
from qpavoid.tasks import build_tasks

__all__ = [
    "SOLVERS",
    "Avoidance",
    "BatchError",
    "ConfigError",
    "Controller",
    "Limits",
    "Log",
    "Note",
    "NoteKind",
    "NumericalError",
    "Obstacle",
    "Points",
    "Pose",
    "Problem",
    "Progress",
    "QpavoidError",
    "Reason",
    "ReasonKind",
    "Robot",
    "RobotWarning",
    "Sample",
    "ScenarioConfig",
    "Scene",
    "Sensing",
    "Severity",
    "Solution",
    "Solver",
    "SolverNotInstalled",
    "Status",
    "Steps",
    "Tick",
    "UnknownName",
    "Voxels",
    "WorkerDied",
    "Workers",
    "build_contacts",
    "build_scene",
    "build_tasks",
    "load_scenario",
    "make_solver",
    "simulate",
    "simulate_many",
    "steps",
]
