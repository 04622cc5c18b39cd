"""A library in a process of its own: run as a file by the interpreter that has it, answers one request at a time.

Arguments: the file descriptor of a connection, and the module of an adapter with `Library`, made from a scene. Each
request is the name of a method of `Worker` and its arguments, each answer what that returns, or what it raised, and
how long it computed [s]. Knows nothing of qpavoid, which the interpreter need not have.
"""

from __future__ import annotations

import gc
import pickle
import sys
from importlib import import_module
from importlib.metadata import version
from multiprocessing.connection import Connection
from time import perf_counter_ns, process_time
from types import SimpleNamespace
from typing import Any

import numpy as np


class Worker:
    """Serves one adapter."""

    def __init__(self, module: str) -> None:
        self._make: Any = import_module(module).Library
        self.library: Any = None
        self._inputs: list[tuple[Any, Any]] = []

    def versions(self, packages: tuple[str, ...]) -> str:
        """Return the versions of some packages."""
        return ", ".join(f"{package} {version(package)}" for package in packages)

    def setup(self, scene: Any) -> None:
        """Build the library's own model of a scene."""
        self.library = None
        gc.unfreeze()
        self.library = self._make(SimpleNamespace(**scene) if isinstance(scene, dict) else scene)
        gc.collect()
        gc.freeze()  # what a library is made of need not be looked at before each round

    def step(self, q: Any, poses: Any, moved: dict[int, Any]) -> Any:
        """Return the velocity (nv,) towards poses (f, 4, 4) of the frames, with obstacles where they are now."""
        library = self.library
        if moved:
            library.move(moved)
        return library.velocity(library.step(library.configuration(q), library.targets(poses)))

    def observe(self, q: Any) -> Any:
        """Return frames (f, 4, 4) and distances (m,) at a configuration."""
        q = self.library.configuration(q)
        return self.library.frames(q), self.library.distances(q)

    def record(self, q: Any, poses: Any) -> None:
        """Take the configurations (T, nq) and targets (T, f, 4, 4) that are played back."""
        library = self.library
        self._inputs = [(library.configuration(a), library.targets(b)) for a, b in zip(q, poses, strict=True)]

    def check(self, ticks: list[int]) -> dict[str, Any]:
        """Return frames, distances and velocities at some steps."""
        library, chosen = self.library, [self._inputs[tick] for tick in ticks]
        return {
            "frames": np.array([library.frames(q) for q, _ in chosen]),
            "distances": np.array([library.distances(q) for q, _ in chosen]),
            "velocities": np.array([library.velocity(library.step(*inputs)) for inputs in chosen]),
        }

    def round(self, ticks: list[int], warmup: int) -> list[int]:
        """Return the time of each step but the first few [ns]; the collector runs before, and stays on."""
        step, advance = self.library.step, getattr(self.library, "advance", None)
        gc.collect()
        times = []
        for tick in ticks:
            q, targets = self._inputs[tick] if self._inputs else (None, None)
            begin = perf_counter_ns()
            v = step(q, targets)
            times.append(perf_counter_ns() - begin)
            if advance is not None:
                advance(v)
        return times[warmup:]


def main() -> None:
    """Answer requests until the other end is closed."""
    connection, worker = Connection(int(sys.argv[1])), None
    while True:
        try:
            command, arguments = pickle.loads(connection.recv_bytes())
        except EOFError:
            return
        begin = process_time()
        try:
            worker = worker or Worker(sys.argv[2])
            answer, message = getattr(worker, command)(*arguments), ""
        except Exception as error:  # whatever a library raises is an answer
            answer, message = None, f"{type(error).__name__}: {error}"
        connection.send_bytes(pickle.dumps((answer, message, process_time() - begin), protocol=4))


if __name__ == "__main__":
    main()
