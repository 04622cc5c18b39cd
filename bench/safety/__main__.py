"""`python -m bench.safety`: the campaign, or one run of it with all details."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

from bench.safety import report
from bench.safety.campaign import draw
from bench.safety.trial import Trial, as_named, examine, trials
from qpavoid import Workers
from qpavoid.run.log import STATUSES
from qpavoid_bench.arena.mujoco_model import load_model

RESULTS = Path(__file__).parents[1] / "results"


def main() -> None:
    """Parse the options, and run the campaign or one seed."""
    parser = argparse.ArgumentParser(prog="python -m bench.safety", description=__doc__)
    parser.add_argument("--runs", type=int, default=2000, help="scenarios, each with every solver (2000)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first (0)")
    parser.add_argument("--seeds", help="comma-separated, in place of --runs and --first")
    parser.add_argument(
        "--solvers",
        "--solver",
        default="qp,qp-alone,eq10,tracking",
        help="comma-separated (qp,qp-alone,eq10,tracking); qp-alone is qp without backup trajectories",
    )
    parser.add_argument("--jobs", type=int, help="processes (one a core)")
    parser.add_argument("--name", default="safety", help="of the files written to bench/results (safety)")
    parser.add_argument("--seed", type=int, help="run this one only, and print all details")
    options = parser.parse_args()
    solvers = options.solvers.split(",")
    if options.seed is not None:
        for solver in solvers:
            describe(options.seed, solver)
        return
    load_before, begin = os.getloadavg()[0], perf_counter()
    seeds = range(options.first, options.first + options.runs)
    chosen = list(seeds) if options.seeds is None else [int(seed) for seed in options.seeds.split(",")]
    found, failures = campaign(chosen, solvers, options.jobs)
    cost = report.Cost(perf_counter() - begin, (load_before, os.getloadavg()[0]))
    print(report.write(found, failures, solvers, cost, RESULTS, options.name))


def campaign(seeds: Sequence[int], solvers: list[str], jobs: int | None = None) -> tuple[list[Trial], dict[int, str]]:
    """Return the trials of all seeds in their order, and error messages by seed."""

    def report_progress(done: int, total: int) -> None:
        if done % 50 == 0 or done == total:
            print(f"{done}/{total}", flush=True)

    with Workers(jobs) as workers:
        answers = workers.map(trials, [(seed, solvers) for seed in seeds], report_progress)
    failed = {s: f"{type(a).__name__}: {a}" for s, a in zip(seeds, answers, strict=True) if isinstance(a, Exception)}
    return [trial for answer in answers if not isinstance(answer, Exception) for trial in answer], failed


def describe(seed: int, solver: str) -> None:
    """Run one seed, and print its scene, the findings of the checker, and all verdicts."""
    scenario = draw(seed)
    twin = load_model(scenario)
    scenario = as_named(scenario, solver)
    trial, log, findings, verdicts = examine(seed, scenario, twin, solver)
    avoidance = scenario.avoidance
    print(
        f"seed {seed}, {trial.robot}, {solver}; dt {scenario.dt:g} s, {scenario.duration:g} s, locked {scenario.lock}"
    )
    print(f"d1 {avoidance.d1:.4f} m, d2 {avoidance.d2:.4f} m")
    for task in scenario.tasks:
        print(f"  task {task.frame}: {task.type}, {task.motion}")
    for obstacle in scenario.obstacles:
        print(f"  {obstacle.name}: {obstacle.shape}, {obstacle.motion}")
    for name, value in vars(trial).items():
        print(f"{name:16} {value}")
    names = twin.scene.pair_names
    for contact in findings.contacts:
        step = int(log.t.searchsorted(contact.time)) - 1
        status = STATUSES[log.status[max(step, 0)]].value
        where = f"{' - '.join(names[contact.pair])} at {contact.time:.4f} s (step {step}, {status})"
        print(f"contact {where}, {1e3 * contact.depth:.2f} mm deep")
    for verdict in verdicts:
        print(f"verdict {' - '.join(names[verdict.contact.pair])}: {verdict.why}: {verdict.detail}")


if __name__ == "__main__":
    main()
