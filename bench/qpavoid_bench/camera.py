"""`qpavoid bench camera`: what a depth image of 640×480 costs, in its process and in the loop."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter, process_time
from typing import Annotated, Any

import numpy as np
import typer

from qpavoid import Obstacle, Robot, build_scene
from qpavoid.config import Box, Sphere
from qpavoid.errors import ConfigError
from qpavoid_bench.tables import RESULTS, describe_machine, table, write

_WARM_UP = 10
"""Images before those that are timed [-]."""


def camera(
    images: Annotated[int, typer.Option(min=10, help="Images that are timed.")] = 300,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
) -> None:
    """Time depth images that MuJoCo renders of a Panda, a table, a wall and ten balls."""
    for library in ("egl", "osmesa"):
        os.environ.setdefault("MUJOCO_GL", library)
    print(write(out, "camera", _sections(images)))


def _sections(images: int) -> Iterator[str]:
    import mujoco

    from qpavoid.perception.depth_voxels import DepthVoxels
    from qpavoid.perception.own_bodies import OwnBodiesAt
    from qpavoid.perception.process import Perception
    from qpavoid.perception.rendering import RenderedCamera
    from qpavoid.run.mujoco import build

    robot, rng = Robot.load("panda"), np.random.default_rng(0)
    world = build(build_scene(robot, _obstacles(rng)), robot.home)
    view = mujoco.MjvCamera()
    view.lookat, view.distance, view.azimuth, view.elevation = [0.3, 0.0, 0.4], 1.6, 140.0, -20.0
    rendered = RenderedCamera(world.model, world.data, view)
    depth, lens = rendered.depth(world.data), rendered.camera
    own, sorter = OwnBodiesAt(robot, lens), DepthVoxels(lens)
    pose, wall, cpu, count = own.place(robot.home), list[float](), list[float](), 0
    for k in range(_WARM_UP + images):
        begin, begin_cpu = perf_counter(), process_time()
        count = len(sorter.voxels(depth, own.arrays, pose, 0.05 * k).centers)
        wall.append(perf_counter() - begin)
        cpu.append(process_time() - begin_cpu)
    submit, latest = _loop_times(Perception, robot, lens, depth, images)
    rendered.close()
    yield "# A depth camera"
    yield (
        f"{images} images of {lens.width}x{lens.height} pixels: a Panda, a table, a wall and ten balls, {count} voxels "
        f"of 2 cm. {describe_machine('qpavoid', 'numpy', 'numba', 'mujoco')}; load of the machine: "
        f"{os.getloadavg()[0]:.1f}."
    )
    rows = [
        ("an image into voxels, time of the core", cpu), ("the same, time of the clock", wall),
        ("`submit`, in the camera's thread", submit), ("`latest` of a new picture, in the loop", latest),
    ]  # fmt: skip
    yield table(
        ["", "p50 [ms]", "p99 [ms]"],
        [[name, *(f"{1e3 * np.percentile(times[_WARM_UP:], p):.3f}" for p in (50, 99))] for name, times in rows],
    )


def _obstacles(rng: np.random.Generator) -> list[Obstacle]:
    balls = rng.uniform([-0.2, -0.7, 0.1], [0.8, -0.4, 0.8], (10, 3))
    return [
        Obstacle.at("table", Box(size=(2.0, 2.0, 0.02)), [0.3, 0.0, -0.02]),
        Obstacle.at("wall", Box(size=(0.02, 2.0, 2.0)), [-0.6, 0.0, 1.0]),
        *[Obstacle.at(f"ball {i}", Sphere(radius=0.06), place) for i, place in enumerate(balls)],
    ]


def _loop_times(perception: Any, robot: Robot, lens: Any, depth: Any, images: int) -> tuple[list[float], list[float]]:
    """Return the times of `submit` and of `latest` of as many images, one after the other [s]."""
    submit, latest = list[float](), list[float]()
    with perception(robot, lens) as camera:
        for k in range(_WARM_UP + images):
            begin = perf_counter()
            camera.submit(depth, 0.05 * k, robot.home)
            submit.append(perf_counter() - begin)
            points = None
            while points is None:
                begin = perf_counter()
                points = camera.latest(0.05 * k)
                elapsed = perf_counter() - begin
                if camera.fault or not camera.is_alive:
                    raise ConfigError(f"no points: {camera.fault or 'the process ended'}")
            latest.append(elapsed)
    return submit, latest
