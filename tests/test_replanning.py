"""What plans promise in a closed loop: nothing changes where the law arrives, and the rest costs the plan alone."""

import pytest

from qpavoid.planning import worker
from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.families import load_family, make_case
from qpavoid_bench.arena.rollout import roll_out
from qpavoid_bench.arena.trial import run_trial
from qpavoid_bench.arena.world import build_world

LATE = (("random_walk", (0, 7, 8, 9, 11)), ("noisy_sensor", (7, 8)), ("chasing", (2,)), ("head_on", (6,)))


def roll(case, entrant="qp-planning"):
    """Rollout of a case by an entrant of the arena."""
    world = build_world(case.scenario)
    return roll_out(case, ENTRANTS[entrant].start(case, world), world)


@pytest.mark.parametrize(
    ("family", "seed"),
    [
        ("passing", 1),
        ("sphere_field", 7),
        ("crossing_arms", 3),
        ("shelf", 2),
        pytest.param("head_on", 3, marks=pytest.mark.slow),
        pytest.param("crossing", 3, marks=pytest.mark.slow),
        pytest.param("noisy_sensor", 3, marks=pytest.mark.slow),
        pytest.param("chasing", 11, marks=pytest.mark.slow),
    ],
)
def test_where_the_law_arrives_commands_are_those_of_the_law(family, seed):
    """Bit for bit, with hulls, whose distances start from those of the step before, too."""
    case = make_case(load_family(family), seed)
    assert roll(case).v.tobytes() == roll(case, "qp").v.tobytes()


class Counted(worker.InlineWorker):
    """A worker that counts the looks."""

    looks = 0

    def ask(self, question):
        super().ask(question)
        type(self).looks += 1


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_robot_comes_to_rest_where_the_goal_is_out_of_reach(seed, monkeypatch):
    """Without contact, and with ever fewer looks: 8 at most in 10 s."""
    monkeypatch.setattr(Counted, "looks", 0)
    monkeypatch.setattr(worker, "InlineWorker", Counted)
    case = make_case(load_family("unreachable"), seed)
    result = run_trial(case, ENTRANTS["qp-planning"])
    assert result.success
    assert 1 <= Counted.looks <= 8 * max(1.0, case.scenario.duration / 10.0)


@pytest.mark.slow
def test_among_obstacles_that_move_half_of_what_the_law_fails_at_arrives():
    """All cases of the suite `full` with obstacles that move in which `qp` does not arrive."""
    results = [run_trial(make_case(load_family(f), s), ENTRANTS["qp-planning"]) for f, seeds in LATE for s in seeds]
    assert sum(result.success for result in results) >= 5
    assert sum(result.collided for result in results) <= 1
