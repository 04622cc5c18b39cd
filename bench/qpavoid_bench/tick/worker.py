"""A library in a process of its own: answers one request at a time, so that only one library runs at once.

Requests and answers are pickles on stdin and stdout, each a dict: the name of a method of `Worker`
as `command`, and its arguments.
"""

from __future__ import annotations

import gc
import importlib
import os
import pickle
import sys
from importlib.metadata import version
from time import perf_counter_ns
from typing import Any

import numpy as np


class Worker:
    """Serves one adapter."""

    def __init__(self, adapter: str) -> None:
        module, name = adapter.split(":")
        self._adapter = getattr(importlib.import_module(f"qpavoid_bench.tick.libs.{module}"), name)
        self._library: Any = None

    def hello(self, packages: tuple[str, ...]) -> str:
        """Return the versions of the packages."""
        return ", ".join(f"{package} {version(package)}" for package in packages)

    def setup(self, workload: Any) -> None:
        """Build the library's own model of a workload."""
        self._library = None
        gc.unfreeze()
        self._library = self._adapter(workload)
        gc.collect()
        gc.freeze()  # what a library is made of need not be looked at before each round

    def check(self, ticks: list[int]) -> dict[str, Any]:
        """Return frames, distances and velocities at some ticks."""
        library = self._library
        return {
            "frames": np.array([library.frames(tick) for tick in ticks]),
            "distances": np.array([library.distances(tick) for tick in ticks]),
            "velocities": np.array([library.velocity(library.step(tick)) for tick in ticks]),
        }

    def round(self, ticks: list[int], warmup: int) -> list[int]:
        """Return the time of each step but the first few [ns]; the collector runs before, and stays on."""
        step, advance = self._library.step, getattr(self._library, "advance", None)
        gc.collect()
        times = []
        for tick in ticks:
            begin = perf_counter_ns()
            v = step(tick)
            times.append(perf_counter_ns() - begin)
            if advance is not None:
                advance(v)
        return times[warmup:]


def main() -> None:
    """Answer requests until stdin ends."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints must not mix with the answers
    worker: Worker | None = None
    while True:
        try:
            request = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        command = request.pop("command")
        try:
            if worker is None:
                worker = Worker(sys.argv[1])
            answer = {"answer": getattr(worker, command)(**request)}
        except Exception as error:  # whatever goes wrong is reported, and the others are measured all the same
            answer = {"error": f"{type(error).__name__}: {error}".partition("\n")[0]}
        pickle.dump(answer, answers)
        answers.flush()


if __name__ == "__main__":
    main()
