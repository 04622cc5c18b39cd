"""Step-wise search: of a bounded set of next joint steps, the collision-free one with the least error and motion."""

from __future__ import annotations

from functools import cache
from itertools import combinations, product
from math import comb

import numpy as np

from qpavoid.problem import Array, Problem, Solution
from qpavoid.solvers.solver import NamedSolver

LENGTHS = (1.0, 0.25, 0.0625)
"""Lengths of the steps that are tried, as shares of the longest one [-]."""
_ROUND_OFF = 1e-9
"""Violation of a row that counts as none [m/s]: the tracking velocity meets its own rows to rounding."""


class StepSearch(NamedSolver):
    """Search among the neighbours in a grid of joint steps, one step ahead: Latombe 1991, "Robot Motion Planning",
    chapter 7; Barraquand and Latombe 1991, "Robot motion planning: a distributed representation approach", IJRR 10(6).

    Candidates are the tracking velocity J⁺ẋ, and the steps that move at most p joints, each by ±δ, for three lengths δ:
    `speed`, a quarter and a sixteenth of it. All are clipped to the bounds of the step. p is the largest one whose
    neighbourhood leaves no more than `candidates` in all: of all 3ⁿ steps of a seven-joint arm, those of up to three
    joints; of 14 joints, two. Collision-free are those that keep every avoidance row, d_i to first order with the
    obstacles' own motion. Of these, the step is taken that minimises

        ‖A v - ẋ‖² + μ ‖v‖²,  ẋ scaled to what the speeds of the joints allow,

    and without any, the one that violates the rows least. Where no pair is in range and the bounds allow it, that is
    J⁺ẋ without a search.

    It looks one step ahead, at a grid. So it rests where every step of the grid is worse than none, in front of an
    obstacle that a longer way would lead around; and where it moves, it jumps between the steps of the grid.
    """

    def solve(self, problem: Problem) -> Solution:
        """Return the best candidate; see `Solver.solve`."""
        rows, primary, config = problem.avoidance, problem.v_tracking, self.config
        A, b = problem.tracking.A, problem.tracking.b_feasible
        grid = neighbourhood(len(primary), config.candidates)
        steps = np.concatenate([primary[None], *[length * config.speed * grid for length in LENGTHS]])
        v = np.minimum(np.maximum(steps, problem.lower), problem.upper)
        cost = np.square(v @ A.T - b).sum(axis=1) + config.motion_cost * np.square(v).sum(axis=1)
        if not np.isfinite(cost).all():
            return Solution(np.full_like(primary, np.nan))
        if len(rows.d):
            violation = np.maximum((rows.b - v @ rows.J.T).max(axis=1), 0.0)
            least = max(float(violation.min()), _ROUND_OFF)
            cost[violation > least] = np.inf
        elif np.array_equal(v[0], primary):
            return Solution(primary)
        return Solution(v[int(np.argmin(cost))])


@cache
def neighbourhood(n: int, candidates: int) -> Array:
    """List the steps of a grid from 0, of -1, 0 or 1 in each of n coordinates, that change at most p of them (m, n).

    Args:
        n: coordinates.
        candidates: how many there may be in all, of all lengths, with the tracking velocity; p is at least 1 [-].
    """
    p, count = 1, 1 + 2 * n
    while p < n and 1 + len(LENGTHS) * (count + comb(n, p + 1) * 2 ** (p + 1)) <= candidates:
        p += 1
        count += comb(n, p) * 2**p
    steps = np.zeros((count, n))
    k = 1
    for changed in range(1, p + 1):
        for which in combinations(range(n), changed):
            for signs in product((-1.0, 1.0), repeat=changed):
                steps[k, list(which)] = signs
                k += 1
    steps.flags.writeable = False
    return steps
