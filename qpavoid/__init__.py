"""qpavoid: follow a planned motion and stay clear of obstacles, other arms and yourself."""

from qpavoid.config import Avoidance, Limits, Progress, ScenarioConfig, Sensing
from qpavoid.config.loading import load_scenario
from qpavoid.control.contacts import build_contacts
from qpavoid.control.pair_distances import PairDistance
from qpavoid.control.tasks import build_tasks
from qpavoid.control.tick import Tick
from qpavoid.controller import Controller
from qpavoid.dynamics import StepDynamics
from qpavoid.errors import ConfigError, NumericalError, QpavoidError, SolverNotInstalled, UnknownName
from qpavoid.field_docs import document_fields
from qpavoid.model.cloud import Points, Voxels
from qpavoid.model.kinematics import Kinematics
from qpavoid.model.notes import Note, NoteKind, RobotWarning
from qpavoid.model.robot import Robot
from qpavoid.model.sample import Pose, Sample
from qpavoid.model.scene import Obstacle, Scene, build_scene
from qpavoid.planning.path import Path
from qpavoid.planning.plan_to import make_planner, plan_to
from qpavoid.planning.planner import Planner, PlannerSettings
from qpavoid.problem import AvoidanceRows, Contacts, Problem, Proximity, Solution, Status, Tracking
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
    "PairDistance",
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

document_fields(
    *(AvoidanceRows, Contacts, Kinematics, PairDistance, Points, Problem, Proximity, Reason, Solution, StepDynamics),
    *(Steps, Tick, Tracking),
)
