"""`python -m bench.endurance`: memory over a million ticks, and the worst ticks of a hundred thousand."""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import resource
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, perf_counter_ns
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin

ROOT = Path(__file__).parent.parent
LAP = 1000
DT = 0.01
OBSTACLES = 50
MOVING = 10
SAMPLES = 20
COLLECTOR = ("on", "frozen", "off")
Array = npt.NDArray[np.float64]


def main() -> None:
    """Parses the options, measures in a process for each case, writes bench/results/endurance.md and prints it."""
    parser = argparse.ArgumentParser(prog="python -m bench.endurance", description=__doc__)
    parser.add_argument("--ticks", type=float, default=1e6, help="ticks over which memory is watched (1e6)")
    parser.add_argument("--timed", type=float, default=1e5, help="ticks that are timed (1e5)")
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    ticks, timed = int(options.ticks), int(options.timed)
    if options.child:
        what, collector = options.child
        work: dict[str, Callable[[], Any]] = {
            "memory": lambda: _memory(ticks),
            "start": _start,
            "latency": lambda: _latency(timed, collector),
        }
        print(json.dumps(work[what]()))
        return
    load = os.getloadavg()[0]
    latency = {collector: _child(options, "latency", collector) for collector in COLLECTOR}
    memory = _child(options, "memory", "on")
    with TemporaryDirectory() as empty:
        cases = "nothing compiled yet", "compiled before"
        start = {case: _child(options, "start", "on", empty) for case in cases}
    text = _report(latency, memory, start, ticks, (load, os.getloadavg()[0]))
    (ROOT / "bench" / "results" / "endurance.md").write_text(text)
    print(text)


def _child(options: argparse.Namespace, what: str, collector: str, cache: str | None = None) -> dict[str, Any]:
    command = [sys.executable, "-m", "bench.endurance", "--ticks", str(options.ticks), "--timed", str(options.timed)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = cache
    done = subprocess.run(
        [*command, "--child", what, collector], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


# --- what runs -------------------------------------------------------------------------------------------------


def scenario(**avoidance: Any) -> Any:
    """A Panda follows a circle among obstacles, some of which circle as well; everything repeats after LAP ticks."""
    from qpavoid import ScenarioConfig

    random = np.random.default_rng(3)
    lap, obstacles = LAP * DT, []
    for i in range(OBSTACLES):
        angle, away, height = random.uniform(-np.pi, np.pi), random.uniform(0.45, 0.85), random.uniform(0.1, 0.9)
        size = random.uniform(0.03, 0.06)
        box = {"type": "box", "size": [2.0 * size, size, size]}
        circle = {
            "type": "circle",
            "center": [away * np.cos(angle), away * np.sin(angle), height],
            "radius": random.uniform(0.05, 0.25),
            "normal": random.normal(size=3).tolist(),
            "start_direction": random.normal(size=3).tolist(),
            "period": lap / int(random.integers(1, 3)),
        }
        motion = circle if i < MOVING else {"type": "fixed", "position": circle["center"]}
        obstacles.append(
            {"name": f"o{i}", "shape": box if i % 2 else {"type": "sphere", "radius": size}, "motion": motion}
        )
    tool = {"type": "circle", "radius": 0.12, "normal": [1, 0, 0], "start_direction": [0, 1, 0], "period": lap}
    return ScenarioConfig.model_validate(
        {
            "robot": "panda",
            "tasks": [{"frame": "panda_hand_tcp", "type": "pose", "motion": tool}],
            "obstacles": obstacles,
            "avoidance": {"d1": 0.03, "d2": 0.10, **avoidance},
            "dt": DT,
            "duration": lap,
        }
    )


class _Lap:
    """A lap recorded in closed loop, to be played back: each of its ticks comes up again and again."""

    def __init__(self) -> None:
        from qpavoid import Controller

        self.controller, q = Controller.from_scenario(scenario(backup=False))  # bench.moving times backup rollouts
        self.t = [k * DT for k in range(LAP)]
        self.q, pairs, self.status = [], [], []
        for k in range(2 * LAP):  # the first lap gets into the swing of it
            tick = self.controller.tick(q, self.t[k % LAP])
            if k >= LAP:
                self.q.append(q)
                pairs.append(frozenset(tick.problem.avoidance.pair.tolist()))
                self.status.append(tick.solution.status.value)
            q = pin.integrate(self.controller.scene.robot.model, q, tick.solution.v * DT)
        self.rows = [len(p) for p in pairs]
        self.changes = sum(a != b for a, b in pairwise(pairs))

    def run(self, ticks: int) -> None:
        """Run control steps without timing them."""
        step, q, t = self.controller.step, self.q, self.t
        for k in range(ticks):
            step(q[k % LAP], t[k % LAP])


def _start() -> dict[str, float]:
    """How long a program waits for its first controller [s]."""
    begin = perf_counter()
    from qpavoid import Controller

    imported = perf_counter()
    controller, _ = Controller.from_scenario(scenario())
    return {
        "import": imported - begin,
        "made": perf_counter() - imported - controller.warm_up_time,
        "warm": controller.warm_up_time,
    }


def _latency(ticks: int, collector: str) -> dict[str, Any]:
    """Duration of each tick, and of a loop that only reads the clock and takes as long as the median tick."""
    lap = _Lap()
    lap.run(LAP)
    gc.collect()
    if collector == "frozen":
        gc.freeze()
    elif collector == "off":
        gc.disable()
    pauses: list[int] = []
    gc.callbacks.append(_stopwatch(pauses))
    step, q, t = lap.controller.step, lap.q, lap.t
    ns = np.zeros(ticks, dtype=np.int64)
    switches, stolen, before = _switches(), _stolen(), perf_counter()
    for k in range(ticks):
        begin = perf_counter_ns()
        step(q[k % LAP], t[k % LAP])
        ns[k] = perf_counter_ns() - begin
    wall, switches, stolen = perf_counter() - before, _switches() - switches, _stolen() - stolen
    collections, pause = len(pauses), max(pauses, default=0)
    gc.disable()
    spun = _spin(int(np.median(ns)), ticks)
    usual = np.median(ns[: ticks // LAP * LAP].reshape(-1, LAP), axis=0)  # of each tick of the lap, over all laps
    relative = ns[: ticks // LAP * LAP].reshape(-1, LAP) / usual
    return {
        "us": _quantiles(ns), "usual": _quantiles(usual), "relative": _quantiles(1e3 * relative),
        "spin": _quantiles(spun), "ticks": ticks, "wall": wall, "switches": switches, "stolen": stolen,
        "collections": collections, "pause": 1e-3 * pause, "collecting": 1e-9 * sum(pauses), "rows": lap.rows,
        "changes": lap.changes, "status": {s: lap.status.count(s) for s in sorted(set(lap.status))},
        "pairs": len(lap.controller.scene.pairs), "slow": float(np.mean(ns > 2.0 * np.median(ns))),
        "slow_spin": float(np.mean(spun > 2.0 * np.median(spun))),
        "slow_usual": float(np.mean(usual > 2.0 * np.median(usual))),
    }  # fmt: skip


def _stopwatch(pauses: list[int]) -> Callable[[str, dict[str, Any]], None]:
    begin = 0

    def record(phase: str, _: dict[str, Any]) -> None:
        nonlocal begin
        if phase == "start":
            begin = perf_counter_ns()
        else:
            pauses.append(perf_counter_ns() - begin)

    return record


def _spin(length: float, count: int) -> npt.NDArray[np.int64]:
    """Durations [ns] of as many looks at the clock as take `length` [ns] as a rule: what varies is the machine."""
    looks = range(1000)
    calibrated = [_look(looks) for _ in range(1000)]
    looks = range(round(1000 * length / float(np.median(calibrated))))
    return np.array([_look(looks) for _ in range(count)])


def _look(times: range) -> int:
    begin = perf_counter_ns()
    for _ in times:
        perf_counter_ns()
    return perf_counter_ns() - begin


def _switches() -> int:
    """How often the scheduler took the core away so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw


def _stolen() -> float:
    """Time that the hypervisor took from all cores so far [s]; 0 where the system does not say."""
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    except OSError:
        return 0.0
    return int(fields[8]) / os.sysconf("SC_CLK_TCK")


def _memory(ticks: int) -> dict[str, Any]:
    """RSS along the run [MB]; then what Python allocated, over a tenth of the ticks, traced [bytes]."""
    lap = _Lap()
    lap.run(5 * LAP)
    gc.collect()
    at, rss = [0], [_rss()]
    for _ in range(SAMPLES):
        lap.run(ticks // SAMPLES)
        at.append(at[-1] + ticks // SAMPLES)
        rss.append(_rss())
    tracemalloc.start()
    lap.run(2 * LAP)
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    lap.run(ticks // 10)
    gc.collect()
    after, peak = tracemalloc.get_traced_memory()
    return {"at": at, "rss": rss, "traced": [before, after, peak], "traced_ticks": ticks // 10}


def _rss() -> float:
    """Resident memory [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _quantiles(ns: Any) -> list[float]:
    """p50, p99, p99.9 and worst, in thousandths of the unit given: ns to µs."""
    return [float(1e-3 * value) for value in np.percentile(ns, [50, 99, 99.9, 100])]


# --- the report ------------------------------------------------------------------------------------------------


def _report(latency: Any, memory: Any, start: Any, ticks: int, load: tuple[float, float]) -> str:
    any_ = next(iter(latency.values()))
    rows = np.array(any_["rows"])
    timed = any_["ticks"]
    status = ", ".join(f"{n / 10:g} % {name}" for name, n in any_["status"].items())
    lines = [
        "# Endurance",
        "",
        f"`Controller.step` of a Panda whose tool follows a circle among {OBSTACLES} obstacles, half spheres, half "
        f"boxes, {MOVING} of them on circles ({any_['pairs']} pairs; {rows.min()} to {rows.max()} rows a tick, "
        f"{rows.mean():.1f} on average; which pairs are in range changes at {any_['changes'] / 10:.0f} % of the ticks; "
        f"{status}). A lap of {LAP} ticks was recorded in closed loop and is played back. {_machine()}; load of the "
        f"machine before and at the end: {load[0]:.1f} and {load[1]:.1f}.",
        "",
        f"## The worst of {timed:,} ticks [µs]",
        "",
        "| collector | p50 | p99 | p99.9 | worst | p99/p50 | slower than 2 p50 | collections | worst collection | "
        "time in collector |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for collector, r in latency.items():
        p50, p99, p999, worst = r["us"]
        lines.append(
            f"| {collector} | {p50:.1f} | {p99:.1f} | {p999:.0f} | {worst:.0f} | {p99 / p50:.2f} | "
            f"{100 * r['slow']:.2f} % | {r['collections']} | {r['pause']:.0f} | "
            f"{100 * r['collecting'] / r['wall']:.2f} % |"
        )
    lines += [
        "",
        "`frozen`: `gc.freeze()` once the controller is built; `off`: `gc.disable()`.",
        "",
        "## Whose the slow ticks are",
        "",
        "The work: each of the 1000 ticks of the lap by its median over all laps. The machine: a loop that reads the "
        "clock a fixed number of times and takes as long as the median tick, just as often. Preempted: how often the "
        "scheduler gave the core to something else during the timed ticks; stolen: what the hypervisor took from all "
        "cores meanwhile.",
        "",
        "| collector | work p50 | work p99 | work p99/p50 | tick over its own median: p99 | p99.9 | machine p50 | "
        "machine p99/p50 | machine p99.9/p50 | machine worst | machine > 2 p50 | preempted | stolen |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for collector, r in latency.items():
        u, s, x = r["usual"], r["spin"], r["relative"]
        lines.append(
            f"| {collector} | {u[0]:.1f} | {u[1]:.1f} | {u[1] / u[0]:.2f} | {x[1]:.2f} | {x[2]:.2f} | "
            f"{s[0]:.1f} | {s[1] / s[0]:.2f} | {s[2] / s[0]:.2f} | {s[3]:.0f} | {100 * r['slow_spin']:.2f} % | "
            f"{1e3 * r['switches'] / timed:.1f} in 1000 ticks | {100 * r['stolen'] / r['wall']:.1f} % |"
        )
    lines += [
        "",
        f"## Memory over {ticks:,} ticks",
        "",
        "| RSS at the start [MB] | half way | at the end | growth in the second half [bytes/tick] | "
        "allocated by Python, over so many ticks | growth [bytes] | peak above the end [bytes] |",
        "|---:|---:|---:|---:|---:|---:|---:|",
    ]
    at, rss, half = np.array(memory["at"]), np.array(memory["rss"]), SAMPLES // 2
    slope = np.polyfit(at[half:], rss[half:], 1)[0] * 1e6
    before, after, peak = memory["traced"]
    lines += [
        f"| {rss[0]:.1f} | {rss[half]:.1f} | {rss[-1]:.1f} | {slope:.3f} | {memory['traced_ticks']:,} | "
        f"{after - before:+,} | {peak - after:,} |",
        "",
        "## Until the first tick [s]",
        "",
        "| | import | robot and scene | making the controller, which warms up |",
        "|---|---:|---:|---:|",
        *(f"| {case} | {r['import']:.2f} | {r['made']:.2f} | {r['warm']:.2f} |" for case, r in start.items()),
    ]
    return "\n".join(lines) + "\n"


def _machine() -> str:
    from qpavoid.run.machine import cpu

    return (
        f"{cpu()}, {os.cpu_count()} CPUs, {platform.system()}, Python "
        f"{platform.python_version()}, numpy {np.__version__}, pin {pin.__version__}; one thread"
    )


if __name__ == "__main__":
    main()
