"""`qpavoid bench serve`: from a client's request to its answer, and how much of that is the control step."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import typer

from qpavoid.errors import ConfigError
from qpavoid_bench.tables import RESULTS, describe_machine, table, write

_SCENARIO = """
robot: panda
duration: 1.0
dt: 0.01
tasks:
  - {frame: panda_hand_tcp, motion: {type: fixed}}
  - {type: posture, weight: 1.0e-3}
obstacles:
OBSTACLES
"""
_CAMERA = "  - {name: camera, shape: {type: point_cloud}, motion: {type: fixed, position: [0, 0, 0]}}"
_OBSTACLE = (
    "  - {name: ball%d, shape: {type: sphere, radius: 0.04}, motion: {type: fixed, position: [%.3f, %.3f, 0.45]}}"
)
_BALLS = 10
_WARM_UP = 200
"""Steps before those that are timed [-]."""


def serve(
    steps: Annotated[int, typer.Option(min=10, help="Steps of each kind that are timed.")] = 5_000,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
) -> None:
    """Time requests of a client in another process, over loopback: p50, p99 and the worst."""
    try:
        import msgpack  # noqa: F401
        import zmq  # noqa: F401
    except ModuleNotFoundError:
        raise ConfigError("qpavoid bench serve needs pyzmq and msgpack: pip install 'qpavoid[serve]'") from None
    print(write(out, "serve", _sections(steps)))


def _sections(steps: int) -> Iterator[str]:
    yield "# The service"
    yield (
        f"Round trips of a client in Python, `qpavoid serve` in another process of the same machine, {steps} steps of "
        f"each kind one after the other; a Panda among {_BALLS} balls. "
        f"{describe_machine('qpavoid', 'pyzmq', 'msgpack')}; load of the machine before: {os.getloadavg()[0]:.1f}."
    )
    head = [
        "request", "bytes", "p50 [µs]", "p99 [µs]", "worst [µs]", "server's time of the core, mean [µs]",
        "of which control step, p50 [µs]", "p99 [µs]",
    ]  # fmt: skip
    rows = []
    for kind in _REQUESTS:
        with _server("cloud" in kind) as (socket, pid):
            rows.append(_row(socket, pid, kind, steps))
    yield table(head, rows)
    yield (
        "With points, the time of the step includes sorting them into voxels. On a machine with more work than cores, "
        "round trips are mostly waiting for a core, twice each; the server's own work is in the column of its time."
    )


_REQUESTS = ("hello", "step", "step, 10 obstacles", "step, a cloud of 1000 points")


@contextmanager
def _server(has_cloud: bool) -> Iterator[tuple[Any, int]]:
    """Run a server, and yield a socket that is connected to it, and its process."""
    import zmq

    angles = np.linspace(0.0, 2.0 * np.pi, _BALLS, endpoint=False)
    balls = "\n".join(_OBSTACLE % (i, 0.8 * np.cos(a), 0.8 * np.sin(a)) for i, a in enumerate(angles.tolist()))
    with TemporaryDirectory() as folder:
        scenario = Path(folder) / "served.yaml"
        obstacles = f"{balls}\n{_CAMERA}" if has_cloud else balls
        scenario.write_text(_SCENARIO.replace("OBSTACLES", obstacles), encoding="utf-8")
        command = [sys.executable, "-m", "qpavoid", "serve", str(scenario), "--port", "0", "--heartbeat", "10"]
        context = zmq.Context()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                line = process.stdout.readline()
                if "steps: " not in line:
                    raise ConfigError("the server did not start")
                socket = context.socket(zmq.REQ)
                socket.setsockopt(zmq.RCVTIMEO, 30_000)
                socket.connect(line.partition("steps: ")[2].partition(",")[0])
                yield socket, process.pid
            finally:
                process.terminate()
                context.destroy(0)


def _core_time(pid: int) -> float:
    """Return the time that all threads of a process have had a core [s]; NaN where the system does not say."""
    threads = list(Path(f"/proc/{pid}/task").glob("*/schedstat"))
    return 1e-9 * sum(int(thread.read_text().split()[0]) for thread in threads) if threads else np.nan


def _row(socket: Any, pid: int, kind: str, steps: int) -> list[str]:
    """Time requests of a kind."""
    import msgpack

    hello = _ask(socket, [msgpack.packb({"version": 1, "type": "hello"})])[0]
    q, rng, clouds = np.array(hello["q0"]), np.random.default_rng(0), list[bytes]()
    fields: dict[str, Any] = {"version": 1, "type": "hello"}
    if kind != "hello":
        fields |= {"type": "step", "targets": {"panda_hand_tcp": {"position": [0.35, 0.0, 0.5]}}}
    if "obstacles" in kind:
        fields["obstacles"] = {
            f"ball{i}": {"position": [0.8, 0.08 * i, 0.45], "linear": [0.0, 0.0, 0.0]} for i in range(_BALLS)
        }
    if "cloud" in kind:
        fields["obstacles"] = {"camera": {"points": 0}}
        clouds = [rng.uniform([0.5, -0.5, 0.0], [1.0, 0.5, 1.0], (1000, 3)).astype("<f4").tobytes()]
    times, inner, size, core = [], [], 0, 0.0
    _ask(socket, [msgpack.packb({"version": 1, "type": "reset"})])
    for k in range(_WARM_UP + steps):
        core = _core_time(pid) if k == _WARM_UP else core
        if kind != "hello":
            fields["q"] = (q + 1e-4 * np.sin(0.1 * k)).tolist()
        frames = [msgpack.packb(fields), *clouds]
        answer, elapsed = _ask(socket, frames)
        if k >= _WARM_UP:
            times.append(elapsed)
            inner.append(float(answer.get("step_time", np.nan)))
            size = sum(map(len, frames))
    p50, p99, worst = 1e6 * np.percentile(times, [50, 99, 100])
    step = ["-", "-"] if kind == "hello" else [f"{1e6 * np.percentile(inner, p):.0f}" for p in (50, 99)]
    core = 1e6 * (_core_time(pid) - core) / steps
    return [kind, str(size), f"{p50:.0f}", f"{p99:.0f}", f"{worst:.0f}", f"{core:.0f}", *step]


def _ask(socket: Any, frames: list[bytes]) -> tuple[dict[str, Any], float]:
    """Return an answer, and the time that it took [s]."""
    import msgpack

    begin = perf_counter()
    socket.send_multipart(frames)
    answer = msgpack.unpackb(socket.recv())
    elapsed = perf_counter() - begin
    if answer["type"] == "error":
        raise ConfigError(f"the server refuses: {answer['text']}")
    return answer, elapsed
