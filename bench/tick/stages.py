"""Where the time of qpavoid's step goes, without a profiler: its own functions, wrapped in clocks for a while."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import perf_counter_ns
from typing import Any

import numpy as np

STAGES = {
    "kinematics": ("qpavoid.model.kinematics:ForwardKinematics.compute",),
    "proximity": ("qpavoid.control.distances:DistanceQuery.compute",),
    "rows": ("qpavoid.control.assembler:Assembly.compute",),
    "solve": ("qpavoid.solvers.qp:Qp.solve",),
    "look ahead": ("qpavoid.safety.braking:BrakingCheck.check",),
}
"""Stage: the functions that make it up; one that is called by another counts as part of that. What is left of a step
is `the rest`."""


def measure(step: Callable[[int], Any], ticks: Sequence[int]) -> dict[str, float]:
    """Median time of each stage and of the rest [µs]; stages that this qpavoid does not have are left out."""
    clock: dict[str, int] = {}
    samples: dict[str, list[int]] = {}
    with _wrapped(clock) as stages:
        for tick in ticks:
            clock.update(dict.fromkeys(stages, 0))
            begin = perf_counter_ns()
            step(tick)
            total = perf_counter_ns() - begin
            for stage in stages:
                samples.setdefault(stage, []).append(clock[stage])
            samples.setdefault("the rest", []).append(total - sum(clock[stage] for stage in stages))
    return {stage: 1e-3 * float(np.median(ns)) for stage, ns in samples.items()}


@contextmanager
def _wrapped(clock: dict[str, int]) -> Iterator[list[str]]:
    undo: list[tuple[Any, str, Any]] = []
    running: list[str] = []
    try:
        for stage, places in STAGES.items():
            for place in places:
                module, path = place.split(":")
                *outer, name = path.split(".")
                try:
                    owner: Any = importlib.import_module(module)
                    for attribute in outer:
                        owner = getattr(owner, attribute)
                    function = getattr(owner, name)
                except (ImportError, AttributeError):
                    continue
                undo.append((owner, name, function))
                clock[stage] = 0
                setattr(owner, name, _clocked(function, clock, stage, running))
        yield list(clock)
    finally:
        for owner, name, function in undo:
            setattr(owner, name, function)


def _clocked(function: Callable[..., Any], clock: dict[str, int], stage: str, running: list[str]) -> Callable[..., Any]:
    def clocked(*args: Any, **kwargs: Any) -> Any:
        if running:
            return function(*args, **kwargs)
        running.append(stage)
        begin = perf_counter_ns()
        try:
            return function(*args, **kwargs)
        finally:
            clock[stage] += perf_counter_ns() - begin
            running.clear()

    return clocked
