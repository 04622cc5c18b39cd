"""What is measured, each in a process of its own: `python -m qpavoid_bench.endurance.measure NAME ARGUMENTS`."""

from __future__ import annotations

import gc
import json
import os
import resource
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, perf_counter_ns, sleep
from typing import Any

import numpy as np
import numpy.typing as npt

SAMPLES = 20
"""Times at which resident memory is read."""


def latency(workload: str, count: int) -> dict[str, Any]:
    """Time every step of a closed loop, and of a loop that only reads the clock and takes as long as the median."""
    loop = _warm(workload)
    ns = np.zeros(count, dtype=np.int64)
    switches = _switches()
    for k in range(count):
        begin = perf_counter_ns()
        v = loop.step(None, None)
        ns[k] = perf_counter_ns() - begin
        loop.advance(v)
    switches = _switches() - switches
    work = np.median(
        ns[: count // loop.lap * loop.lap].reshape(-1, loop.lap), axis=0
    )  # of each step of a lap, over all laps
    machine = _spin(float(np.median(ns)), count)
    return {
        "steps": _quantiles(ns),
        "work": _quantiles(work),
        "machine": _quantiles(machine),
        "slow": float(np.mean(ns > 2.0 * np.median(ns))),
        "preempted": 1e3 * switches / count,
    }


def view(workload: str, count: int) -> dict[str, Any]:
    """Time steps of a closed loop of 200 Hz without a live view and with one that is read, in turn.

    Returns:
        Quantiles of the steps, of `View.update`, and of how late steps begin; of both loops.
    """
    from contextlib import ExitStack

    from qpavoid.viz.view import View
    from qpavoid_bench.endurance.reader import reader

    loop, parts = _warm(workload), 10
    times: dict[bool, list[npt.NDArray[np.int64]]] = {False: [], True: []}
    for part in range(2 * parts):
        with ExitStack() as stack:
            page = stack.enter_context(View(loop.controller.scene, port=0)) if part % 2 else None
            if page is not None:
                while not page.url:
                    page.events()
                stack.enter_context(reader(int(page.url.rsplit(":", 1)[1])))
                while not page.clients:
                    page.events()
            times[page is not None].append(_paced(loop, page, count // parts))
    names = ("step", "update", "late")
    return {
        f"{name} {'with' if is_shown else 'without'}": _quantiles(np.concatenate(blocks, axis=1)[row])
        for is_shown, blocks in times.items()
        for row, name in enumerate(names)
    }


_PERIOD = 5_000_000
"""Period of the loop beside a view [ns]."""


def _paced(loop: Any, page: Any, count: int) -> npt.NDArray[np.int64]:
    """Return the times (3, count) of steps, of the view's updates, and how late steps began [ns]."""
    ns, due = np.zeros((3, count), dtype=np.int64), perf_counter_ns()
    for k in range(count):
        due += _PERIOD
        sleep(max(0.0, 1e-9 * (due - perf_counter_ns())))
        begin = perf_counter_ns()
        tick = loop.tick()
        middle = perf_counter_ns()
        if page is not None:
            page.update(tick)
        ns[:, k] = middle - begin, perf_counter_ns() - middle, begin - due
        if ns[2, k] > 20 * _PERIOD:
            due = perf_counter_ns()
        loop.advance(tick.solution.v)
    return ns


def memory(workload: str, count: int) -> dict[str, Any]:
    """Return resident memory along a run [MB], then what Python allocated over a tenth of it, traced [bytes]."""
    loop = _warm(workload)
    at, resident = [0], [_resident()]
    for _ in range(SAMPLES):
        _run(loop, count // SAMPLES)
        at.append(at[-1] + count // SAMPLES)
        resident.append(_resident())
    half = SAMPLES // 2
    slope = float(np.polyfit(at[half:], resident[half:], 1)[0])
    tracemalloc.start()
    _run(loop, count // 100)
    gc.collect()
    previous = tracemalloc.get_traced_memory()[0]
    _run(loop, count // 10)
    gc.collect()
    after, peak = tracemalloc.get_traced_memory()
    megabytes = [resident[0], resident[half], resident[-1]]
    return {"resident": megabytes, "slope": 1e6 * slope, "growth": after - previous, "peak": peak - after}


def start(robot: str) -> dict[str, float]:
    """Return how long a program waits for its first controller [s]."""
    begin = perf_counter()
    import qpavoid

    imported = perf_counter()
    model = qpavoid.Robot.load(robot)
    tasks = qpavoid.build_tasks([qpavoid.config.Task(frame=model.end_effectors[0])], model, model.home)
    scene = qpavoid.build_scene(model, [])
    built = perf_counter()
    qpavoid.Controller(scene, tasks)
    return {"import": imported - begin, "scene": built - imported, "controller": perf_counter() - built}


def first_use(workload: str, count: int) -> dict[str, float]:
    """Return the first step of a closed loop, the slowest of the others, and their median [µs]."""
    from qpavoid_bench.tick.loops import make_loop

    loop, ns = make_loop(workload), []
    for _ in range(count):
        begin = perf_counter_ns()
        v = loop.step(None, None)
        ns.append(perf_counter_ns() - begin)
        loop.advance(v)
    return {"first": 1e-3 * ns[0], "worst": 1e-3 * max(ns[1:]), "median": 1e-3 * float(np.median(ns))}


def throughput(scenario: str, runs: int, states: int, processes: int) -> dict[str, float]:
    """Return control steps a second of a sweep and of independent states; 0 processes: a loop in this one."""
    from qpavoid import Controller, Workers, load_scenario, simulate, simulate_many, steps

    d2 = load_scenario(scenario).avoidance.d2
    sweep = [load_scenario(scenario, [f"avoidance.d2={d2 * x:.4f}"]) for x in np.linspace(1.0, 1.5, runs)]
    count = sum(round(each.duration / each.dt) + 1 for each in sweep)
    controller, q0 = Controller.from_scenario(sweep[0])
    q = q0 + np.random.default_rng(0).uniform(-0.3, 0.3, (states, len(q0)))
    if processes == 0:
        simulate(sweep[0])
        return {
            "sweep": count / _seconds(lambda: [simulate(each) for each in sweep]),
            "states": states / _seconds(lambda: [controller.step(state) for state in q]),
        }
    with Workers(processes) as workers:
        simulate_many(sweep[:1] * processes, workers)
        steps(sweep[0], q[: 100 * processes], 0.0, workers)
        return {
            "sweep": count / _seconds(lambda: simulate_many(sweep, workers)),
            "states": states / _seconds(lambda: steps(sweep[0], q, 0.0, workers)),
        }


def _warm(workload: str) -> Any:
    from qpavoid_bench.tick.loops import make_loop

    loop = make_loop(workload)
    _run(loop, loop.lap)
    gc.collect()
    return loop


def _run(loop: Any, count: int) -> None:
    for _ in range(count):
        loop.advance(loop.step(None, None))


def _seconds(work: Callable[[], Any]) -> float:
    begin = perf_counter()
    work()
    return perf_counter() - begin


def _spin(length: float, count: int) -> npt.NDArray[np.int64]:
    """Return durations [ns] of as many reads of the clock as usually take `length` [ns]: the machine alone."""

    def read(times: range) -> int:
        begin = perf_counter_ns()
        for _ in times:
            perf_counter_ns()
        return perf_counter_ns() - begin

    usual = float(np.median([read(range(1000)) for _ in range(1000)]))
    times = range(round(1000 * length / usual))
    return np.array([read(times) for _ in range(count)])


def _switches() -> int:
    """Return how often the scheduler took the core away so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw


def _resident() -> float:
    """Return resident memory [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _quantiles(ns: Any) -> list[float]:
    """Return p50, p99, p99.9 and worst [µs]."""
    return [float(1e-3 * value) for value in np.percentile(ns, [50, 99, 99.9, 100])]


if __name__ == "__main__":
    print(json.dumps(globals()[sys.argv[1]](*(int(x) if x.isdecimal() else x for x in sys.argv[2:]))))
