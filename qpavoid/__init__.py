"""qpavoid: follow a planned motion and stay clear of obstacles, other arms and yourself."""

from qpavoid.config import Avoidance, Limits, Progress, ScenarioConfig, Sensing
from qpavoid.config.loading import load_scenario
from qpavoid.control.contacts import build_contacts
from qpavoid.control.tasks import build_tasks
from qpavoid.control.tick import Tick
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError, NumericalError, QpavoidError, SolverNotInstalled, UnknownName
from qpavoid.model.cloud import Points, Voxels
from qpavoid.model.notes import Note, NoteKind, RobotWarning
from qpavoid.model.robot import Robot
from qpavoid.model.sample import Pose, Sample
from qpavoid.model.scene import Obstacle, Scene, build_scene
from qpavoid.planning.path import Path
from qpavoid.planning.plan_to import make_planner, plan_to
from qpavoid.planning.planner import Planner, PlannerSettings
from qpavoid.problem import Problem, Solution, Status
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.run.batch import BatchError, Steps, simulate_many, steps
from qpavoid.run.log import Log
from qpavoid.run.pool import WorkerDied, Workers
from qpavoid.run.simulate import simulate
from qpavoid.solvers import SOLVERS, Solver, make_solver

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
    "Path",
    "Planner",
    "PlannerSettings",
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
    "make_planner",
    "make_solver",
    "plan_to",
    "simulate",
    "simulate_many",
    "steps",
]
