"""More regularization while a stalled robot shakes at something that rests, and none of it where it moves on."""

import numpy as np
import pytest

from qpavoid.problem import AvoidanceRows, Tracking, make_problem
from qpavoid.safety.shake_damping import ShakeDamping

DT = 0.01
BENT = 1e-3


@pytest.fixture
def problem():
    nothing = AvoidanceRows(np.zeros(0, int), np.zeros(0), np.zeros((0, 2)), np.zeros(0), 0.02, 0.1, np.zeros(0))
    tracking = Tracking(np.eye(2), np.ones(2), np.ones(2))
    return make_problem(tracking, nothing, -np.ones(2), np.ones(2), [])._replace(bent=BENT, violation=0.1)


def play(damping, seconds, command, stalled=True, feedforward=0.0):
    """Feed the commands of a function of time."""
    for k in range(round(seconds / DT)):
        damping.update(np.array([command(k * DT), 0.0]), np.array([feedforward]), stalled)


def to_and_fro(t):
    return 0.1 * (-1) ** round(t / DT)


def rest(t):
    return 0.0


def test_it_grows_while_a_stalled_robot_shakes_and_falls_some_time_after_it_has_moved_on(problem):
    damping = ShakeDamping(DT)
    assert damping.apply(problem) is problem
    play(damping, 0.31, to_and_fro)
    grown = damping.apply(problem).bent
    assert grown == pytest.approx(8 * BENT)
    play(damping, 5.0, rest)
    assert damping.apply(problem).bent == grown
    play(damping, 0.4, to_and_fro, stalled=False)
    assert damping.apply(problem).bent == grown
    play(damping, 0.4, to_and_fro, stalled=False)
    assert BENT < damping.apply(problem).bent < grown
    play(damping, 2.0, to_and_fro, stalled=False)
    assert damping.apply(problem) is problem


@pytest.mark.parametrize("command", [rest, lambda t: 5.0 * t])
def test_what_rests_or_speeds_up_is_not_damped(problem, command):
    damping = ShakeDamping(DT)
    play(damping, 0.9, command)
    assert damping.apply(problem) is problem


def test_where_there_is_progress_nothing_is_damped(problem):
    damping = ShakeDamping(DT)
    play(damping, 5.0, to_and_fro, stalled=False)
    assert damping.apply(problem) is problem


def test_robots_dodge_what_moves_as_hard_as_ever(problem):
    damping = ShakeDamping(DT)
    play(damping, 5.0, to_and_fro, feedforward=-0.1)
    assert damping.apply(problem) is problem
    play(damping, 0.31, to_and_fro)
    play(damping, DT, to_and_fro, feedforward=-0.1)
    assert damping.apply(problem) is problem


def test_it_ends_at_four_times_what_the_tasks_bend_and_with_a_reset(problem):
    damping = ShakeDamping(DT)
    play(damping, 5.0, to_and_fro)
    assert damping.apply(problem).bent == pytest.approx(4 * DT * np.sqrt(2))
    damping.reset()
    assert damping.apply(problem) is problem


def test_a_fixed_regularization_stays(problem):
    """Task-switching rows are compared with eq. 10 at a λ that is the same in every step."""
    damping, fixed = ShakeDamping(DT), problem._replace(bent=0.0)
    play(damping, 5.0, to_and_fro)
    assert damping.apply(fixed) is fixed
