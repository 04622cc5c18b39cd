"""More regularization while a stalled robot shakes, and none of it where it moves on."""

import numpy as np
import pytest

from qpavoid.problem import AvoidanceRows, Tracking, make_problem
from qpavoid.safety.stall_damping import StallDamping

DT = 0.01
BENT = 1e-3


@pytest.fixture
def problem():
    nothing = AvoidanceRows(np.zeros(0, int), np.zeros(0), np.zeros((0, 2)), np.zeros(0), 0.02, 0.1, np.zeros(0))
    tracking = Tracking(np.eye(2), np.ones(2), np.ones(2))
    return make_problem(tracking, nothing, -np.ones(2), np.ones(2), [])._replace(bent=BENT)


def play(damping, seconds, amplitude, stalled):
    """Feed a velocity that changes its sign in every step."""
    for k in range(round(seconds / DT)):
        damping.update(np.array([amplitude * (-1) ** k, 0.0]), stalled)


def test_it_grows_while_a_stalled_robot_shakes_and_falls_as_it_moves_on(problem):
    damping = StallDamping(DT)
    assert damping.apply(problem) is problem
    play(damping, 0.35, 0.1, stalled=True)
    grown = damping.apply(problem).bent
    assert grown == pytest.approx(8 * BENT)
    play(damping, 0.25, 0.1, stalled=False)
    assert BENT <= damping.apply(problem).bent < grown
    play(damping, 1.0, 0.1, stalled=False)
    assert damping.apply(problem) is problem


def test_a_robot_that_rests_or_progresses_is_not_damped(problem):
    damping = StallDamping(DT)
    play(damping, 2.0, 1e-3, stalled=True)
    play(damping, 2.0, 1.0, stalled=False)
    assert damping.apply(problem) is problem


def test_it_ends_at_four_times_what_the_tasks_bend_and_with_a_reset(problem):
    damping = StallDamping(DT)
    play(damping, 5.0, 0.1, stalled=True)
    assert damping.apply(problem).bent == pytest.approx(4 * DT * np.sqrt(2))
    damping.reset()
    assert damping.apply(problem) is problem


def test_a_fixed_regularization_stays(problem):
    """Task-switching rows are compared with eq. 10 at a λ that is the same in every step."""
    damping, fixed = StallDamping(DT), problem._replace(bent=0.0)
    play(damping, 5.0, 0.1, stalled=True)
    assert damping.apply(fixed) is fixed
