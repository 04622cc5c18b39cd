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
from importlib.metadata import PackageNotFoundError, version
from time import perf_counter_ns
from typing import Any

import numpy as np


class Worker:
    """Serves one adapter."""

    def __init__(self, adapter: str) -> None:
        module, name = adapter.split(":")
        self._adapter = getattr(importlib.import_module(f"bench.tick.libs.{module}"), name)
        self._library: Any = None

    def hello(self) -> dict[str, Any]:
        """Versions and settings."""
        versions = {}
        for package in self._adapter.packages:
            try:
                versions[package] = version(package)
            except PackageNotFoundError:
                versions[package] = "?"
        return {
            "versions": versions,
            "settings": self._adapter.settings,
            "closing_gain": getattr(self._adapter, "closing_gain", None),
        }

    def setup(self, workload: Any) -> dict[str, Any]:
        """Builds the library's own model of a workload."""
        self._library = None
        begin = perf_counter_ns()
        self._library = self._adapter(workload)
        return {"seconds": 1e-9 * (perf_counter_ns() - begin)}

    def check(self, ticks: list[int]) -> dict[str, Any]:
        """Frames, distances and velocities at some ticks."""
        library = self._library
        return {
            "frames": np.array([library.frames(tick) for tick in ticks]),
            "distances": np.array([library.distances(tick) for tick in ticks]),
            "velocities": np.array([library.velocity(library.step(tick)) for tick in ticks]),
        }

    def round(self, ticks: list[int], warmup: list[int]) -> dict[str, Any]:
        """Time of each step [ns]; garbage is collected before, and the collector stays on."""
        step = self._library.step
        gc.collect()
        for tick in warmup:
            step(tick)
        times = []
        for tick in ticks:
            begin = perf_counter_ns()
            step(tick)
            times.append(perf_counter_ns() - begin)
        return {"ns": times}

    def bound(self) -> dict[str, Any]:
        """Ticks at which an avoidance row or a limit binds, of a library that can tell."""
        return {"bound": self._library.bound()}

    def stages(self, ticks: list[int]) -> dict[str, Any]:
        """Time of each stage of a step [µs], of a library that can tell."""
        return {"us": self._library.stages(ticks)} if hasattr(self._library, "stages") else {"us": {}}


def main() -> None:
    """Answers requests until stdin ends."""
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
            answer = getattr(worker, command)(**request)
        except Exception as error:
            # whatever goes wrong is reported, and the others are measured all the same
            answer = {"error": f"{type(error).__name__}: {error}"}
        pickle.dump(answer, answers)
        answers.flush()


if __name__ == "__main__":
    main()
