"""One run of the arena: a case, an entrant, the referee; the row of a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter

from qpavoid.arena.case import Case
from qpavoid.arena.entrants import Entrant
from qpavoid.arena.pilot import Pilot
from qpavoid.arena.referee import play
from qpavoid.arena.rollout import roll_out
from qpavoid.arena.scores import Score, score, to_keep
from qpavoid.arena.twin import build
from qpavoid.arena.world import World, build_world
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, Solution

PATIENCE = 20.0
"""An entrant may take so many times the duration of a case, in all its ticks together [-]."""


def run_trial(case: Case, entrant: Entrant) -> Score:
    """Runs an entrant in a case and has it judged. One that cannot be set up for the case has failed at every tick.

    Raises:
        ConfigError, UnknownName: the case itself cannot be built.
        ValueError: it cannot be judged, as the referee knows no counterpart of a joint or shape.
    """
    begin = perf_counter()
    world = build_world(case.scenario)
    rollout = roll_out(case, _set_up(entrant, case, world), world, PATIENCE * case.scenario.duration)
    scenario = case.scenario
    findings = play(build(world.scene, world.q0), rollout.t, rollout.v, scenario.limits, to_keep(scenario))
    return score(case, world, entrant.name, entrant.digest, rollout, findings, perf_counter() - begin)


def held(entrant: Entrant, why: str) -> Entrant:
    """The same entrant, of which every run ends as one that could not be set up does: the robot never moves.

    Args:
        entrant: it keeps its name and settings.
        why: told as the failure.
    """

    def start(case: Case, world: World) -> Pilot:
        return _Held(why)

    return replace(entrant, start=start)


class Held(Exception):
    """There is nobody to ask for a velocity."""


class _Held:
    """Fails at every tick."""

    def __init__(self, why: str) -> None:
        self._why = why

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        raise Held(self._why)


def _set_up(entrant: Entrant, case: Case, world: World) -> Pilot:
    try:
        return entrant.start(case, world)
    except Exception as error:  # whatever another library raises is a result here
        return _Held(f"cannot be set up: {type(error).__name__}: {error}")
