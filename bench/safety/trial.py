"""One run: a seed's scenario, one solver, the independent checker and the verdict; the row of a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from bench.safety.campaign import draw
from bench.safety.referee import disagreement, drift, referee
from bench.safety.verdict import Verdict, judge, last_avoidable
from qpavoid import Log, ScenarioConfig, Status
from qpavoid.run.log import STATUSES
from qpavoid.run.simulate import simulate
from qpavoid_bench.arena.checker import Findings
from qpavoid_bench.arena.mujoco_model import MujocoModel, load_model

ALONE = "-alone"
"""Suffix of the name of a solver without backup trajectories."""


@dataclass(frozen=True)
class Trial:
    """Record of a run; distances are MuJoCo's."""

    seed: int
    robot: str
    solver: str
    dt: float
    """Control period [s]."""
    ticks: int
    obstacles: int
    moving: int
    """Number of those that move."""
    d1: float
    """[m]."""
    distance: float
    """Least of the pairs whose distance depends on a joint [m]."""
    pair: str
    """Of that distance."""
    time: float
    """Of that distance [s]."""
    contacts: int
    """Pairs in contact at any time."""
    verdict: str
    """`clear`, or that of the first contact that is avoidable, or else of the first contact."""
    judged: str
    """Pair and time of that contact, and the proof of the verdict."""
    lead_time: float
    """Time from the last moment at which it was avoidable to that contact; NaN where not determined [s]."""
    lead_distance: float
    """Distance of the pair at that moment [m]."""
    lead_status: str
    """Status of the control step at that moment."""
    relaxed: float
    """Time of RELAXED control steps [s]."""
    stopped: float
    """Time of STOPPED control steps [s]."""
    arrived: bool
    error: float
    """Distance from the goal at the end [m]."""
    logged: bool
    """Whether the log itself has a contact: it knows the control steps only."""
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
    """Instants that the checker evaluated."""
    seconds: float
    """Time of simulation, checker and verdict [s]."""
    failure: str
    """Why the run ended early; empty if it did not."""

    @property
    def collided(self) -> bool:
        """Whether anything was in contact."""
        return self.contacts > 0

    @property
    def avoidable(self) -> bool:
        """Whether a contact was avoidable, or is not proved to be unavoidable."""
        return self.verdict in ("avoidable", "unproven")

    @property
    def near(self) -> bool:
        """Whether it came nearer than d1/2 without contact."""
        return not self.collided and self.distance < 0.5 * self.d1


def trials(seed: int, solvers: Sequence[str]) -> list[Trial]:
    """Run the scenario of a seed with several solvers."""
    scenario = draw(seed)
    twin = load_model(scenario)
    return [examine(seed, as_named(scenario, solver), twin, solver)[0] for solver in solvers]


def as_named(scenario: ScenarioConfig, solver: str) -> ScenarioConfig:
    """Return the scenario, without `avoidance.backup` for `qp-alone`."""
    if not solver.endswith(ALONE):
        return scenario
    avoidance = scenario.avoidance.model_copy(update={"backup": None})
    return scenario.model_copy(update={"avoidance": avoidance}).with_source(scenario.source)


def examine(
    seed: int, scenario: ScenarioConfig, twin: MujocoModel, solver: str
) -> tuple[Trial, Log, Findings, tuple[Verdict, ...]]:
    """Run one solver; return its row, and what it was made of."""
    begin = perf_counter()
    log = simulate(scenario, solver.removesuffix(ALONE))
    findings = referee(twin, log)
    verdicts = judge(twin, scenario, log, findings)
    names, metrics = [" - ".join(pair) for pair in twin.scene.pair_names], log.metrics()
    decisive = next((verdict for verdict in verdicts if verdict.avoidable), verdicts[0] if verdicts else None)
    lead_time, lead_distance, lead_status = np.nan, np.nan, ""
    if decisive and decisive.why == "avoidable" and solver.startswith("qp"):  # for the others it would take hours
        lead_time, lead_distance, status = last_avoidable(twin, scenario, log, findings, decisive)
        lead_status = STATUSES[status].value
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
        lead_time=lead_time,
        lead_distance=lead_distance,
        lead_status=lead_status,
        relaxed=_time(log, Status.RELAXED, scenario.dt),
        stopped=_time(log, Status.STOPPED, scenario.dt),
        arrived=metrics["arrived"],
        error=metrics["final_error"],
        logged=metrics["collided"],
        disagreement=disagreement(twin, log, findings),
        drift=drift(log, findings),
        speed_excess=findings.speed_excess,
        position_excess=findings.position_excess,
        acceleration_excess=findings.acceleration_excess,
        looks=findings.instants,
        seconds=perf_counter() - begin,
        failure=log.meta["stopped_by"] or "",
    )
    return trial, log, findings, verdicts


def _time(log: Log, status: Status, dt: float) -> float:
    return dt * float(np.sum(log.status == STATUSES.index(status)))
