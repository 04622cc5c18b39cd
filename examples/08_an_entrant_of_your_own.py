"""A law of your own in the arena: this file is all that it takes. Needs `pip install 'qpavoid[arena]'`.

`qpavoid bench run smoke --entrant examples/08_an_entrant_of_your_own.py:RowByRow` runs it beside the laws that ship.
"""

from pathlib import Path

import numpy as np

from qpavoid import Problem, Solution


class RowByRow:
    """Projects onto one avoidance row after another, a few rounds; needs no QP."""

    bounded = True
    rounds = 10

    def solve(self, problem: Problem) -> Solution:
        """Kaczmarz' method from the tracking velocity: v += Jᵀ (b - J v)⁺ / ‖J‖², row by row, within the bounds."""
        v, rows = problem.v_tracking, problem.avoidance
        for _ in range(self.rounds):
            for J, b in zip(rows.J, rows.b, strict=True):
                v = v + J * max(b - J @ v, 0.0) / max(J @ J, 1e-9)
            v = np.clip(v, problem.lower, problem.upper)
        return Solution(v)


def main() -> None:
    """Three cases by hand, as a sweep runs them: in a closed loop, judged by MuJoCo."""
    from qpavoid_bench.arena.entrant_file import entrant_from_file
    from qpavoid_bench.arena.entrants import find_entrant
    from qpavoid_bench.arena.families import load_family, make_case
    from qpavoid_bench.arena.trial import run_trial

    entrants = [find_entrant("tracking"), find_entrant("qp"), entrant_from_file(Path(__file__), "RowByRow")]
    for seed in range(3):
        case = make_case(load_family("situation1"), seed)
        for entrant in entrants:
            score = run_trial(case, entrant)
            outcome = "collided" if score.collided else "arrived" if score.arrived else "short of its goal"
            print(f"seed {seed}  {entrant.name:10} {1e3 * score.min_distance:7.1f} mm at least, {outcome}")


if __name__ == "__main__":
    main()
