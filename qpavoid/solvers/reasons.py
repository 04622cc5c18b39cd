"""What a relaxed solution gave up, in words: pairs, joints and amounts."""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, Problem
from qpavoid.solvers.relaxation import TOLERANCE, Relaxed


def what_gave_way(relaxed: Relaxed, problem: Problem) -> tuple[str, ...]:
    """One line for each pair that gave way, the deepest first, each joint in its way, each acceleration or jerk passed.

    Args:
        relaxed: the solution.
        problem: what it is a solution of.
    """
    slack, excess = relaxed.slack, relaxed.excess
    rows, names = problem.avoidance, problem.joint_names
    gave = np.flatnonzero(slack > 2.0 * TOLERANCE)
    gave = gave[np.argsort(rows.d[gave], kind="stable")]
    lines = []
    for pair, lack, d in zip(rows.pair[gave].tolist(), slack[gave].tolist(), rows.d[gave].tolist(), strict=True):
        short = f", {1e3 * (rows.d1 - d):.1f} mm short of d1" if d < rows.d1 else ""
        lines.append(f"{' - '.join(problem.pair_names[pair])}: {1e3 * lack:.1f} mm/s short of its row{short}")
    limit = "acceleration and jerk limits" if problem.jerked else "acceleration limit"
    hurried = [
        f"{names[j]}: {excess[j]:.3f} rad/s or m/s beyond its {limit}"
        for j in np.flatnonzero(excess > 2.0 * TOLERANCE).tolist()
    ]
    return (*lines, *hurried, *sorted(_limits_in_the_way(rows.J[gave], relaxed.v, problem)))


def _limits_in_the_way(J: Array, v: Array, problem: Problem) -> list[str]:
    """Joints at a limit of which the rows J (k, nv) want more; what is not the speed limit stems from a position."""
    lower, upper, found = problem.hard_lower, problem.hard_upper, []
    matters = np.abs(J) > 0.05 * np.max(np.abs(J), axis=1, initial=0.0)[:, None]
    fastest = np.maximum(upper, -lower)
    for side, limit, wanted in (("upper", upper, J > 0.0), ("lower", lower, J < 0.0)):
        at = (np.abs(v - limit) <= 1e-5) & (matters & wanted).any(axis=0)
        for j in np.flatnonzero(at).tolist():
            what = "its full speed" if abs(limit[j]) >= fastest[j] else f"its {side} limit"
            found.append(f"{problem.joint_names[j]}: at {what}")
    return found
