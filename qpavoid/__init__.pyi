"""Public names: `__init__.py` reads this file, and imports each at its first use."""

from .config import Avoidance, Limits, Progress, ScenarioConfig, Sensing
from .config.loading import load_scenario
from .control.contacts import build_contacts
from .control.pair_distances import PairDistance
from .control.tasks import build_tasks
from .control.tick import Tick
from .controller import Controller
from .dynamics import StepDynamics
from .errors import ConfigError, NumericalError, QpavoidError, SolverNotInstalled, UnknownName
from .model.cloud import Points, Voxels
from .model.kinematics import Kinematics
from .model.notes import Note, NoteKind, RobotWarning
from .model.robot import Robot
from .model.sample import Pose, Sample
from .model.scene import Obstacle, Scene, build_scene
from .planning.path import Path
from .planning.plan_to import make_planner, plan_to
from .planning.planner import Planner, PlannerSettings
from .problem import AvoidanceRows, Contacts, Problem, Proximity, Solution, Status, Tracking
from .reason import Reason, ReasonKind, Severity
from .run.batch import BatchError, Steps, simulate_many, steps
from .run.log import Log
from .run.pool import WorkerDied, Workers
from .run.simulate import simulate
from .solvers import SOLVERS, Solver, make_solver

__all__ = [
    "SOLVERS",
    "Avoidance",
    "AvoidanceRows",
    "BatchError",
    "ConfigError",
    "Contacts",
    "Controller",
    "Kinematics",
    "Limits",
    "Log",
    "Note",
    "NoteKind",
    "NumericalError",
    "Obstacle",
    "PairDistance",
    "Path",
    "Planner",
    "PlannerSettings",
    "Points",
    "Pose",
    "Problem",
    "Progress",
    "Proximity",
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
    "StepDynamics",
    "Steps",
    "Tick",
    "Tracking",
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
