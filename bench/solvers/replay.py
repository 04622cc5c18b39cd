"""Replays recorded QPs through back ends, in the order of the ticks and in turns, and judges every answer."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Callable, Iterator
from time import perf_counter_ns
from typing import NamedTuple

import numpy as np
import qpsolvers
from numba import njit

from bench.solvers.record import QP, Run
from bench.solvers.verify import Judgement, Truth, judge, truth, violation
from qpavoid.kernels import minimize
from qpavoid.problem import Array
from qpavoid.solvers.backends import Backend, backend_names, make_backend, through_qpsolvers

BEFORE = {"daqp": {"primal_tol": 1e-9, "dual_tol": 1e-12}}
"""Settings with which the back end that is called natively can be called through qpsolvers."""


class Cell(NamedTuple):
    """One back end on one run."""

    us: Array
    """(rounds, k) time of each call [µs]."""
    judged: list[Judgement]
    """(k,) its answers; those to open QPs are left out."""


class Loose(NamedTuple):
    """Worst of what a back end calls solved at its own default tolerances."""

    found: float
    """Share of the feasible QPs for which it reports success."""
    error: float
    """Largest ‖v - reference‖∞ [rad/s]."""
    above: float
    """Share of its answers that are off by more than 1e-3 rad/s."""
    violation: float
    """Largest violation of a row or bound [m/s, rad/s]."""


def contestants() -> dict[str, Callable[[], Backend]]:
    """Every back end as `make_backend` gives it, then the natively called ones through qpsolvers."""
    native = {name: (lambda name=name: make_backend(name)) for name in backend_names()}
    wrapped = {
        f"{name} by qpsolvers": (lambda name=name, options=options: through_qpsolvers(name, options))
        for name, options in BEFORE.items()
        if name in qpsolvers.available_solvers
    }
    return {**_compiled(), **native, **wrapped}


def _compiled() -> dict[str, Callable[[], Backend]]:
    """The back end `native`, which the `qp` solver calls without P and q: here x0 = -P⁻¹q is computed first."""

    @njit
    def from_cost(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> tuple[Array, bool]:
        x = np.linalg.solve(P, -q)
        return x, minimize(P, x, G, h, lower, upper, np.zeros(len(h)))

    def solve(*qp: Array) -> Array | None:
        x, solved = from_cost(*qp)
        return x if solved else None

    one, row = np.ones(1), np.ones((1, 1))
    solve(row, one, row, 2.0 * one, -3.0 * one, 3.0 * one)  # compiles
    return {"native": lambda: solve}


def truths(run: Run) -> list[Truth]:
    """The right answers to a run's QPs."""
    return [truth(qp) for qp in run.qps]


def replay(
    run: Run, right: list[Truth], makers: dict[str, Callable[[], Backend]], rounds: int, budget: float
) -> dict[str, Cell]:
    """Times and judges every back end on a run.

    In each round every back end is made anew and sees the whole run; the order is turned round by one each time.

    Args:
        run: the QPs.
        right: their right answers.
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
            with quiet():
                answers, times = _pass(makers[name](), run.qps)
            ns[name].append(times)
            if turn == 0:
                triples = zip(run.qps, right, answers, strict=True)
                judged[name] = [judge(qp, known, x) for qp, known, x in triples if not known.open]
    return {name: Cell(1e-3 * np.array(ns[name], dtype=float), judged[name]) for name in names}


def loose(run: Run, right: list[Truth], name: str, displacement: bool) -> Loose:
    """What a back end does at its default tolerances, in velocities or in displacements x = v dt."""
    solve, unit = through_qpsolvers(name, {}), run.dt if displacement else 1.0
    errors, violations, feasible = [], [], 0
    for qp, known in zip(run.qps, right, strict=True):
        if known.x is None or known.open or known.flat:
            continue
        feasible += 1
        scaled = QP(qp.P, qp.q * unit, qp.G, qp.h * unit, qp.lower * unit, qp.upper * unit)
        with quiet():
            x = solve(*scaled)
        if x is not None:
            errors.append(float(np.abs(x / unit - known.x).max()))
            violations.append(violation(qp, x / unit))
    found, off = len(errors) / max(feasible, 1), np.array([*errors, 0.0])
    return Loose(
        found, float(off.max()), float(np.mean(off[:-1] > 1e-3)) if errors else 0.0, max(violations, default=0.0)
    )


def _pass(solve: Backend, qps: list[QP]) -> tuple[list[Array | None], list[int]]:
    answers, times = [], []
    gc.collect()
    for qp in qps:
        begin = perf_counter_ns()
        x = solve(*qp)
        times.append(perf_counter_ns() - begin)
        answers.append(x)
    return answers, times


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keeps what C code prints off the terminal: osqp says on stdout when there was nothing to polish."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
