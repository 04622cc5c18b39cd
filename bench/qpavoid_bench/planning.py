"""`qpavoid bench planning`: what planning costs a control step, where nothing is planned and while a process plans."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter_ns, sleep
from typing import Annotated, Any

import numpy as np
import typer

from qpavoid import Controller, ScenarioConfig
from qpavoid.config import Planning
from qpavoid.problem import Array
from qpavoid_bench.tables import RESULTS, describe_machine, number, table, write
from qpavoid_bench.tick.loops import Loop, circling

_DT = 0.005
"""Period of the loops [s]."""
_MOVING = 10
"""Obstacles of `circling` that move [-]."""
_BLOCKS = 10
"""Blocks of each loop, in turn [-]."""
_LEAD_IN = 100
"""Steps of each block that are not timed [-]."""


def planning(
    steps: Annotated[int, typer.Option(min=1000, help="Steps of each loop that are timed.")] = 20_000,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
) -> None:
    """Time control steps without planning, with a process that has nothing to plan, and with one that always plans."""
    print(write(out, "planning", _sections(steps)))


def _sections(steps: int) -> Iterator[str]:
    yield "# Planning beside a control loop"
    yield (
        f"{steps:,} steps of each loop at {1.0 / _DT:.0f} Hz by the clock, in {_BLOCKS} blocks by turns: a Panda's "
        f"tool follows a circle among 50 obstacles, {_MOVING} of them on circles (`circling` of `qpavoid bench tick`), "
        f"without backup trajectories. {describe_machine('qpavoid', 'numpy', 'numba')}; load of the machine before: "
        f"{os.getloadavg()[0]:.1f}."
    )
    yield (
        "`nothing to plan`: the motions of all obstacles are known, so that the process looks ahead at the start and "
        "then rests. `always planning`: obstacles that move are given to each step, and the next look is asked for as "
        "soon as the one before is answered. `core`: of the process, of one core. `late`: how long after its time a "
        "step begins."
    )
    head = ["loop", "planning", "", "p50 [µs]", "p99 [µs]", "p99.9 [µs]", "worst [µs]", "core"]
    rows, notes = [], []
    for name, is_given in (("nothing to plan", False), ("always planning", True)):
        result = _compare(is_given, steps)
        for planned, (ns, load) in result.items():
            for row, part in enumerate(("step", "late")):
                cells = [number(float(x)) for x in 1e-3 * np.percentile(ns[row], [50, 99, 99.9, 100])]
                busy = f"{100 * load:.0f} %" if planned and not row else ""
                rows.append([name, "process" if planned else "none", part, *cells, busy])
        without, plans = (1e-3 * np.percentile(result[planned][0][0], [50, 99]) for planned in (False, True))
        notes.append(
            f"{name}: the median step takes {plans[0] / without[0]:.2f} times as long, "
            f"p99 is {plans[1] - without[1]:+.1f} µs."
        )
    yield table(head, rows, text_columns=3)
    yield " ".join(notes)


def _compare(is_given: bool, steps: int) -> dict[bool, tuple[Any, float]]:
    """Return times of steps and their lateness (2, steps) [ns], and the load of a core by the process."""
    loops = {planned: _make_loop(is_given, planned) for planned in (False, True)}
    times: dict[bool, list[Any]] = {False: [], True: []}
    loads: dict[bool, list[float]] = {False: [], True: []}
    for part in range(2 * _BLOCKS):
        planned = bool(part % 2)
        _pace(loops[planned], _LEAD_IN)
        begin, used = perf_counter_ns(), _seconds_of_children()
        times[planned].append(_pace(loops[planned], steps // _BLOCKS))
        loads[planned].append((_seconds_of_children() - used) / (1e-9 * (perf_counter_ns() - begin)))
    return {planned: (np.concatenate(times[planned], axis=1), float(np.mean(loads[planned]))) for planned in times}


class _Given(Loop):
    """A loop whose moving obstacles are given to each step."""

    def __init__(self, controller: Controller, q: Array) -> None:
        super().__init__(controller, q)
        self._moving = controller.scene.obstacles[:_MOVING]
        self._observe()

    def advance(self, v: Array) -> None:
        super().advance(v)
        self._observe()

    def _observe(self) -> None:
        t = self.steps * self.controller.dt
        rows = np.array([obstacle.motion.sample(t).row for obstacle in self._moving])
        self._inputs = t, None, {tuple(obstacle.name for obstacle in self._moving): rows}


def _make_loop(is_given: bool, planned: bool) -> Loop:
    scenario: ScenarioConfig = circling(_DT, backup=False)
    if planned:
        config = Planning(worker="process", period=_DT) if is_given else Planning(worker="process")
        scenario = scenario.model_copy(update={"planning": config})
    loop = (_Given if is_given else Loop)(*Controller.from_scenario(scenario))
    return loop


def _pace(loop: Loop, count: int) -> Any:
    """Run steps at their times; return how long they take, and how late they begin (2, count) [ns]."""
    ns, period = np.zeros((2, count), dtype=np.int64), round(1e9 * _DT)
    due = perf_counter_ns()
    for k in range(count):
        due += period
        sleep(max(0.0, 1e-9 * (due - perf_counter_ns())))
        begin = perf_counter_ns()
        v = loop.step(None, None)
        ns[:, k] = perf_counter_ns() - begin, begin - due
        if ns[1, k] > 20 * period:
            due = perf_counter_ns()
        loop.advance(v)
    return ns


def _seconds_of_children() -> float:
    """Return the processor's time of the processes of this one [s]; 0 where the system does not say."""
    total, tick = 0.0, os.sysconf("SC_CLK_TCK")
    for file in Path("/proc/self/task").glob("*/children"):
        for child in file.read_text().split():
            fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
            total += (int(fields[11]) + int(fields[12])) / tick
    return total
