"""Tasks scaled down to what the joints can do: their direction stays, and a target far away asks for no more."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.cholesky import factorise, solve_factored
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array

WEAK = 0.1
"""Singular value below which a direction is weak, over the size of its tasks [-]: ten times the joint motion for the
same."""
APPROACH_RATE = 20.0
"""κ: how fast a singular direction is approached at most [1/s]; finite, so that acceleration limits can follow."""
WEAK_SPEED = 0.3
"""Share of the joints' speeds that a weak direction may use [-]; it counts fully where a fifth more would be needed."""
MISSING_SIZE = 0.01
"""σ_i²/l_i² from which a direction is not missing for good, whatever its curvature [-]."""
UNLIMITED_SPEED = 10.0
"""Speed by which coordinates without a limit are measured where a finite one is needed [rad/s, m/s]."""


@compiled
def scale_down(x: Any, B: Array, U: Array, squares: Array, weak: Array, b: Array, g: Array) -> None:
    """Divide the velocity of each task by how far it exceeds the speeds of the joints; write that factor g >= 1.

    Joint velocities are those of J⁺ without its weak directions, or, if these exceed the speeds less, the least ones
    measured in the joints' speeds. No task is scaled by more than all of them together exceed the speeds.

    Args:
        x: reads v_max, row_tasks and bending_rows.
        B: σ_i v_iᵀ (c, n).
        U: u_iᵀ (c, c).
        squares: σ_i² (c,).
        weak: l_i² (c,).
        b: in the velocity of the rows that bend (c,), out divided.
        g: out (c,).
    """
    count, nv = B.shape
    if joint_rate(x, B, U, squares, weak, b) <= 1.0:
        return
    gram, L, z = np.empty((count, count)), np.zeros((count, count)), np.empty(count)
    W = np.empty((count, nv))  # rows in the joints' speeds
    for k in range(count):
        for c in range(nv):
            W[k, c] = 0.0
            for i in range(count):
                W[k, c] += U[i, k] * B[i, c]
            W[k, c] *= min(x.v_max[c], UNLIMITED_SPEED)
    square = 0.0
    for i in range(count):
        for j in range(count):
            gram[i, j] = 0.0
            for c in range(nv):
                gram[i, j] += W[i, c] * W[j, c]
            square += gram[i, j] * gram[i, j]
    for i in range(count):
        gram[i, i] += WEAK * WEAK * np.sqrt(square)
    factorise(gram, L, count)
    together = min(joint_rate(x, B, U, squares, weak, b), _weighted_rate(W, L, b, z))
    part = np.empty(count)
    for task in range(x.row_tasks.max() + 1):
        for k in range(count):
            part[k] = b[k] if x.row_tasks[x.bending_rows[k]] == task else 0.0
        alone = min(joint_rate(x, B, U, squares, weak, part), _weighted_rate(W, L, part, z))
        for k in range(count):
            if x.row_tasks[x.bending_rows[k]] == task:
                g[k] = max(1.0, min(together, alone))
    for k in range(count):
        b[k] /= g[k]


@compiled
def joint_rate(x: Any, B: Array, U: Array, squares: Array, weak: Array, b: Array) -> float:
    """Compute max_j |u_j|/v_max_j of u = Σ v_i σ_i y_i / max(σ_i², l_i²) [-]."""
    u, worst = np.zeros(B.shape[1]), 0.0
    for i in range(len(b)):
        if squares[i] > 0.0:
            y = 0.0
            for k in range(len(b)):
                y += U[i, k] * b[k]
            y /= max(squares[i], weak[i])
            for c in range(len(u)):
                u[c] += B[i, c] * y
    for c in range(len(u)):
        if u[c] != 0.0:
            worst = max(worst, abs(u[c]) / min(x.v_max[c], UNLIMITED_SPEED))
    return worst


@compiled
def _weighted_rate(W: Array, L: Array, b: Array, z: Array) -> float:
    """Compute the same of the least joint velocities in the joints' speeds, damped: u/v_max = Wᵀ (W Wᵀ + λ²)⁻¹ b."""
    worst = 0.0
    solve_factored(L, b, z, len(b))
    for c in range(W.shape[1]):
        ratio = 0.0
        for k in range(len(b)):
            ratio += W[k, c] * z[k]
        worst = max(worst, abs(ratio))
    return worst


@compiled
def task_parts(x: Any, u: Array, parts: Array) -> None:
    """Write the part of each task in a direction u (c,) of the rows that bend; their sum is 1."""
    parts[:] = 0.0
    for k in range(len(u)):
        parts[x.row_tasks[x.bending_rows[k]]] += u[k] * u[k]


@compiled
def weak_sizes(x: Any, U: Array, squares: Array) -> Array:
    """Compute l_i² (c,) of all directions: that of each task, by its part in u_i.

    Of a task it is a hundredth of ‖J Jᵀ‖ of its rows J that bend, from A Aᵀ = Σ σ_i² u_i u_iᵀ.

    Args:
        x: reads row_tasks and bending_rows.
        U: u_iᵀ (c, c).
        squares: σ_i² (c,).
    """
    count, sizes = len(U), np.zeros(x.row_tasks.max() + 1)
    for k in range(count):
        task = x.row_tasks[x.bending_rows[k]]
        for j in range(count):
            if x.row_tasks[x.bending_rows[j]] == task:
                product = 0.0
                for i in range(count):
                    product += squares[i] * U[i, k] * U[i, j]
                sizes[task] += product * product
    weak, parts = np.zeros(count), np.empty(len(sizes))
    for i in range(count):
        task_parts(x, U[i], parts)
        for task in range(len(parts)):
            weak[i] += WEAK * WEAK * parts[task] * np.sqrt(sizes[task])
    return weak


@compiled
def weakness(ratio: float, rate: float) -> float:
    """Compute how much the speed of a direction is limited: 0 for none, to 1.

    Args:
        ratio: σ_i²/l_i² [-].
        rate: of A⁺b, largest joint speed over its limit [-].
    """
    fast = min(max(5.0 * (rate / WEAK_SPEED - 1.0), 0.0), 1.0)
    return max(1.0 - ratio, 0.0) * fast
