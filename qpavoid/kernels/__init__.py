"""Array work of a control step: loops that numba compiles at their first use, and stores on disk (`kernels.cache`)."""

from qpavoid.kernels.approach import ApproachArrays, comes_near, extend_paths, write_path_point
from qpavoid.kernels.arguments import take_usual
from qpavoid.kernels.backup import (
    backup_rows,
    closes_below,
)
from qpavoid.kernels.bounds import velocity_bounds
from qpavoid.kernels.braking_bounds import speed_to_stop
from qpavoid.kernels.braking_trajectory import jerk_limited_stop, roll_out_stop, stop_velocity
from qpavoid.kernels.broadphase import candidates, sorted_setxor
from qpavoid.kernels.cache import first_use
from qpavoid.kernels.clearance import (
    TOLERANCE,
    clearance_lower_bound,
    is_clear,
    joint_speeds,
    leaves_position_limits,
)
from qpavoid.kernels.contact_forces import ROWS_PER_POINT, make_orthonormal
from qpavoid.kernels.contact_rows import contact_rows
from qpavoid.kernels.depth import CellGrid, OwnBodies, fill_cells, mark_own_pixels, recall_cells
from qpavoid.kernels.dynamics import (
    DynamicsArrays,
    dynamics_step,
    forward_dynamics,
    inverse_dynamics,
    project_widened,
)
from qpavoid.kernels.dynamics_rows import slow_rows
from qpavoid.kernels.estimates import ObstacleArrays, check_updates, follow_trajectories, observe
from qpavoid.kernels.kinematics import KinematicsArrays, update_kinematics
from qpavoid.kernels.layout import SUMMARY, RowLayout
from qpavoid.kernels.look_ahead import (
    LOOKED,
    LookAhead,
    LookAheadCalls,
    look_along,
    next_pose_time,
    stop_duration,
    write_displacement,
)
from qpavoid.kernels.margins import distances_of, least_margin
from qpavoid.kernels.near_pairs import DistanceArrays, near_pairs, place_bodies, place_obstacles
from qpavoid.kernels.obstacles import Pieces, check_states, sample_pieces
from qpavoid.kernels.orthogonal import solve_rows
from qpavoid.kernels.planning import PlanningArrays, pair_clearances
from qpavoid.kernels.planning_goals import FrameTargets
from qpavoid.kernels.planning_search import search
from qpavoid.kernels.pose_fit import extrapolate_states
from qpavoid.kernels.prediction import Prediction, predict, prediction_error_bound
from qpavoid.kernels.qp import max_clearance_velocity, minimize, project, project_soft
from qpavoid.kernels.ramps import RampLimits, follow_ramp, velocity_towards
from qpavoid.kernels.rollout import (
    RolloutArrays,
    advance_rollout,
    begin_rollout,
    offset_after_step,
    offset_of_start,
    rollout_outcome,
)
from qpavoid.kernels.rotation import rotation_vector
from qpavoid.kernels.rows import alpha, beta, distance_rows, row_bounds
from qpavoid.kernels.standing import standing_step, standing_torques, with_impulses
from qpavoid.kernels.standing_layout import Stance, StandingArrays
from qpavoid.kernels.step import (
    SETTLED,
    TO_MEASURE,
    assemble,
    control_step,
    find_near_pairs,
    tracking_violation,
    violation,
)
from qpavoid.kernels.straying import any_off_course, note_courses, strays, surprise
from qpavoid.kernels.structures import direct, pack
from qpavoid.kernels.task_curvature import add_curvature
from qpavoid.kernels.tasks import frame_rows, projection_cost
from qpavoid.kernels.tracking_law import tracking_law
from qpavoid.kernels.voxels import select_voxels, voxels_within

__all__ = [
    "LOOKED",
    "ROWS_PER_POINT",
    "SETTLED",
    "SUMMARY",
    "TOLERANCE",
    "TO_MEASURE",
    "ApproachArrays",
    "CellGrid",
    "DistanceArrays",
    "DynamicsArrays",
    "FrameTargets",
    "KinematicsArrays",
    "LookAhead",
    "LookAheadCalls",
    "ObstacleArrays",
    "OwnBodies",
    "Pieces",
    "PlanningArrays",
    "Prediction",
    "RampLimits",
    "RolloutArrays",
    "RowLayout",
    "Stance",
    "StandingArrays",
    "add_curvature",
    "advance_rollout",
    "alpha",
    "any_off_course",
    "assemble",
    "backup_rows",
    "begin_rollout",
    "beta",
    "candidates",
    "check_states",
    "check_updates",
    "clearance_lower_bound",
    "closes_below",
    "comes_near",
    "contact_rows",
    "control_step",
    "direct",
    "distance_rows",
    "distances_of",
    "dynamics_step",
    "extend_paths",
    "extrapolate_states",
    "fill_cells",
    "find_near_pairs",
    "first_use",
    "follow_ramp",
    "follow_trajectories",
    "forward_dynamics",
    "frame_rows",
    "inverse_dynamics",
    "is_clear",
    "jerk_limited_stop",
    "joint_speeds",
    "least_margin",
    "leaves_position_limits",
    "look_along",
    "make_orthonormal",
    "mark_own_pixels",
    "max_clearance_velocity",
    "minimize",
    "near_pairs",
    "next_pose_time",
    "note_courses",
    "observe",
    "offset_after_step",
    "offset_of_start",
    "pack",
    "pair_clearances",
    "place_bodies",
    "place_obstacles",
    "predict",
    "prediction_error_bound",
    "project",
    "project_soft",
    "project_widened",
    "projection_cost",
    "recall_cells",
    "roll_out_stop",
    "rollout_outcome",
    "rotation_vector",
    "row_bounds",
    "sample_pieces",
    "search",
    "select_voxels",
    "slow_rows",
    "solve_rows",
    "sorted_setxor",
    "speed_to_stop",
    "standing_step",
    "standing_torques",
    "stop_duration",
    "stop_velocity",
    "strays",
    "surprise",
    "take_usual",
    "tracking_law",
    "tracking_violation",
    "update_kinematics",
    "velocity_bounds",
    "velocity_towards",
    "violation",
    "voxels_within",
    "with_impulses",
    "write_displacement",
    "write_path_point",
]
