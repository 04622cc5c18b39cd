"""One run of the arena: a case, an entrant, the referee; the row of a table."""

from __future__ import annotations

from time import perf_counter

from qpavoid.arena.case import Case
from qpavoid.arena.entrants import Entrant
from qpavoid.arena.referee import play
from qpavoid.arena.rollout import roll_out
from qpavoid.arena.scores import Score, score, to_keep
from qpavoid.arena.twin import build
from qpavoid.arena.world import build_world

PATIENCE = 20.0
"""An entrant may take so many times the duration of a case, in all its ticks together [-]."""


def run_trial(case: Case, entrant: Entrant) -> Score:
    """Runs an entrant in a case and has it judged.

    Raises:
        ConfigError, UnknownName, SolverNotInstalled: the case or the entrant cannot be set up.
    """
    begin = perf_counter()
    world = build_world(case.scenario)
    rollout = roll_out(case, entrant.start(case, world), world, PATIENCE * case.scenario.duration)
    scenario = case.scenario
    findings = play(build(world.scene, world.q0), rollout.t, rollout.v, scenario.limits, to_keep(scenario))
    return score(case, world, entrant.name, entrant.digest, rollout, findings, perf_counter() - begin)
