"""`qpavoid bench planning`: what planning costs a control step, where nothing is planned and while a process plans."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter_ns, sleep, thread_time_ns
from typing import Annotated, Any, Literal

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
_BLOCKS = 25
"""Blocks of each loop, in turn [-]."""
_LEAD_IN = 40
"""Steps of each block that are not timed [-]."""
_ALONE, _AGAIN, _PLANS, _BESIDE = "none", "none, again", "process", "none, beside the same work"
"""What goes on beside a loop."""
_BUSY = "from qpavoid_bench.planning import look_ahead_for_ever; look_ahead_for_ever()"
"""What the program runs that does the same work without any loop."""


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
        "step begins. `none, again`: another controller of the same kind as `none`, so that its differences are what "
        "the machine does, and no more can be read from others. Beside the same work, nothing is planned, while a "
        "program that this loop knows nothing of looks ahead in the same scene without a pause: what that costs, "
        "caches, memory and cores do. `CPU`: the processor's time of a step's thread."
    )
    head = ["loop", "planning", "", "p50 [µs]", "p99 [µs]", "p99.9 [µs]", "worst [µs]", "core"]
    rows, notes = [], []
    for name, is_given in (("nothing to plan", False), ("always planning", True)):
        result = _compare(is_given, steps)
        for beside, (ns, load) in result.items():
            for row, part in enumerate(("step", "CPU", "late")):
                cells = [number(float(x)) for x in 1e-3 * np.percentile(ns[row], [50, 99, 99.9, 100])]
                busy = f"{100 * load:.0f} %" if beside != _ALONE and not row else ""
                rows.append([name, beside, part, *cells, busy])
        notes += [_compare_parts(name, result, other) for other in (_ALONE, _BESIDE) if other in result]
        notes.append(_compare_parts(name, result, _ALONE, _AGAIN))
    yield table(head, rows, text_columns=3)
    yield "\n".join(f"- {note}" for note in notes)


def _compare_parts(name: str, result: dict[str, tuple[Any, float]], other: str, one: str = _PLANS) -> str:
    """Return in a sentence how times of steps of one loop compare with those of another one."""
    parts = []
    for row, part in ((0, "step"), (1, "CPU")):
        without, plans = (1e-3 * np.percentile(result[beside][0][row], [50, 99]) for beside in (other, one))
        parts.append(f"{part}: median {plans[0] / without[0]:.2f} times, p99 {plans[1] - without[1]:+.1f} µs")
    return f"{name}, `{one}` against `{other}`: {'; '.join(parts)}."


def _compare(is_given: bool, steps: int) -> dict[str, tuple[Any, float]]:
    """Return times (3, steps) [ns] by what goes on beside the loop, see `_pace`, and the load of a core by that."""
    workers: dict[str, Literal["", "process"]] = {_ALONE: "", _AGAIN: "", _PLANS: "process"}
    loops = {beside: _make_loop(is_given, worker) for beside, worker in workers.items()}
    if is_given:
        loops[_BESIDE] = loops[_ALONE]
    times: dict[str, list[Any]] = {beside: [] for beside in loops}
    loads: dict[str, list[float]] = {beside: [] for beside in loops}
    with _busy_program() as busy:
        for _ in range(_BLOCKS):
            for beside, loop in loops.items():
                if beside == _BESIDE:
                    busy.send_signal(signal.SIGCONT)
                _pace(loop, _LEAD_IN)
                begin, used = perf_counter_ns(), _seconds_of_children()
                times[beside].append(_pace(loop, steps // _BLOCKS))
                loads[beside].append((_seconds_of_children() - used) / (1e-9 * (perf_counter_ns() - begin)))
                busy.send_signal(signal.SIGSTOP)
    return {beside: (np.concatenate(times[beside], axis=1), float(np.mean(loads[beside]))) for beside in loops}


@contextmanager
def _busy_program() -> Iterator[subprocess.Popen[bytes]]:
    """Start a program that looks ahead for ever, and stop it until it gets a SIGCONT."""
    busy = subprocess.Popen([sys.executable, "-c", _BUSY], stdout=subprocess.PIPE)
    try:
        assert busy.stdout is not None
        busy.stdout.readline()
        busy.send_signal(signal.SIGSTOP)
        yield busy
    finally:
        busy.kill()
        busy.wait()


def look_ahead_for_ever() -> None:
    """Look ahead in the scene without a pause, one step after the other; say so once it begins."""
    os.nice(10)  # as the process that plans is
    loop = _make_loop(True, "inline")
    print("begins", flush=True)
    while True:
        loop.advance(loop.step(None, None))


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


def _make_loop(is_given: bool, worker: Literal["", "inline", "process"]) -> Loop:
    scenario: ScenarioConfig = circling(_DT, backup=False)
    if worker:
        config = Planning(worker=worker, period=_DT) if is_given else Planning(worker=worker)
        scenario = scenario.model_copy(update={"planning": config})
    loop = (_Given if is_given else Loop)(*Controller.from_scenario(scenario))
    return loop


def _pace(loop: Loop, count: int) -> Any:
    """Run steps at their times; return how long they take, of that on a processor, how late they begin (3, n) [ns]."""
    ns, period = np.zeros((3, count), dtype=np.int64), round(1e9 * _DT)
    due = perf_counter_ns()
    for k in range(count):
        due += period
        sleep(max(0.0, 1e-9 * (due - perf_counter_ns())))
        begin, used = perf_counter_ns(), thread_time_ns()
        v = loop.step(None, None)
        used = thread_time_ns() - used
        ns[:, k] = perf_counter_ns() - begin, used, begin - due
        if ns[2, k] > 20 * period:
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
