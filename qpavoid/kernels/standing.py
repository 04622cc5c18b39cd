"""A control step of a robot that stands on its torques, in one call: contacts, base, rows, tracked velocity and QP.

See `contact_forces` for what is eliminated, and `control.standing` for what it is a part of.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.balance_rows import balance_rows
from qpavoid.kernels.bounds import OUTSIDE, velocity_bounds
from qpavoid.kernels.cholesky import dot
from qpavoid.kernels.contact_forces import (
    BASE,
    ROWS_PER_POINT,
    cone_rows,
    eliminate_base,
    force_torque_rows,
    point_jacobians,
    remove_parts,
    standing_dynamics,
)
from qpavoid.kernels.contact_rows import contact_rows
from qpavoid.kernels.dynamics_rows import admit_stop, approached_rows, scale_braking
from qpavoid.kernels.orthogonal import least_solution, split_space
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.reduced_qp import project_within
from qpavoid.kernels.standing_layout import Stance
from qpavoid.kernels.step import SETTLED, UNSETTLED, is_too_near, tracking_violation, violation
from qpavoid.kernels.tasks import frame_rows
from qpavoid.kernels.tracking_law import tracking_law
from qpavoid.problem import CONTACT_TOLERANCE, Array, IntArray


@compiled
def standing_step(
    x: Any, y: Any, z: Any, q: Array, influence_distance: float, moving: bool, from_tasks: bool
) -> tuple[int, Stance]:
    """Compute a control step of a robot that stands; see `dynamics_step`.

    Args:
        x: memory of the step; kinematics, distances and rows of tasks that are no frames are up to date.
        y: `DynamicsArrays`; M and h are written.
        z: `StandingArrays`, with mass and bias of q and x.v_prev, the measured velocity.
        q: configuration (nq,).
        influence_distance: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.
        from_tasks: whether the tasks are followed, or v_tracking as it is.

    Returns:
        SETTLED where z.solved may be commanded as it is, UNSETTLED where other laws and checks decide; and what
        contacts and base leave.
    """
    stance, s = stand(x, y, z), x.summary[0]
    scale_braking(x, y)
    margin, bent = velocity_bounds(x, q), 0.0
    admit_stop(x, y)
    _admit_contacts(x, stance)
    if from_tasks:
        frame_rows(x)
        bent = _track_within(x, stance)
        if x.task_switching:
            bent = 0.0
    else:
        _meet(stance.J, stance.b, stance.Z, stance.resting, x.v_tracking, CONTACT_TOLERANCE)
    k = approached_rows(x, y, influence_distance, moving)
    if y.approaches[0]:
        for j in range(len(x.v_prev)):
            x.v_tracking[j] = x.v_prev[j] + y.tracking_factor * (x.v_tracking[j] - x.v_prev[j])
        tolerance = 0.0 if from_tasks else CONTACT_TOLERANCE
        _meet(stance.J, stance.b_approached, stance.Z, stance.approached, x.v_tracking, tolerance)
    worst = tracking_violation(x, k)
    s.rows, s.violation, s.is_clear, s.position_margin, s.bent = k, worst, False, margin, bent
    if x.regularization == 0.0 or not stance.is_held or margin < -OUTSIDE or is_too_near(x, k):
        return UNSETTLED, stance
    code = _solve(x, y, z, stance, k, from_tasks, max(x.regularization, bent))
    if code == SETTLED:
        standing_torques(y, z, stance, x.v_prev, x.dt)
    return code, stance


@compiled
def _solve(x: Any, y: Any, z: Any, stance: Stance, k: int, from_tasks: bool, regularization: float) -> int:
    """Write v and z.solved: the tracked velocity with impulses, or the QP in what contacts and base leave."""
    n, m, s = len(x.v_prev), len(stance.Jp), x.summary[0]
    tracked = with_impulses(z, stance, x.v_prev, x.dt, x.v_tracking)
    free = np.full(n + m, np.inf)
    if not (s.violation <= 0.0 and violation(tracked, stance.rows, stance.rhs, -free, free) <= 0.0):
        tracked, is_solved = project_within(
            x.A if from_tasks else x.identity, regularization, tracked, stance.X, stance.start, stance.Z.shape[1],
            x.J[:k], x.rhs[:k], stance.rows, stance.rhs, 2 * len(y.limit) if y.has_torques else 0, x.lower, x.upper,
        )  # fmt: skip
        if not is_solved:
            return UNSETTLED
    x.v[:] = tracked[:n]
    z.solved[:n] = tracked[:n]
    for j in range(m):
        z.solved[n + j] = tracked[n + j] / z.scale
    return SETTLED


@compiled
def stand(x: Any, y: Any, z: Any) -> Stance:
    """Take up contacts and base, for a step from the measured velocity.

    Args:
        x: reads J_world, columns, frame_poses, v_prev, dt.
        y: reads limit; writes M and h, those of `standing_dynamics`, or of a robot that nothing holds.
        z: `StandingArrays`.
    """
    n, dt, v = len(x.v_prev), x.dt, x.v_prev
    for i in range(n):
        for j in range(i):
            z.mass[i, j] = z.mass[j, i]
    J, b, of_rows = contact_rows(
        x.J_world, x.columns, z.support, x.frame_poses, z.frame_ids, z.anchors, z.gains, z.surfaces,
        z.shares, z.jacobians,
    )  # fmt: skip
    c = len(b)
    K, Z, R, order = split_space(J)
    approaching = np.empty(c)
    for r in range(c):
        rate, contact = 0.0, of_rows[r]
        for j in range(n):
            rate += J[r, j] * v[j]
        approaching[r] = rate + z.steps[contact] * z.shares[contact] * (b[r] - rate)
    resting, approached = least_solution(K, R, order, b), least_solution(K, R, order, approaching)
    used, Jp, normals, friction, least, most = _points(x, z)
    m, k = len(Jp), Z.shape[1]
    X, start, Y = np.empty((n + m, max(k + m - BASE, 0))), np.empty(n + m), np.empty((m, BASE))
    N = np.empty((m, max(m - BASE, 0)))
    is_held = eliminate_base(z.mass, z.bias, v, dt, Jp, Z, approached, z.scale, X, start, Y, N)
    torques = 2 * len(y.limit) if y.has_torques else 0
    hard = torques + ROWS_PER_POINT * len(used)
    support, right = balance_rows(_bearing_points(x, z, used), x, y, z)
    rows, rhs = np.zeros((hard + len(right), n + m)), np.empty(hard + len(right))
    if is_held:
        standing_dynamics(z.mass, z.bias, Jp, Y, K, y.M, y.h)
        if y.has_torques:
            force_torque_rows(z.mass, z.bias, v, dt, Jp, y.limit, z.scale, rows[:torques], rhs[:torques])
        cone_rows(normals, friction, least, most, dt, z.scale, n, rows[torques:hard], rhs[torques:hard])
        rows[hard:, :n], rhs[hard:] = support, right
    else:
        y.M[:BASE], y.h[:BASE] = 0.0, 0.0
        y.M[BASE:], y.h[BASE:] = z.mass[BASE:], z.bias[BASE:]
    return Stance(
        J, b, approaching, K, Z, resting, approached, used, Jp, normals, X, start, Y, rows, rhs, hard, is_held
    )


@compiled
def _points(x: Any, z: Any) -> tuple[IntArray, Array, Array, Array, Array, Array]:
    """Return the active points, their Jacobian and normals in the world, friction and bounds of the normal force."""
    count, n = 0, len(x.v_prev)
    for owner in z.owners:
        count += z.shares[owner] > 0.0
    used, owners = np.empty(count, dtype=np.intp), np.empty(count, dtype=np.intp)
    offsets, normals, Jp = np.empty((count, 3)), np.empty((count, 3)), np.empty((3 * count, n))
    friction, least, most, at = np.empty(count), np.empty(count), np.empty(count), 0
    for k in range(len(z.owners)):
        owner = z.owners[k]
        fraction, pose = z.shares[owner], x.frame_poses[z.frame_ids[owner]]
        if not fraction > 0.0:
            continue
        used[at], owners[at], friction[at] = k, owner, z.friction[owner]
        least[at], most[at] = z.force[owner, 0] if fraction == 1.0 else 0.0, z.force[owner, 1] * fraction
        for i in range(3):
            offsets[at, i] = normals[at, i] = 0.0
            for c in range(3):
                offsets[at, i] += pose[3 * c + i] * z.points[k, c]
                normals[at, i] += pose[3 * c + i] * z.normals[owner, c]
        at += 1
    point_jacobians(z.jacobians, offsets, owners, Jp)
    return used, Jp, normals, friction, least, most


@compiled
def _bearing_points(x: Any, z: Any, used: IntArray) -> Array:
    """Return the points (·, 3), world [m], that balance counts on: of contacts that neither come nor leave."""
    points, count = np.zeros((len(used), 3)), 0
    for k in used:
        owner = z.owners[k]
        if z.support_margin >= 0.0 and z.shares[owner] == 1.0 and not z.leaves[owner]:
            pose = x.frame_poses[z.frame_ids[owner]]
            for i in range(3):
                points[count, i] = pose[9 + i]
                for c in range(3):
                    points[count, i] += pose[3 * c + i] * z.points[k, c]
            count += 1
    return points[:count]


@compiled
def _admit_contacts(x: Any, stance: Any) -> None:
    """Let the hard bounds admit the stop as far as contacts do: a foot that comes may have to go on at its speed."""
    stop = x.v_stop.copy()
    _meet(stance.J, stance.b_approached, stance.Z, stance.approached, stop, 0.0)
    for j in range(len(stop)):
        x.hard_lower[j], x.hard_upper[j] = min(x.hard_lower[j], stop[j]), max(x.hard_upper[j], stop[j])


@compiled
def _track_within(x: Any, stance: Any) -> float:
    """Let the tracking law hold the contacts; return how far the task rows bend."""
    (rows, n), resting = x.A.shape, stance.resting
    A, missing = x.A.copy(), x.b.copy()
    for r in range(rows):
        missing[r] -= dot(A[r], resting)
        remove_parts(A[r], stance.K)
    bent = tracking_law(x, A, missing, x.v_tracking, x.b_feasible)
    for j in range(n):
        x.v_tracking[j] += resting[j]
    for r in range(rows):
        x.b_feasible[r] += x.b[r] - missing[r]
    return bent


@compiled
def _meet(J: Array, b: Array, Z: Array, least: Array, v: Array, tolerance: float) -> None:
    """Move v (n,) to the closest velocity with J v = b; leave it where it meets that, see `Contacts.project`."""
    worst = 0.0
    for r in range(len(b)):
        missing = b[r]
        for j in range(len(v)):
            missing -= J[r, j] * v[j]
        worst = max(worst, abs(missing))
    if worst <= tolerance:
        return
    inner = np.zeros(Z.shape[1])
    for j in range(len(v)):
        for c in range(len(inner)):
            inner[c] += Z[j, c] * v[j]
    for j in range(len(v)):
        v[j] = least[j]
        for c in range(len(inner)):
            v[j] += Z[j, c] * inner[c]


@compiled
def standing_torques(y: Any, z: Any, stance: Any, v_measured: Array, dt: float) -> None:
    """Write acceleration and torques, cut at their limits, of the velocity and impulses of z.solved.

    Args:
        y: `DynamicsArrays`; reads limit, writes change and torque.
        z: `StandingArrays`.
        stance: of the step.
        v_measured: v̄ (n,).
        dt: control period [s].
    """
    n, m = len(v_measured), len(stance.Jp)
    for j in range(n):
        y.change[j] = (z.solved[j] - v_measured[j]) / dt
    for r in range(n - BASE):
        torque = z.bias[BASE + r]
        for j in range(n):
            torque += z.mass[BASE + r, j] * y.change[j]
        for j in range(m):
            torque -= stance.Jp[j, BASE + r] * z.solved[n + j] / dt
        y.torque[r] = min(max(torque, -y.limit[r]), y.limit[r])


@compiled
def with_impulses(z: Any, stance: Any, v_measured: Array, dt: float, v: Array) -> Array:
    """Compute x = (v, s p) of a velocity that meets the contacts: with the p nearest to equal shares of the weight.

    p = p̂ + Y (M_b (v - v̄) + dt h_b - B p̂), as Y is the least right inverse of B.

    Args:
        z: `StandingArrays`.
        stance: of the step.
        v_measured: v̄ (n,).
        dt: control period [s].
        v: (n,).
    """
    n, m, Jp = len(v), len(stance.Jp), stance.Jp
    out, equal = np.empty(n + m), dt * z.weight[0] / (m // 3)
    out[:n] = v
    for j in range(m):
        out[n + j] = equal * stance.normals[j // 3, j % 3]
    for i in range(BASE):
        needed = dt * z.bias[i]
        for j in range(n):
            needed += z.mass[i, j] * (v[j] - v_measured[j])
        for j in range(m):
            needed -= Jp[j, i] * equal * stance.normals[j // 3, j % 3]
        for j in range(m):
            out[n + j] += stance.Y[j, i] * needed
    for j in range(m):
        out[n + j] *= z.scale
    return out
