"""`python -m bench.batch`: ticks a second against the number of processes, for sweeps and for independent states."""

from __future__ import annotations

import argparse
import os
import platform
from pathlib import Path
from time import perf_counter

import numpy as np

from qpavoid import Controller, ScenarioConfig, Workers, load_scenario, simulate_many, steps
from qpavoid.run.machine import cpu
from qpavoid.run.simulate import simulate

RESULTS = Path(__file__).parent / "results" / "batch.md"
SCENARIOS = ("situation1", "panda_line")


def main() -> None:
    """Parses the options, measures, writes bench/results/batch.md and prints it."""
    parser = argparse.ArgumentParser(prog="python -m bench.batch", description=__doc__)
    parser.add_argument("--runs", type=int, default=32, help="scenarios in a sweep (32)")
    parser.add_argument("--duration", type=float, default=5.0, help="length of each [s] (5)")
    parser.add_argument("--states", type=int, default=100_000, help="independent states (100000)")
    parser.add_argument("--jobs", help="numbers of processes, comma-separated (1, 2, 4, … up to the number of cores)")
    options = parser.parse_args()
    jobs = [int(n) for n in options.jobs.split(",")] if options.jobs else _doubling(os.cpu_count() or 1)
    load = os.getloadavg()[0]
    lines = [
        "# Batches",
        "",
        f"`simulate_many` over {options.runs} scenarios of {options.duration:g} s that differ in d2, and `steps` over "
        f"{options.states:,} random states around the initial one, with `Workers` that are kept: their start is given "
        "apart, and what they do for the first time (compiled code loaded, robots read) is not timed. `in this "
        f"process`: the same in a plain loop. {cpu()}, {os.cpu_count()} CPUs, {platform.system()}, Python "
        f"{platform.python_version()}, numpy {np.__version__}; load of the "
        f"machine before: {load:.1f}.",
        "",
        "| | processes | start [s] | sweep [s] | ticks/s | ratio | states [s] | ticks/s | ratio | "
        "a call with 1 state a process [ms] |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name in SCENARIOS:
        lines += _measure(name, jobs, options)
    lines += ["", "A run of a sweep has to build its robot and scene first, and records more than a step computes:", ""]
    lines += ["| | build [ms] | simulate, without build [µs/tick] | step [µs] |", "|---|---:|---:|---:|"]
    lines += [_parts(name, options) for name in SCENARIOS]
    text = "\n".join(lines) + "\n"
    RESULTS.write_text(text)
    print(text)


def _sweep(name: str, options: argparse.Namespace) -> list[ScenarioConfig]:
    values = load_scenario(name).avoidance.d2 * np.linspace(1.0, 1.5, options.runs)
    return [load_scenario(name, [f"avoidance.d2={d2:.4f}", f"duration={options.duration}"]) for d2 in values]


def _measure(name: str, jobs: list[int], options: argparse.Namespace) -> list[str]:
    scenarios = _sweep(name, options)
    controller, q0 = Controller.from_scenario(scenarios[0])
    q = q0 + np.random.default_rng(0).uniform(-0.3, 0.3, (options.states, len(q0)))
    ticks = sum(round(s.duration / s.dt) + 1 for s in scenarios)
    simulate(scenarios[0])
    begin = perf_counter()
    for scenario in scenarios:
        simulate(scenario)
    sweep = perf_counter() - begin
    begin = perf_counter()
    for state in q:
        controller.step(state)
    states = perf_counter() - begin
    lines = [
        f"| {name} | in this process | | {sweep:.2f} | {ticks / sweep:,.0f} | 1 | {states:.2f} | "
        f"{len(q) / states:,.0f} | 1 | |"
    ]
    for count in jobs:
        begin = perf_counter()
        with Workers(count) as workers:
            start = perf_counter() - begin
            simulate_many(scenarios[: 2 * count], workers)
            steps(scenarios[0], q[: 100 * count], 0.0, workers)
            begin = perf_counter()
            simulate_many(scenarios, workers)
            many = perf_counter() - begin
            begin = perf_counter()
            steps(scenarios[0], q, 0.0, workers)
            batch = perf_counter() - begin
            begin = perf_counter()
            for _ in range(50):
                steps(scenarios[0], q[:count], 0.0, workers)
            call = (perf_counter() - begin) / 50
        lines.append(
            f"| {name} | {count} | {start:.2f} | {many:.2f} | {ticks / many:,.0f} | {sweep / many:.2f} | {batch:.2f} | "
            f"{len(q) / batch:,.0f} | {states / batch:.2f} | {1e3 * call:.2f} |"
        )
    return lines


def _parts(name: str, options: argparse.Namespace) -> str:
    scenario = _sweep(name, options)[0]
    build, whole, step = [], [], []
    for _ in range(3):
        begin = perf_counter()
        controller = Controller.from_scenario(scenario)[0]
        build.append(perf_counter() - begin)
        begin = perf_counter()
        log = simulate(scenario)
        whole.append(perf_counter() - begin)
        begin = perf_counter()
        for q, t in zip(log.q, log.t.tolist(), strict=True):
            controller.step(q, t)
        step.append((perf_counter() - begin) / len(log.t))
    run = (np.median(whole) - np.median(build)) / len(log.t)
    return f"| {name} | {1e3 * np.median(build):.0f} | {1e6 * run:.0f} | {1e6 * np.median(step):.0f} |"


def _doubling(most: int) -> list[int]:
    return [n for n in (1, 2, 4, 8, 16, 32, 64, 128) if n < most] + [most]


if __name__ == "__main__":
    main()
