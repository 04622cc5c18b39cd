"""What plans promise in a closed loop: nothing changes where the law arrives, and the rest costs the plan alone."""

import pytest

from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.families import load_family, make_case
from qpavoid_bench.arena.rollout import roll_out
from qpavoid_bench.arena.world import build_world


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
