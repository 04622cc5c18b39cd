"""Replays recorded QPs through back ends, in the order of the steps and in turns, and judges every answer."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from time import perf_counter_ns
from typing import NamedTuple

import numpy as np
import qpsolvers

from qpavoid.kernels import project
from qpavoid.problem import Array
from qpavoid.solvers.backends import backend_names, make_backend, through_qpsolvers
from qpavoid_bench.solvers.record import QP, REGULARIZATION, Run, Solve
from qpavoid_bench.solvers.truth import Judgement, Truth, judge


class Cell(NamedTuple):
    """One back end on one run."""

    us: Array
    """(rounds, k) time of each call [µs]."""
    judged: list[Judgement]
    """(k,) its answers; those to open QPs are left out."""


def contestants() -> dict[str, Callable[[float], Solve]]:
    """Return how each back end is made for a control period dt [s].

    They are those of `make_backend`, and for comparison the solvers at their own default tolerances, with the velocity
    v and the displacement v dt as the unknown.
    """
    makers: dict[str, Callable[[float], Solve]] = {"native": lambda dt: _native}
    makers.update({name: partial(_shipped, name) for name in backend_names()})
    for name in sorted(qpsolvers.available_solvers):
        makers[f"{name}, defaults"] = partial(_at_defaults, name, False)
        makers[f"{name}, defaults, v dt"] = partial(_at_defaults, name, True)
    return makers


def _native(qp: QP) -> Array | None:
    """Solve in compiled code, as the `qp` solver does."""
    x, solved = project(qp.A, REGULARIZATION, qp.v, qp.G, qp.h, qp.lower, qp.upper)
    return x if solved else None


def _shipped(name: str, dt: float) -> Solve:
    backend = make_backend(name)
    return lambda qp: backend(*qp[:6])


def _at_defaults(name: str, is_displacement: bool, dt: float) -> Solve:
    """Return a solver at its own default tolerances, whose unknown is the velocity or the displacement."""
    backend, unit = through_qpsolvers(name, {}), dt if is_displacement else 1.0

    def solve(qp: QP) -> Array | None:
        x = backend(qp.P, qp.q * unit, qp.G, qp.h * unit, qp.lower * unit, qp.upper * unit)
        return None if x is None else x / unit

    return solve


def replay(
    run: Run, truths: list[Truth], makers: dict[str, Callable[[float], Solve]], rounds: int, budget: float
) -> dict[str, Cell]:
    """Time and judge every back end on a run.

    In each round every back end is made anew and sees the whole run; the order is turned round by one each time.

    Args:
        run: the QPs.
        truths: their right answers.
        makers: how to make each back end.
        rounds: how often they take turns.
        budget: a back end that has used that many seconds sits out the rounds that are left [s].
    """
    names = list(makers)
    ns: dict[str, list[list[int]]] = {name: [] for name in names}
    judged: dict[str, list[Judgement]] = {}
    for turn in range(rounds):
        shift = turn % len(names)
        for name in names[shift:] + names[:shift]:
            if 1e-9 * sum(map(sum, ns[name])) > budget:
                continue
            with _quiet():
                answers, times = _pass(makers[name](run.dt), run.qps)
            ns[name].append(times)
            if turn == 0:
                triples = zip(run.qps, truths, answers, strict=True)
                judged[name] = [judge(qp, truth, x) for qp, truth, x in triples if not truth.is_open]
    return {name: Cell(1e-3 * np.array(ns[name], dtype=float), judged[name]) for name in names}


def _pass(solve: Solve, qps: list[QP]) -> tuple[list[Array | None], list[int]]:
    answers, times = [], []
    gc.collect()
    solve(qps[0])
    for qp in qps:
        begin = perf_counter_ns()
        x = solve(qp)
        times.append(perf_counter_ns() - begin)
        answers.append(x)
    return answers, times


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what C code prints off the terminal: osqp says on stdout when there was nothing to polish."""
    sys.stdout.flush()
    selected = os.dup(1)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(selected, 1)
        os.close(selected)
