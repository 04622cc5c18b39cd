"""Array work of a tick, as loops that numba compiles at their first use and keeps on disk (`kernels.cache`)."""

from qpavoid.kernels.backup import ROUND_OFF, backup_rows, closes_below, min_sphere_distance, rate_limit
from qpavoid.kernels.bounds import velocity_bounds
from qpavoid.kernels.broadphase import candidates, sorted_setxor
from qpavoid.kernels.cache import first_use
from qpavoid.kernels.clearance import (
    TOLERANCE,
    clearance_lower_bound,
    joint_speeds,
    leaves_position_limits,
    tracking_clear,
)
from qpavoid.kernels.estimates import (
    are_fine,
    count_faults,
    extrapolate_estimates,
    extrapolate_states,
    update_estimates,
    write_states,
)
from qpavoid.kernels.layout import RowLayout
from qpavoid.kernels.obstacles import (
    Pieces,
    Placed,
    check_states,
    place_obstacles,
    sample_pieces,
    update_measured_states,
)
from qpavoid.kernels.packing import pack
from qpavoid.kernels.qp import farthest, minimize, project, project_soft
from qpavoid.kernels.rotation import rotation_vector
from qpavoid.kernels.rows import distance_rows, row_bounds
from qpavoid.kernels.step import assemble, tracking_violation, violation
from qpavoid.kernels.stopping import speed_to_stop
from qpavoid.kernels.stops import easing_stop, stop_velocity, stop_way
from qpavoid.kernels.tasks import damped_solution, frame_rows, projection_cost
from qpavoid.kernels.voxels import select_voxels, within_reach

__all__ = [
    "ROUND_OFF",
    "TOLERANCE",
    "Pieces",
    "Placed",
    "RowLayout",
    "are_fine",
    "assemble",
    "backup_rows",
    "candidates",
    "check_states",
    "clearance_lower_bound",
    "closes_below",
    "count_faults",
    "damped_solution",
    "distance_rows",
    "easing_stop",
    "extrapolate_estimates",
    "extrapolate_states",
    "farthest",
    "first_use",
    "frame_rows",
    "joint_speeds",
    "leaves_position_limits",
    "min_sphere_distance",
    "minimize",
    "pack",
    "place_obstacles",
    "project",
    "project_soft",
    "projection_cost",
    "rate_limit",
    "rotation_vector",
    "row_bounds",
    "sample_pieces",
    "select_voxels",
    "sorted_setxor",
    "speed_to_stop",
    "stop_velocity",
    "stop_way",
    "tracking_clear",
    "tracking_violation",
    "update_estimates",
    "update_measured_states",
    "velocity_bounds",
    "violation",
    "within_reach",
    "write_states",
]
