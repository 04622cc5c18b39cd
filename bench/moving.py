"""`python -m bench.moving`: time that moving and external obstacles add to a control step."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter_ns
from typing import Any
from unittest.mock import patch

import numpy as np

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "bench" / "results" / "moving.md"
OBSTACLES = 50
MOVING = (0, 1, 10, 50)
DT = 0.01
BATCH = 25
"""Control steps that are timed as one."""


def main() -> None:
    """Parses the options, measures in a process of its own, writes bench/results/moving.md and prints it."""
    parser = argparse.ArgumentParser(prog="python -m bench.moving", description=__doc__)
    parser.add_argument("--rounds", type=int, default=200, help=f"batches of {BATCH} control steps of each kind (200)")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps({**measure(options.rounds), "without": closed_loop(backup=False), "with": closed_loop()}))
        return
    load = os.getloadavg()[0]
    found = _child(options.rounds)
    lines = [
        "# Moving obstacles",
        "",
        f"{platform.system()}, {os.cpu_count()} CPUs, Python {platform.python_version()}, numpy {np.__version__}, "
        f"load {load:.1f} at the start. One thread.",
        "",
        f"A Panda holds its tool still among {OBSTACLES} spheres, 2 m away, so that nothing is near: a step is "
        "kinematics, bounding spheres, task rows and bounds. Some move on lines and circles, or are given to `step` as "
        f"a `Sample` or a `Pose`. Kinds take turns, {BATCH} steps each; median over {options.rounds} turns [µs]; in "
        "brackets what "
        "one such obstacle adds.",
        "",
        "| obstacles | step |",
        "|---|---:|",
    ]
    for kind, count in ((kind, count) for kind in ("moving", "given as Sample", "given as Pose") for count in MOVING):
        name = f"{kind}, {count}"
        if name in found:
            lines.append(f"| {count} of {OBSTACLES} {kind} | {_cell(found[name], found['moving, 0'], count)} |")
    lines += [
        "",
        "## Backup trajectories",
        "",
        "The scenario of `bench.endurance`, in closed loop: a Panda follows a circle among 50 obstacles, 10 of them on "
        "circles. Rollouts are computed where these may come near; without: `avoidance: {backup: false}` [µs].",
        "",
        "| | p50 | p99 | worst | rollouts per step | time of a rollout |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name in ("without", "with"):
        p50, p99, worst, count, each = found[name]
        lines.append(f"| {name} | {p50:.0f} | {p99:.0f} | {worst:.0f} | {count:.2f} | {each:.0f} |")
    text = "\n".join(lines) + "\n"
    RESULTS.write_text(text)
    print(text)


def _cell(time: float, still: float, count: int) -> str:
    return f"{time:.1f}" if not count else f"{time:.1f} ({(time - still) / count:.2f})"


def _child(rounds: int) -> dict[str, Any]:
    command = [sys.executable, "-m", "bench.moving", "--rounds", str(rounds), "--child"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def measure(rounds: int) -> dict[str, float]:
    """Return the median time of a control step of each kind [µs]."""
    kinds = dict(_kinds())
    samples: dict[str, list[int]] = {name: [] for name in kinds}
    for turn in range(rounds):
        for name, step in kinds.items():
            begin = perf_counter_ns()
            for k in range(BATCH):
                step((turn + k) * DT)
            samples[name].append(perf_counter_ns() - begin)
    return {name: 1e-3 * float(np.median(ns)) / BATCH for name, ns in samples.items()}


def closed_loop(**avoidance: Any) -> tuple[float, ...]:
    """Return p50, p99 and worst of a lap's control steps [µs]; rollouts per step, and the time of one [µs]."""
    import pinocchio as pin

    from bench.endurance import LAP, scenario
    from qpavoid import Controller
    from qpavoid.safety.rollout import BackupRollouts

    controller, q = Controller.from_scenario(scenario(**avoidance))
    steps, rollouts = [], []
    rollout = BackupRollouts.rollout

    def timed(*args: Any) -> Any:
        begin = perf_counter_ns()
        trajectory = rollout(*args)
        rollouts.append(1e-3 * (perf_counter_ns() - begin))
        return trajectory

    with patch.object(BackupRollouts, "rollout", timed):
        for k in range(LAP):
            begin = perf_counter_ns()
            v = controller.step(q, k * DT).v
            steps.append(1e-3 * (perf_counter_ns() - begin))
            q = pin.integrate(controller.scene.robot.model, q, DT * v)
    each = float(np.median(rollouts)) if rollouts else 0.0
    return *(float(p) for p in np.percentile(steps, [50, 99, 100])), len(rollouts) / LAP, each


def _kinds() -> Any:
    from qpavoid import Pose, Sample

    for count in MOVING:
        yield f"moving, {count}", _stepper(count)
    for kind in (Sample, Pose):
        for count in MOVING[1:]:
            updates = {f"o{i}": kind.at([2.0 + 0.1 * i, 0.0, 1.0]) for i in range(count)}
            yield f"given as {kind.__name__}, {count}", _stepper(0, updates)


def _stepper(moving: int, updates: dict[str, Any] | None = None) -> Callable[[float], Any]:
    """Return a function of time [s]: a control step of a scene in which the first so many obstacles move."""
    from qpavoid import Controller, Obstacle, Robot, build_scene, build_tasks
    from qpavoid.config import Circle, Fixed, Line, Sphere, Task
    from qpavoid.model.trajectory import build_motion

    random, obstacles = np.random.default_rng(3), []
    for i in range(OBSTACLES):
        direction = random.normal(size=3)
        place = 2.0 * random.uniform(0.9, 1.1) * direction / np.linalg.norm(direction)
        motion: Any = Fixed(position=tuple(place))
        if i < moving:
            line = Line(start=tuple(place), displacement=(0.2, 0.1, 0.1), speed=0.02)
            motion = Circle(center=tuple(place), radius=0.1, period=10.0) if i % 2 else line
        obstacles.append(Obstacle(f"o{i}", Sphere(radius=0.04), build_motion(motion), moves=i < moving))
    robot = Robot.load("panda")
    tasks = build_tasks([Task(frame="panda_hand_tcp", type="pose", motion=Fixed())], robot, robot.home)
    controller = Controller(build_scene(robot, obstacles), tasks, dt=DT)
    return lambda t: controller.step(robot.home, t, None, updates)


if __name__ == "__main__":
    main()
