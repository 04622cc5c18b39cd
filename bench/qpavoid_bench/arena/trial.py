"""One run of the arena: a case, an entrant, the checker; a row of the results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from time import perf_counter

from qpavoid.model.sample import Sample
from qpavoid.problem import Array, Solution
from qpavoid.run.mujoco import build
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.checker import check_run
from qpavoid_bench.arena.entrants import Entrant
from qpavoid_bench.arena.rollout import Pilot, roll_out
from qpavoid_bench.arena.scores import Score, score
from qpavoid_bench.arena.verdict import decisive, judge
from qpavoid_bench.arena.world import World, build_world, surface_safety_distance

MAX_TIME_RATIO = 20.0
"""Largest computation time of an entrant over the duration of a case, all steps together [-]."""


def run_trial(case: Case, entrant: Entrant) -> Score:
    """Run an entrant in a case and check it.

    An entrant that cannot be set up for the case fails at every step.

    Raises:
        ConfigError, UnknownName: the case itself cannot be built.
        ValueError: it cannot be checked, as MuJoCo has no counterpart of a joint or shape.
    """
    begin, scenario = perf_counter(), case.scenario
    world = build_world(scenario)
    try:
        pilot = entrant.start(case, world)
    except Exception as error:  # whatever another library raises is a result here
        pilot = _FailingPilot(f"cannot be set up: {type(error).__name__}: {error}")
    rollout = roll_out(case, pilot, world, MAX_TIME_RATIO * scenario.duration)
    model, d1 = build(world.scene, world.q0), surface_safety_distance(scenario)
    findings = check_run(model, rollout.t, rollout.v, scenario.limits, d1, rollout.q if scenario.plant else None)
    verdict = None
    if not case.solved_by and scenario.plant is None:  # of the others it is known that all contacts are avoidable
        verdict = decisive(judge(model, scenario, rollout.t, rollout.v, findings))
    result = score(case, world, entrant.name, entrant.digest, rollout, findings, perf_counter() - begin)
    if verdict is None:
        return result
    return replace(result, avoidable=verdict.avoidable, verdict=verdict.describe(model))


def failing_entrant(entrant: Entrant, failure: str) -> Entrant:
    """Return an entrant of the same name and settings that fails at every step with a message."""
    return replace(entrant, start=partial(_start_failing, failure))


class NoVelocity(Exception):
    """There is no pilot that could compute a velocity."""


class _FailingPilot:
    """A pilot that fails at every step."""

    def __init__(self, failure: str) -> None:
        self._failure = failure

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        raise NoVelocity(self._failure)


def _start_failing(failure: str, case: Case, world: World) -> Pilot:
    return _FailingPilot(failure)
