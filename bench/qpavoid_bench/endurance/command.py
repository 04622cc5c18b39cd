"""`qpavoid bench endurance`: memory, worst steps, time until the first step, throughput."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from qpavoid_bench.tables import RESULTS, describe_machine, number, table, write

LOOPS = ("circling+alone", "circling", "circling-500+alone", "circling-500")
FIRST_USES = ("far-50", "far-50+sample1", "far-50+pose1", "cloud-1000", "circling+alone", "circling")
FIRST = 200
SCENARIOS = ("situation1", "panda_line")


def endurance(
    steps: Annotated[int, typer.Option(help="Steps over which memory is watched.")] = 1_000_000,
    timed: Annotated[int, typer.Option(help="Steps that are timed.")] = 100_000,
    runs: Annotated[int, typer.Option(help="Scenarios of a sweep.")] = 16,
    states: Annotated[int, typer.Option(help="Independent states of a batch.")] = 50_000,
    quick: Annotated[bool, typer.Option("--quick", help="A hundredth of all; writes endurance-quick.md.")] = False,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
) -> None:
    """Measure memory over a million steps, the worst of many, the time until the first, and throughput."""
    if quick:
        steps, timed, runs, states = 20_000, 5_000, 2, 2_000
    cases = ("both on disk",) if quick else ("nothing compiled or fitted yet", "both on disk")
    print(write(out, "endurance-quick" if quick else "endurance", _sections(steps, timed, runs, states, cases)))


def _measure(*arguments: object, **environment: str) -> Any:
    """Return what a function of `qpavoid_bench.endurance.measure` finds in a process of its own."""
    command = [sys.executable, "-m", "qpavoid_bench.endurance.measure", *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def _sections(steps: int, timed: int, runs: int, states: int, cases: tuple[str, ...]) -> Iterator[str]:
    yield "# Endurance"
    yield (
        f"{describe_machine('qpavoid', 'numpy', 'pin')}; load of the machine before: "
        f"{os.getloadavg()[0]:.1f}. `circling` is a closed loop of `qpavoid bench tick`: a Panda's tool follows a "
        "circle among 50 obstacles, 10 of them on circles; all of it repeats after 10 s. Control steps are at 100 Hz, "
        "of `circling-500` at 500 Hz; `+alone` is without backup trajectories."
    )
    yield f"## The worst of {timed:,} steps [µs]"
    yield (
        "Work: each of the steps of a lap by its median over all laps. Machine: a loop that reads the clock a "
        "fixed number of times and takes as long as the median step, just as often."
    )
    head = ["loop", "", "p50", "p99", "p99.9", "worst", "p99/p50"]
    rows, notes = [], []
    for loop in LOOPS:
        result = _measure("latency", loop, timed)
        for name in ("steps", "work", "machine"):
            p50, p99, *rare = result[name]
            rows.append([loop, name, *map(number, (p50, p99, *rare)), f"{p99 / p50:.2f}"])
        notes.append(
            f"{loop}: {100 * result['slow']:.2f} % of the steps slower than twice the median, the core taken away "
            f"{result['preempted']:.1f} times in 1000 steps."
        )
    yield table(head, rows, text_columns=2)
    yield " ".join(notes)
    yield "## Beside a live view [µs]"
    count = max(timed // 5, 1000)
    yield (
        f"{count:,} steps of {LOOPS[0]} at 200 Hz with `View.update` after each, whose page a client reads without "
        f"drawing it, and as many without a view, in turn. Late: how long after its time a step begins. "
        "A browser that draws by software on the same cores takes these from the loop: not measured here."
    )
    result = _measure("view", LOOPS[0], count)
    names = [f"{name} {which}" for name in ("step", "late") for which in ("without", "with")] + ["update with"]
    yield table(["", "p50", "p99", "p99.9", "worst"], [[name, *map(number, result[name])] for name in names])
    yield f"## Memory over {steps:,} steps"
    result = _measure("memory", LOOPS[0], steps)
    cells = [*(f"{x:.1f}" for x in result["resident"]), f"{result['slope']:.3f}", result["growth"], result["peak"]]
    start, half, end = "RSS at the start [MB]", "half way", "at the end"
    slope, growth = "growth in the second half [bytes/step]", f"growth over {steps // 10:,} more, by Python [bytes]"
    yield table(["loop", start, half, end, slope, growth, "peak above that [bytes]"], [[LOOPS[0], *cells]])
    yield "## Until the first step [s]"
    rows = []
    with TemporaryDirectory() as empty:
        caches = dict.fromkeys(("NUMBA_CACHE_DIR", "QPAVOID_CACHE"), empty) if len(cases) > 1 else {}
        for case in cases:
            result = _measure("start", "panda", PYTHONDONTWRITEBYTECODE="", **caches)  # empty: off, as usual
            rows.append([case, *(f"{result[part]:.2f}" for part in ("import", "scene", "controller"))])
    yield table(["Panda", "import", "robot and scene", "controller, which warms up"], rows)
    yield "## The first step after that [µs]"
    yield (
        "The first step of a new process in which a controller was made: whatever it is the first to use. Beside it "
        f"the slowest of the next {FIRST - 1}, and the median of all."
    )
    rows = []
    for loop in FIRST_USES:
        result = _measure("first_use", loop, FIRST)
        rows.append([loop, *(number(result[part]) for part in ("first", "worst", "median"))])
    yield table(["loop", "first", "slowest other", "median"], rows)
    yield "## Control steps a second"
    yield (
        f"`simulate_many` over {runs} scenarios that differ in d2, with all that a run records and the build of robot "
        f"and scene; `steps` over {states:,} random states around the initial one. `Workers` are kept, their start is "
        "not timed."
    )
    rows = []
    for scenario in SCENARIOS:
        base: dict[str, float] = {}
        for processes in (0, 1, *sorted({2, os.cpu_count() or 1} - {1})):
            result = _measure("throughput", scenario, runs, states, processes)
            base = base or result
            cells = [f"{result[part]:,.0f} ({result[part] / base[part]:.2f})" for part in ("sweep", "states")]
            rows.append([scenario, str(processes) if processes else "a loop in this process", *cells])
    yield table(["scenario", "processes", "sweep", "states"], rows)
