"""QPs of real runs: all that the `qp` solver passes to its back end, in the order of the control steps.

Steps in which tracking alone is safe have no QP. A step without a velocity that meets all constraints has several: the
one without a solution, those that compute the slacks, and the one with relaxed rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from qpavoid_bench.tick.build import build, make_scene

from qpavoid import Avoidance, Controller, Sample, ScenarioConfig, build_tasks, load_scenario
from qpavoid.config import QpSolver, Task
from qpavoid.config.shipped import scenario_names
from qpavoid.problem import Array

FOLDER = Path(__file__).parent / "recordings"


class QP(NamedTuple):
    """min ½ xᵀP x + qᵀx subject to G x >= h, lower <= x <= upper."""

    P: Array
    """(n, n)."""
    q: Array
    """(n,)."""
    G: Array
    """(m, n)."""
    h: Array
    """(m,)."""
    lower: Array
    """(n,)."""
    upper: Array
    """(n,)."""


class Run(NamedTuple):
    """The QPs of one closed loop."""

    name: str
    dt: float
    """Control period [s]."""
    ticks: int
    """Ticks of the loop, with or without a QP."""
    qps: list[QP]


def runs(every: int = 1) -> list[Run]:
    """All runs, recorded in this process.

    Args:
        every: keep the QPs of every so many ticks only; the back ends' warm starts get older with it.
    """
    scenarios = [load_scenario(name) for name in scenario_names()]
    recorded = [_of_scenario(s, every) for s in scenarios if s.solver.name == "qp"]
    return [*recorded, *(_of_scenario(make(), every) for make in (_panda, _squeezed, _both_arms)), _humanoid(every)]


def save(recorded: Iterable[Run], folder: Path = FOLDER) -> None:
    """One NAME.npz a run: sizes (k, 2) of n and m, and each of P, q, G, h, lower, upper laid end to end."""
    folder.mkdir(parents=True, exist_ok=True)
    for run in recorded:
        fields = {name: [getattr(qp, name).ravel() for qp in run.qps] for name in QP._fields}
        flat = {name: np.concatenate([*arrays, np.empty(0)]) for name, arrays in fields.items()}
        size = np.array([(len(qp.q), len(qp.h)) for qp in run.qps], dtype=np.intp).reshape(-1, 2)
        np.savez_compressed(folder / f"{run.name}.npz", size=size, dt=run.dt, ticks=run.ticks, **flat)


def load(path: Path) -> Run:
    """A run that `save` wrote."""
    with np.load(path) as file:
        data = {name: file[name] for name in file.files}
    n, m = data["size"].T
    shapes = {"P": (n, n), "q": (n,), "G": (m, n), "h": (m,), "lower": (n,), "upper": (n,)}
    pieces = {}
    for name, axes in shapes.items():
        flat = np.split(data[name], np.cumsum(np.prod(axes, axis=0))[:-1])
        pieces[name] = [piece.reshape(shape) for piece, shape in zip(flat, zip(*axes, strict=True), strict=True)]
    qps = [QP(*arrays) for arrays in zip(*(pieces[name] for name in QP._fields), strict=True)]
    return Run(path.stem, float(data["dt"]), int(data["ticks"]), qps)


def _recorded(
    name: str, controller: Controller, q: Array, ticks: int, every: int, targets: Callable[[int], Any] = lambda k: None
) -> Run:
    """Closes the loop for some ticks."""
    solver: Any = controller.solver
    back_end, qps, keep = solver._backend, [], [True]

    def recording(*qp: Array) -> Array | None:
        if keep[0]:
            qps.append(QP(*(np.array(array) for array in qp)))
        answer: Array | None = back_end(*qp)
        return answer

    solver._backend = recording
    for k in range(ticks):
        keep[0] = k % every == 0
        v = controller.step(q, k * controller.dt, targets(k)).v
        q = pin.integrate(controller.scene.robot.model, q, v * controller.dt)
    return Run(name, controller.dt, ticks, qps)


def _of_scenario(scenario: ScenarioConfig, every: int) -> Run:
    solver = QpSolver(backend="daqp")
    controller, q = Controller.from_scenario(scenario.model_copy(update={"solver": solver}))
    return _recorded(scenario.source.stem, controller, q, round(scenario.duration / scenario.dt) + 1, every)


def _panda() -> ScenarioConfig:
    """A Panda carries its tool round a circle through 20 balls and boxes, some on its path, two of them moving."""
    random = np.random.default_rng(3)
    obstacles: list[dict[str, Any]] = []
    while len(obstacles) < 20:
        i = len(obstacles)
        angle, off = random.uniform(0.0, 2.0 * np.pi), random.normal(size=3)
        reach = random.uniform(0.10, 0.22) if i < 10 else random.uniform(0.25, 0.45)
        position = np.array([0.45, 0.20 * np.cos(angle), 0.45 + 0.20 * np.sin(angle)])
        position += reach * off / np.linalg.norm(off)
        if position[0] < 0.40:
            continue  # leave the arm itself some room
        shape = {"type": "sphere", "radius": 0.04} if i % 2 else {"type": "box", "size": [0.06, 0.08, 0.05]}
        motion: dict[str, Any] = {"type": "fixed", "position": position.tolist()}
        if i < 2:
            motion = {"type": "circle", "center": position.tolist(), "radius": 0.05, "period": 4.0 + i}
        obstacles.append({"name": f"obstacle{i}", "shape": shape, "motion": motion})
    circle = {
        "type": "circle",
        "center": [0.45, 0.0, 0.45],
        "radius": 0.20,
        "normal": [1, 0, 0],
        "period": 6.0,
        "start_direction": [0, 0, 1],
    }
    return ScenarioConfig.model_validate(
        {
            "robot": "panda",
            "tasks": [{"frame": "panda_hand_tcp", "type": "pose", "motion": circle, "max_speed": 0.5}],
            "obstacles": obstacles,
            "avoidance": {"d1": 0.02, "d2": 0.15},
            "duration": 12,
        }
    ).with_source(Path("panda_20"))


def _squeezed() -> ScenarioConfig:
    """Two balls come from both sides and hold a Panda's hand between them: rows contradict each other."""
    balls = [
        {
            "name": f"ball{i}",
            "shape": {"type": "sphere", "radius": 0.06},
            "motion": {
                "type": "waypoints",
                "times": [0.0, 1.5, 2.5, 4.0],
                "positions": [[0.31, 0.6 * side, 0.59], *2 * [[0.31, 0.085 * side, 0.59]], [0.31, 0.6 * side, 0.59]],
                "profile": "smooth",
            },
        }
        for i, side in enumerate((-1.0, 1.0))
    ]
    return ScenarioConfig.model_validate(
        {
            "robot": "panda",
            "tasks": [{"frame": "panda_hand_tcp", "type": "pose"}],
            "obstacles": balls,
            "avoidance": {"d1": 0.03, "d2": 0.15},
            "duration": 4,
        }
    ).with_source(Path("squeezed"))


def _both_arms() -> ScenarioConfig:
    """Both arms of the paper's robot move: the tools cross in front of it, past a ball."""
    base = load_scenario("situation2").model_dump()
    right = {"frame": "right_tool", "motion": {"type": "line", "displacement": [0, 0.5, 0], "speed": 0.08}}
    ball = {
        "name": "ball",
        "shape": {"type": "sphere", "radius": 0.05},
        "motion": {"type": "fixed", "position": [0.45, 0.0, 0.75]},
    }
    limits = {"saturate": True}
    changed = {"tasks": [*base["tasks"], right], "obstacles": [ball], "lock": [], "limits": limits, "duration": 11}
    return ScenarioConfig.model_validate({**base, "tracking_damping": 0.01, **changed}).with_source(Path("both_arms"))


def _humanoid(every: int) -> Run:
    """The G1 of bench.tick, closed loop: 35 velocities, four pose tasks, 8 obstacles, self-collision."""
    workload = build("g1-8@0.30")
    scene = make_scene(workload)
    names = [frame.name for frame in workload.frames]
    tasks = build_tasks([Task(frame=name, type="pose", gain=20.0) for name in names], scene.robot, workload.q[0])
    controller = Controller(scene, tasks, "qp:daqp", workload.dt, Avoidance(d1=workload.d_min, d2=workload.influence))

    def targets(k: int) -> dict[str, Sample]:
        poses = workload.targets[k]
        return {name: Sample.at(pose[:3, 3], pose[:3, :3]) for name, pose in zip(names, poses, strict=True)}

    return _recorded("g1", controller, workload.q[0], 600, every, targets)
