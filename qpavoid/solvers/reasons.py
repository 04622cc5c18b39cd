"""What a relaxed solution gave up, in words: pairs, joints and amounts."""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Problem
from qpavoid.solvers.relaxation import TOLERANCE, Relaxed


def what_gave_way(relaxed: Relaxed, problem: Problem) -> tuple[str, ...]:
    """One line for each pair that gave way, the deepest first, each joint in its way, each acceleration passed.

    Args:
        relaxed: the solution.
        problem: what it is a solution of.
    """
    slack, excess = relaxed.slack, relaxed.excess
    rows, lines, in_the_way = problem.avoidance, [], set[str]()
    for i in np.argsort(rows.d, kind="stable").tolist():
        if slack[i] > 2.0 * TOLERANCE:
            short = f", {1e3 * (rows.d1 - rows.d[i]):.1f} mm short of d1" if rows.d[i] < rows.d1 else ""
            names = " - ".join(problem.pair_names[rows.pair[i]])
            lines.append(f"{names}: {1e3 * slack[i]:.1f} mm/s short of its row{short}")
            in_the_way.update(_limits_in_the_way(i, relaxed, problem))
    hurried = [
        f"{problem.joint_names[j]}: {excess[j]:.3f} rad/s or m/s beyond its acceleration limit"
        for j in np.flatnonzero(excess > 2.0 * TOLERANCE).tolist()
    ]
    return (*lines, *hurried, *sorted(in_the_way))


def _limits_in_the_way(row: int, relaxed: Relaxed, problem: Problem) -> list[str]:
    """Joints at a limit of which the row wants more; a bound that is not the speed limit stems from a position."""
    J, v = problem.avoidance.J[row], relaxed.v
    lower, upper = problem.hard_lower, problem.hard_upper
    wanted = np.where(J > 0.0, upper, lower)
    matters = np.abs(J) > 0.05 * np.max(np.abs(J), initial=0.0)
    found = []
    for j in np.flatnonzero((np.abs(v - wanted) <= 2.0 * TOLERANCE) & matters).tolist():
        side = "upper" if J[j] > 0.0 else "lower"
        fastest = max(upper[j], -lower[j])
        what = "its full speed" if abs(wanted[j]) >= fastest else f"its {side} limit"
        found.append(f"{problem.joint_names[j]}: at {what}")
    return found
