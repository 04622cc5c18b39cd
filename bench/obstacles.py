"""`python -m bench.obstacles`: what a pair of each shape costs, and a tick against the number of points of a cloud."""

from __future__ import annotations

import argparse
import os
import platform
import tempfile
import warnings
from pathlib import Path
from time import perf_counter
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from qpavoid_bench.tick.robots import SHARE

from qpavoid import Avoidance, Controller, Obstacle, Points, Robot, Sample, Voxels, build_scene, build_tasks
from qpavoid.config import Box, Capsule, Cone, Cylinder, Ellipsoid, HalfSpace, Mesh, PointCloud, Sphere, Task
from qpavoid.geometry.bodies import MeshWarning
from qpavoid.model.solids import hull_of

RESULTS = Path(__file__).parent / "results" / "obstacles.md"
CLOUDS = (1_000, 3_000, 10_000, 30_000, 100_000)
TCP = "panda_hand_tcp"


def main() -> None:
    """Parses the options, measures, writes bench/results/obstacles.md and prints it."""
    parser = argparse.ArgumentParser(prog="python -m bench.obstacles", description=__doc__)
    parser.add_argument("--rounds", type=int, default=7, help="times that each thing is timed (7); medians count")
    parser.add_argument("--ticks", type=int, default=300, help="ticks of a round (300)")
    options = parser.parse_args()
    warnings.simplefilter("ignore", MeshWarning)
    lines = [
        "# Obstacles",
        "",
        f"{platform.system()}, {os.cpu_count()} CPUs, Python {platform.python_version()}, numpy {np.__version__}, "
        f"coal {coal.__version__}. One thread; the machine was shared.",
        "",
        "## A pair",
        "",
        "Time of coal's distance per pair [µs], called for 500 pairs at once: bodies 1 to 30 cm from the obstacle.",
        "",
        *pair_table(options.rounds),
        "",
        "## A cloud",
        "",
        "A Panda swings beside a shelf of points, resolution 2 cm, 8 voxels a body, influence distance 0.10 m.",
        "`update`: the tick in which a picture comes in, points sorted into voxels by the tick itself.",
        "",
        *cloud_table(options.rounds, options.ticks),
    ]
    text = "\n".join(lines) + "\n"
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(text)
    print(text)


# --- pairs --------------------------------------------------------------------------------------------------------


def pair_table(rounds: int) -> list[str]:
    """Rows: shapes of obstacles; columns: shapes of bodies."""
    rng = np.random.default_rng(0)
    bodies = {"sphere": coal.Sphere(0.06), "capsule": coal.Capsule(0.05, 0.25), "box": coal.Box(0.1, 0.1, 0.2),
              "hull": hull_of(0.08 * rng.normal(size=(60, 3)))}  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = torus(Path(folder) / "ring.stl")
        obstacles = {
            "sphere": Sphere(radius=0.1), "capsule": Capsule(radius=0.08, length=0.3), "box": Box(size=(0.2, 0.3, 0.1)),
            "cylinder": Cylinder(radius=0.1, length=0.2), "cone": Cone(radius=0.1, length=0.2),
            "ellipsoid": Ellipsoid(radii=(0.1, 0.2, 0.05)), "half_space": HalfSpace(),
            "mesh, convex": Mesh(path=str(path), method="convex"),
            "mesh, decomposed (16 pieces)": Mesh(path=str(path)),
            "mesh, surface (1536 triangles)": Mesh(path=str(path), method="surface"),
        }  # fmt: skip
        lines = [f"| obstacle | {' | '.join(bodies)} |", f"|---|{'---:|' * len(bodies)}"]
        for name, shape in obstacles.items():
            scene = build_scene(Robot.load("panda"), [Obstacle.at("it", shape, [0, 0, 0])])
            solids = [g.geometry for g in scene.geometry.geometryObjects[len(scene.body_names) :]]
            times = [f"{1e6 * pair_time(body, solids, rounds, rng):.2f}" for body in bodies.values()]
            lines.append(f"| {name} | {' | '.join(times)} |")
    return lines


def pair_time(body: Any, solids: list[Any], rounds: int, rng: Any) -> float:
    """Median time of one body against all solids of an obstacle [s]."""
    model, count = pin.GeometryModel(), 500
    for i, solid in enumerate(solids):
        model.addGeometryObject(pin.GeometryObject(f"solid{i}", 0, 0, pin.SE3.Identity(), solid))
    placed = 0
    while placed < count:
        place = pin.SE3.Random()
        place.translation = rng.uniform(-0.6, 0.6, 3)
        there = coal.Transform3s(place.rotation, place.translation)
        apart = min(
            coal.distance(body, there, solid, coal.Transform3s(), coal.DistanceRequest(), coal.DistanceResult())
            for solid in solids
        )
        if 0.01 < apart < 0.3:
            index = model.addGeometryObject(pin.GeometryObject(f"body{placed}", 0, 0, place, body))
            for i in range(len(solids)):
                model.addCollisionPair(pin.CollisionPair(i, index))
            placed += 1
    data, empty = model.createData(), pin.Model()
    pin.updateGeometryPlacements(empty, empty.createData(), model, data)
    for request in data.distanceRequests:
        request.gjk_tolerance = 1e-10
    times = []
    for _ in range(rounds + 1):
        begin = perf_counter()
        pin.computeDistances(model, data)
        times.append((perf_counter() - begin) / count)
    return float(np.median(times[1:]))


def torus(path: Path, around: int = 48, across: int = 16) -> Path:
    """An STL of a ring."""
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, around + 1), np.linspace(0, 2 * np.pi, across + 1), indexing="ij")
    r = 0.15 + 0.05 * np.cos(b)
    grid = np.stack((r * np.cos(a), r * np.sin(a), 0.05 * np.sin(b)), axis=-1)
    p, q, s, t = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    triangles = np.concatenate([np.stack(x, axis=2).reshape(-1, 3, 3) for x in ((p, q, s), (p, s, t))])
    facets = [
        "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in f) + "endloop\nendfacet\n"
        for f in triangles
    ]
    path.write_text(f"solid a\n{''.join(facets)}endsolid a\n")
    return path


# --- clouds -------------------------------------------------------------------------------------------------------


def shelf(count: int) -> Any:
    """Points (count, 3) on the boards of a shelf in front of the robot [m]."""
    rng = np.random.default_rng(1)
    boards = [([0.5, -0.6, z], [0.4, 0, 0], [0, 1.2, 0]) for z in (0.02, 0.3, 0.75, 1.1)]
    boards += [([0.5, y, 0.0], [0.4, 0, 0], [0, 0, 1.1]) for y in (-0.6, 0.6)]
    boards += [([0.9, -0.6, 0], [0, 1.2, 0], [0, 0, 1.1])]
    area = np.array([np.linalg.norm(np.cross(u, v)) for _, u, v in boards])
    parts = rng.choice(len(boards), count, p=area / area.sum())
    origin, u, v = (np.array([board[k] for board in boards])[parts] for k in range(3))
    s, t = rng.uniform(size=(2, count, 1))
    return origin + s * u + t * v + rng.normal(0, 0.002, (count, 3))


def cloud_table(rounds: int, ticks: int) -> list[str]:
    """Medians and 99th percentiles of the tick."""
    lines = [
        "| points | voxels | bodies | tick, median [µs] | 99 % [µs] | update [ms] | sorting alone [ms] |",
        "|---:|---:|---|---:|---:|---:|---:|",
    ]
    robots = {"capsules": Robot.load("panda"), "hulls": convex_panda()}
    for count in (0, *CLOUDS):
        for kind, robot in robots.items():
            lines.append(cloud_row(count, kind, robot, rounds, ticks if kind == "capsules" else ticks // 3))
    return lines


def convex_panda() -> Robot:
    """The Panda with the hulls of its meshes."""
    fingers = {"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0}
    return Robot.from_urdf(SHARE / "panda_description/urdf/panda.urdf", bodies="convex", lock=fingers)


def cloud_row(count: int, kind: str, robot: Robot, rounds: int, ticks: int) -> str:
    """One line of the table."""
    obstacles = [Obstacle.at("camera", PointCloud(), [0, 0, 0])] if count else []
    tasks = build_tasks([Task(frame=TCP)], robot, robot.home)
    controller = Controller(build_scene(robot, obstacles), tasks, "qp", 0.005, Avoidance(d1=0.02, d2=0.10))
    points, q = shelf(count), robot.home.copy()
    sorting = []
    for _ in range(rounds if count else 0):
        begin = perf_counter()
        voxels = Voxels.of(points, PointCloud().resolution)
        sorting.append(perf_counter() - begin)
    times, updates = [], []
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    start = data.oMf[robot.model.getFrameId(TCP)].translation.copy()
    for k in range(rounds * ticks):
        t = k * 0.005
        sway = np.array([0.1 * np.sin(t), 0.25 * np.sin(0.7 * t), 0.1 * np.sin(1.3 * t)])
        target = {TCP: Sample.at(start + sway)}
        given = {"camera": Points(points, at_rest=True)} if count and k % 60 == 0 else None
        begin = perf_counter()
        solution = controller.step(q, targets=target, obstacles=given)
        (updates if given else times).append(perf_counter() - begin)
        q = pin.integrate(robot.model, q, 0.005 * solution.v)
    median, late = (1e6 * np.percentile(times, share) for share in (50, 99))
    update = f"{1e3 * np.median(updates):.1f} | {1e3 * np.median(sorting):.1f}" if count else "- | -"
    return f"| {count} | {len(voxels.centers) if count else 0} | {kind} | {median:.0f} | {late:.0f} | {update} |"


if __name__ == "__main__":
    main()
