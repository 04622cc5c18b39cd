"""One run of the arena: a case, an entrant, the checker; a row of the results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter

from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, Solution
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.checker import check_run
from qpavoid_bench.arena.entrants import Entrant
from qpavoid_bench.arena.mujoco_model import build
from qpavoid_bench.arena.pilot import Pilot
from qpavoid_bench.arena.rollout import roll_out
from qpavoid_bench.arena.scores import Score, score, surface_safety_distance
from qpavoid_bench.arena.verdict import decisive, judge
from qpavoid_bench.arena.world import World, build_world

MAX_TIME_RATIO = 20.0
"""Largest computation time of an entrant over the duration of a case, all steps together [-]."""


def run_trial(case: Case, entrant: Entrant) -> Score:
    """Run an entrant in a case and check it.

    An entrant that cannot be set up for the case fails at every step.

    Raises:
        ConfigError, UnknownName: the case itself cannot be built.
        ValueError: it cannot be checked, as MuJoCo has no counterpart of a joint or shape.
    """
    begin = perf_counter()
    world = build_world(case.scenario)
    rollout = roll_out(case, _set_up(entrant, case, world), world, MAX_TIME_RATIO * case.scenario.duration)
    scenario, model = case.scenario, build(world.scene, world.q0)
    findings = check_run(model, rollout.t, rollout.v, scenario.limits, surface_safety_distance(scenario))
    verdict = None
    if not case.solved_by:  # of the others it is known that all contacts are avoidable
        verdict = decisive(judge(model, scenario, rollout.t, rollout.v, findings))
    result = score(case, world, entrant.name, entrant.digest, rollout, findings, perf_counter() - begin)
    if verdict is None:
        return result
    return replace(result, avoidable=verdict.avoidable, verdict=verdict.describe(model))


def failing_entrant(entrant: Entrant, failure: str) -> Entrant:
    """Return the same entrant with runs in which it fails at every step.

    Args:
        entrant: it keeps its name and settings.
        failure: message of the failure.
    """

    def start(case: Case, world: World) -> Pilot:
        return _FailingPilot(failure)

    return replace(entrant, start=start)


class NoVelocity(Exception):
    """There is no pilot that could compute a velocity."""


class _FailingPilot:
    """A pilot that fails at every step."""

    def __init__(self, failure: str) -> None:
        self._failure = failure

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        raise NoVelocity(self._failure)


def _set_up(entrant: Entrant, case: Case, world: World) -> Pilot:
    """Set an entrant up for a case; one that raises becomes a pilot that fails."""
    try:
        return entrant.start(case, world)
    except Exception as error:  # whatever another library raises is a result here
        return _FailingPilot(f"cannot be set up: {type(error).__name__}: {error}")
