"""`python -m bench.meshes`: what a pair of meshes costs against hulls and capsules, and what the cache saves."""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import tempfile
import warnings
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pinocchio as pin
from qpavoid_bench.tick.robots import ROBOTS, SHARE

from qpavoid import Robot
from qpavoid.model.notes import RobotWarning

RESULTS = Path(__file__).parent / "results" / "meshes.md"
KINDS = ("mesh", "convex", "capsule")
MEASURED = ("panda", "g1")
LOADED = {
    "panda": "panda_description/urdf/panda.urdf",
    "g1": "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    "talos": "talos_data/robots/talos_full_v2.urdf",
}


def main() -> None:
    """Parse the options, measure, write bench/results/meshes.md and print it."""
    parser = argparse.ArgumentParser(prog="python -m bench.meshes", description=__doc__)
    parser.add_argument("--steps", type=int, default=30, help="configurations of the swing (30)")
    parser.add_argument("--rounds", type=int, default=3, help="times that the swing is gone through (3)")
    parser.add_argument("--loads", type=int, default=5, help="times that each robot is loaded (5)")
    options = parser.parse_args()
    warnings.simplefilter("ignore", RobotWarning)
    lines = [
        "# Meshes",
        "",
        f"{platform.system()}, {os.cpu_count()} CPUs, Python {platform.python_version()}, numpy {np.__version__}, "
        f"Pinocchio {pin.__version__}; one thread; load of the machine before: {os.getloadavg()[0]:.1f}.",
        "",
        "## One distance",
        "",
        f"The robot swings by ±0.3 rad about its home pose in {options.steps} steps; what each step takes is the least "
        f"of {options.rounds} rounds. The pairs are the same for all three kinds of bodies: those of its own links, "
        "without those that always touch for one of the kinds. `all pairs`: one call for all of them, divided by their "
        "number, mean over the swing. The rest: each pair alone, less what a call without pairs takes; mean over the "
        "swing, then the distribution over the pairs.",
        "",
        "| robot | pairs | bodies | triangles or faces | all pairs [µs] | median pair [µs] | 5 % of pairs above [µs] | "
        "slowest pair [µs] |",
        "|---|---:|---|---:|---:|---:|---:|---:|",
    ]
    for name in MEASURED:
        lines += _distances(name, options.steps, options.rounds)
    lines += [
        "",
        "## Loading a robot",
        "",
        f"Fastest of {options.loads} in one process, in turns with the cache off, empty, and filled.",
        "",
        "| robot | bodies | off [ms] | empty [ms] | filled [ms] | files | size [kB] |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for name, kind in [("panda", "capsule"), ("panda", "convex"), ("g1", "convex"), ("talos", "convex")]:
        lines.append(_loading(name, kind, options.loads))
    text = "\n".join(lines) + "\n"
    RESULTS.write_text(text)
    print(text)


def _distances(name: str, steps: int, rounds: int) -> list[str]:
    spec = ROBOTS[name]
    fields = {"home": spec.home, "lock": spec.lock}
    robots = {kind: Robot.from_urdf(SHARE / spec.urdf, bodies=kind, **fields) for kind in KINDS}
    pairs = sorted(set.intersection(*({(p.first, p.second) for p in r.bodies.collisionPairs} for r in robots.values())))
    lines = []
    for kind, robot in robots.items():
        together = _time(robot, pairs, steps, rounds) / len(pairs)
        nothing = _time(robot, [], steps, rounds)
        alone = [_time(robot, [pair], steps, rounds) - nothing for pair in pairs]
        numbers = [together, *np.quantile(alone, [0.5, 0.95, 1.0])]
        cells = " | ".join(f"{1e6 * number:.2g}" if number < 1e-4 else f"{1e6 * number:.0f}" for number in numbers)
        lines.append(f"| {name} | {len(pairs)} | {kind} | {_faces(robot)} | {cells} |")
    return lines


def _time(robot: Robot, pairs: list[tuple[int, int]], steps: int, rounds: int) -> float:
    """Time the distances of some pairs at a step of the swing; the mean [s]."""
    geometry = pin.GeometryModel(robot.bodies)
    geometry.removeAllCollisionPairs()
    for a, b in pairs:
        geometry.addCollisionPair(pin.CollisionPair(a, b))
    data, of_model = geometry.createData(), robot.model.createData()
    for request in data.distanceRequests:
        request.gjk_tolerance = 1e-10  # as in a control step
    phase = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, robot.model.nv)
    taken = np.empty((rounds, steps))
    for i in np.ndindex(taken.shape):
        q = pin.integrate(robot.model, robot.home, 0.3 * np.sin(2.0 * np.pi * i[1] / steps + phase))
        pin.updateGeometryPlacements(robot.model, of_model, geometry, data, q)
        begin = perf_counter()
        pin.computeDistances(geometry, data)
        taken[i] = perf_counter() - begin
    return float(taken.min(axis=0).mean())


def _faces(robot: Robot) -> str:
    def count(geometry: Any) -> int:
        return int(getattr(geometry, "num_tris", 0) or getattr(geometry, "num_polygons", 0))

    return f"{sum(count(body.geometry) for body in robot.bodies.geometryObjects):,}"


def _loading(name: str, kind: str, loads: int) -> str:
    def load() -> float:
        begin = perf_counter()
        Robot.from_urdf(SHARE / LOADED[name], bodies=kind)
        return perf_counter() - begin

    before = os.environ.get("QPAVOID_CACHE")
    off, empty, filled = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "cache"
        for _ in range(loads):
            os.environ["QPAVOID_CACHE"] = "0"
            off.append(load())
            os.environ["QPAVOID_CACHE"] = str(cache)
            shutil.rmtree(cache, ignore_errors=True)
            empty.append(load())
            filled.append(load())
        sizes = [path.stat().st_size for path in cache.iterdir()]
    if before is None:
        del os.environ["QPAVOID_CACHE"]
    else:
        os.environ["QPAVOID_CACHE"] = before
    cells = " | ".join(f"{1e3 * seconds:.0f}" for seconds in map(min, (off, empty, filled)))
    return f"| {name} | {kind} | {cells} | {len(sizes)} | {sum(sizes) / 1e3:.0f} |"


if __name__ == "__main__":
    main()
