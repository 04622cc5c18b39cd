"""One run: a seed's scenario, one solver, the referee and the verdict; the row of a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from bench.safety.campaign import draw
from bench.safety.referee import disagreement, drift, referee
from bench.safety.verdict import Verdict, judge, last_way_out
from qpavoid import Log, ScenarioConfig, Status
from qpavoid.arena.referee import Findings
from qpavoid.arena.twin import Twin, load
from qpavoid.run.log import STATUSES
from qpavoid.run.simulate import simulate

ALONE = "-alone"
"""What the name of a solver ends with that keeps no way out at hand."""


@dataclass(frozen=True)
class Trial:
    """What is kept of a run. Distances are MuJoCo's."""

    seed: int
    robot: str
    solver: str
    dt: float
    """Control period [s]."""
    ticks: int
    obstacles: int
    moving: int
    """How many of them move."""
    d1: float
    """[m]."""
    distance: float
    """Smallest of the pairs that the robot can part [m]."""
    pair: str
    """Which pair that was."""
    time: float
    """When [s]."""
    contacts: int
    """Pairs that touched."""
    verdict: str
    """`clear`, or that of the first contact that is avoidable, or else of the first contact."""
    judged: str
    """Pair and time of that contact, and how the verdict is known."""
    way_out: float
    """How long before that contact the last flight got away; NaN where that was not looked for [s]."""
    apart: float
    """How far apart the pair was then [m]."""
    then: str
    """How the tick ended that let it pass."""
    relaxed: float
    """Time of ticks that ended RELAXED [s]."""
    stopped: float
    """The same of STOPPED [s]."""
    arrived: bool
    error: float
    """Distance from the goal at the end [m]."""
    seen: bool
    """Whether the log itself has a contact: it knows the ticks only."""
    disagreement: float
    """Largest difference between the log's distances and MuJoCo's [m]."""
    drift: float
    """Largest difference between the log's configurations and MuJoCo's [rad or m]."""
    speed_excess: float
    """Beyond the velocity limits, at most [rad/s or m/s]."""
    position_excess: float
    """Beyond the position limits, at most [rad or m]."""
    acceleration_excess: float
    """Beyond the acceleration limits, at most; -inf without [rad/s² or m/s²]."""
    looks: int
    """Instants that the referee looked at."""
    seconds: float
    """What the run took, simulation, referee and verdict [s]."""
    failure: str
    """Why the run ended before its time; empty if it did not."""

    @property
    def collided(self) -> bool:
        """Something touched."""
        return self.contacts > 0

    @property
    def avoidable(self) -> bool:
        """A contact could have been avoided, or nothing proves that it could not."""
        return self.verdict in ("avoidable", "unproven")

    @property
    def near(self) -> bool:
        """No contact, but nearer than d1/2."""
        return not self.collided and self.distance < 0.5 * self.d1


def trials(seed: int, solvers: Sequence[str]) -> list[Trial]:
    """The scenario of a seed with several solvers."""
    scenario = draw(seed)
    twin = load(scenario)
    return [examine(seed, as_named(scenario, solver), twin, solver)[0] for solver in solvers]


def as_named(scenario: ScenarioConfig, solver: str) -> ScenarioConfig:
    """The same scenario, without `avoidance.backup` where the solver is given as `qp-alone`."""
    if not solver.endswith(ALONE):
        return scenario
    avoidance = scenario.avoidance.model_copy(update={"backup": None})
    return scenario.model_copy(update={"avoidance": avoidance}).read_from(scenario.source)


def examine(
    seed: int, scenario: ScenarioConfig, twin: Twin, solver: str
) -> tuple[Trial, Log, Findings, tuple[Verdict, ...]]:
    """One run, with everything that its row was made of."""
    begin = perf_counter()
    log = simulate(scenario, solver.removesuffix(ALONE))
    findings = referee(twin, log)
    verdicts = judge(twin, scenario, log, findings)
    names, metrics = [" - ".join(pair) for pair in twin.scene.pair_names], log.metrics()
    decisive = next((verdict for verdict in verdicts if verdict.avoidable), verdicts[0] if verdicts else None)
    way_out, apart, then = np.nan, np.nan, ""
    if decisive and decisive.why == "avoidable" and solver.startswith("qp"):  # the others' would take hours
        way_out, apart, status = last_way_out(twin, scenario, log, findings, decisive)
        then = STATUSES[status].value
    trial = Trial(
        seed=seed,
        robot=twin.scene.robot.name,
        solver=solver,
        dt=scenario.dt,
        ticks=len(log.t),
        obstacles=len(scenario.obstacles),
        moving=sum(obstacle.moves for obstacle in twin.scene.obstacles),
        d1=scenario.avoidance.d1,
        distance=findings.distance,
        pair=names[findings.pair] if findings.pair >= 0 else "",
        time=findings.time,
        contacts=len(findings.contacts),
        verdict=decisive.why if decisive else "clear",
        judged=f"{names[decisive.contact.pair]} at {decisive.contact.time:.3f} s: {decisive.detail}"
        if decisive
        else "",
        way_out=way_out,
        apart=apart,
        then=then,
        relaxed=_time(log, Status.RELAXED, scenario.dt),
        stopped=_time(log, Status.STOPPED, scenario.dt),
        arrived=metrics["arrived"],
        error=metrics["final_error"],
        seen=metrics["collided"],
        disagreement=disagreement(twin, log, findings),
        drift=drift(log, findings),
        speed_excess=findings.speed_excess,
        position_excess=findings.position_excess,
        acceleration_excess=findings.acceleration_excess,
        looks=findings.looks,
        seconds=perf_counter() - begin,
        failure=log.meta["stopped_by"] or "",
    )
    return trial, log, findings, verdicts


def _time(log: Log, status: Status, dt: float) -> float:
    return dt * float(np.sum(log.status == STATUSES.index(status)))
