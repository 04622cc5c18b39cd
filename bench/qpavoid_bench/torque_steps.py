"""`qpavoid bench dynamics`: the step at the torque level beside that of the velocity level, and beside TSID."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import thread_time
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from qpavoid import Controller, load_scenario
from qpavoid.errors import ConfigError
from qpavoid.problem import Array
from qpavoid_bench.tables import RESULTS, describe_machine, table, write

_TSID_LOOP = Path(__file__).parent / "libraries" / "foreign" / "tsid_loop.py"
_WARM_UP = 200
"""Steps before those that are timed [-]."""
_EVERY = 20
"""Steps from one count of the pairs in range to the next."""
_D2 = 0.08
"""d2 of the humanoid [m]: so far that about 20 pairs are in range."""


class Timed(NamedTuple):
    """Times of steps, and the states that they were of."""

    torque: Array
    """(n,) of each step at the torque level [s]."""
    velocity: Array
    """(n,) of each step at the velocity level, at the same states [s]; none of a robot that stands."""
    decision: Array
    """(n,) of the part of the step from the problem to the torques, as the clock on the wall has it [s]."""
    pairs: Array
    """Pairs in range, now and then."""
    q: Array
    v: Array


def dynamics(
    steps: Annotated[int, typer.Option(min=10, help="Steps that are timed.")] = 3_500,
    tsid: Annotated[Path | None, typer.Option(metavar="PYTHON", help="Interpreter that has TSID, to time it.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
) -> None:
    """Time control steps at the torque level: of a Panda, and of a G1 on its feet beside TSID."""
    if tsid is not None and not tsid.is_file():
        raise ConfigError(f"--tsid {tsid}: no such interpreter; give the `python` of an environment with tsid")
    print(write(out, "dynamics", _sections(steps, tsid)))


def _sections(steps: int, tsid: Path | None) -> Iterator[str]:
    yield "# Steps at the torque level"
    yield (
        f"{steps} steps of closed loops in MuJoCo, one after the other. Times are those that the thread had a core. "
        f"{describe_machine('qpavoid', 'pin', 'mujoco')}; load of the machine before: {os.getloadavg()[0]:.1f}."
    )
    panda = _play("panda_torque", ["plant={armature: 0.1, friction: 0.3, damping: 0.5}"], steps, beside=True)
    g1 = _play("g1_wave", [f"avoidance.d2={_D2}"], steps, beside=False)
    rows = [
        ("Panda, velocity level", _pairs(panda), *_percentiles(panda.velocity), "-"),
        ("Panda, torque level", _pairs(panda), *_percentiles(panda.torque), _decision(panda)),
        ("G1 on two feet, torque level", _pairs(g1), *_percentiles(g1.torque), _decision(g1)),
    ]
    if tsid is not None:
        theirs = _time_tsid(tsid, g1)
        sizes = f"{theirs['unknowns']} unknowns, {theirs['equations']} equations, {theirs['inequalities']} inequalities"
        for name, part in (("computeProblemData", "data"), ("solve", "solve")):
            rows.append((f"TSID, G1 on two feet, {name}", "none", *_percentiles(np.array(theirs[part])), "-"))
        whole = np.add(theirs["data"], theirs["solve"])
        rows.append(("TSID, both", "none", *_percentiles(whole), "-"))
    head = ("step", "pairs in range", "p50 [µs]", "p99 [µs]", "worst [µs]", "of which deciding, p50 / p99 [µs]")
    yield table(head, rows)
    ratio = np.median(panda.torque / panda.velocity)
    yield f"Panda: median ratio of both levels at the same state {ratio:.2f}."
    if tsid is not None:
        yield (
            f"TSID is given the states of the G1, the same feet, corners, tasks and torque limits, and no avoidance: "
            f"{sizes}, solved in {theirs['solved']} of {len(g1.q)} states by SolverHQuadProgFast."
        )
    yield (
        "Deciding is from the problem to the torques (elimination, QP, look-ahead), by the clock on the wall: on a "
        "machine with more work than cores, its 99th percentile is waiting for one."
    )


def _play(name: str, overrides: list[str], steps: int, beside: bool) -> Timed:
    """Play a scenario on its plant and time its steps; `beside` also those of the velocity level, by turns."""
    from qpavoid.run.simulate import make_plant

    scenario = load_scenario(name, overrides)
    assert scenario.plant is not None
    controller, q0 = Controller.from_scenario(scenario)
    counting = controller.clone()
    kinematic = None
    if beside:
        kinematic, _ = Controller.from_scenario(load_scenario(name, ["dynamics=null"]))
    plant = make_plant(controller.scene.robot, q0, scenario.plant, scenario.contacts)
    times: dict[str, list[float]] = {"torque": [], "velocity": [], "decision": []}
    states, pairs = [], []
    for k in range(_WARM_UP + steps):
        q, v = plant.measure()
        begin = thread_time()
        solution = controller.step(q, k * scenario.dt, v=v)
        times["torque"].append(thread_time() - begin)
        times["decision"].append(solution.solve_time)
        if kinematic is not None:
            begin = thread_time()
            kinematic.step(q, k * scenario.dt, v=v)
            times["velocity"].append(thread_time() - begin)
        if k % _EVERY == 0:
            counting.reset(v)
            pairs.append(len(counting.tick(q, k * scenario.dt, v=v).problem.avoidance.d))
        states.append((q, v))
        plant.follow(solution, scenario.dt)
    q, v = (np.array(part)[_WARM_UP:] for part in zip(*states, strict=True))
    return Timed(
        **{name: np.array(values)[_WARM_UP:] for name, values in times.items()}, pairs=np.array(pairs), q=q, v=v
    )


def _time_tsid(python: Path, g1: Timed) -> dict[str, Any]:
    """Return what TSID took for the same states.

    Raises:
        ConfigError: it fails there.
    """
    scenario = load_scenario("g1_wave")
    robot = Controller.from_scenario(scenario)[0].scene.robot
    settings = {
        "urdf": str(robot.urdf), "folder": str(Path(robot.urdf).parent), "hand": "right_rubber_hand",
        "pelvis": "pelvis", "feet": [contact.frame for contact in scenario.contacts],
        "corners": scenario.contacts[0].vertices,
        "friction": scenario.contacts[0].friction, "stiffness": 180.0, "damping": 60.0,
    }  # fmt: skip
    with TemporaryDirectory() as folder:
        file = Path(folder) / "states.npz"
        np.savez(file, q=g1.q, v=g1.v, torque=robot.torque_limits()[6:], settings=json.dumps(settings))
        done = subprocess.run([str(python), str(_TSID_LOOP), str(file)], capture_output=True, text=True, check=False)
    if done.returncode:
        last = done.stderr.strip().split("\n")[-1]
        raise ConfigError(f"--tsid {python}: TSID cannot be timed there: {last}")
    answer: dict[str, Any] = json.loads(done.stdout.strip().split("\n")[-1])
    return answer


def _percentiles(times: Array) -> list[str]:
    return [f"{1e6 * value:.0f}" for value in np.percentile(times, [50, 99, 100])]


def _pairs(timed: Timed) -> str:
    low, high = np.percentile(timed.pairs, [5, 95])
    return f"{np.median(timed.pairs):.0f} ({low:.0f} to {high:.0f})"


def _decision(timed: Timed) -> str:
    return " / ".join(f"{1e6 * value:.0f}" for value in np.percentile(timed.decision, [50, 99]))
