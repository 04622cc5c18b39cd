"""The functions of `qpavoid.kernels.vectorised` as loops that numba compiles; documented there.

Compiled code is cached on disk, so that only the first run after an installation waits for the compiler. The cache
follows this file alone: after a change to what it takes from other files, remove `__pycache__`.

The layout crosses from Python as one structure: passing its forty arrays one by one would cost more than the work.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numba.experimental import structref

from qpavoid.kernels.layout import RowLayout
from qpavoid.kernels.stopping import AT_REST, MOST_STEPS, longest_way, way_to_stop
from qpavoid.kernels.vectorised import BRAKING_SHARE, WELL_CONDITIONED, rotation_vector
from qpavoid.problem import Array, IntArray

compiled = njit(cache=True, fastmath={"reassoc", "contract", "nsz"})
"""How kernels are compiled: sums may be taken in any order, so that they become vector instructions; NaN stays NaN."""


class PackedRows(structref.StructRefProxy):  # type: ignore[misc]
    """A `RowLayout` as compiled code sees it."""


@structref.register
class PackedRowsType(types.StructRef):  # type: ignore[misc]
    """Its type, made of those of the fields."""

    def preprocess_fields(self, fields: Any) -> Any:
        """Types of fields, not of the values that they happen to have."""
        return tuple((name, types.unliteral(field)) for name, field in fields)


structref.define_boxing(PackedRowsType, PackedRows)
structref.define_constructor(PackedRows, PackedRowsType, list(RowLayout._fields))


@compiled
def _pack(fields: Any) -> Any:
    return PackedRows(*fields)


def pack(layout: RowLayout) -> Any:
    """See `vectorised.pack`."""
    return _pack(tuple(layout))


@compiled
def candidates(poses: Array, local: Array, centers: Array, within: Array, pair_of: IntArray, found: IntArray) -> int:
    """See `vectorised.candidates`."""
    bodies, geometries = pair_of.shape
    for i in range(bodies):
        for r in range(3):
            turned = poses[i, r] * local[i, 0] + poses[i, 3 + r] * local[i, 1] + poses[i, 6 + r] * local[i, 2]
            centers[i, r] = turned + poses[i, 9 + r]
        centers[i, 4] = -(centers[i, 0] ** 2 + centers[i, 1] ** 2 + centers[i, 2] ** 2)
    x, y, z = centers[:, 0].copy(), centers[:, 1].copy(), centers[:, 2].copy()
    near = np.empty(geometries, np.bool_)
    count = 0
    for i in range(bodies):
        for j in range(geometries):  # free of branches, so that it becomes vector instructions
            dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
            near[j] = dx * dx + dy * dy + dz * dz <= within[i, j]
        for j in range(geometries):
            if near[j]:
                found[count] = pair_of[i, j]
                count += 1
    return count


@compiled
def _fold(row: Array, columns: IntArray, folded: Array) -> None:
    """Adds up the columns (e,) of a Jacobian's row that one coordinate moves (n,)."""
    folded[:] = 0.0
    for c in range(len(row)):
        folded[columns[c]] += row[c]


@compiled
def distance_rows(x: Any, pairs: IntArray, reach: float, moving: bool) -> int:
    """See `vectorised.distance_rows`."""
    results, J_world, closest, J = x.results, x.J_world, x.closest, x.J
    columns = J_world.shape[1]
    k = 0
    for i in pairs:
        if not results[i, 0] >= reach:
            x.near[k] = i
            for c in range(10):
                closest[k, c] = results[i, c]
            nx, ny, nz = results[i, 1], results[i, 2], results[i, 3]
            px, py, pz = results[i, 4], results[i, 5], results[i, 6]
            mx, my, mz = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
            row = x.mimicking if x.mimics else J[k]
            for c in range(columns):
                linear = nx * J_world[0, c] + ny * J_world[1, c] + nz * J_world[2, c]
                angular = mx * J_world[3, c] + my * J_world[4, c] + mz * J_world[5, c]
                row[c] = (linear + angular) * x.support[i, c]
            if x.mimics:
                _fold(row, x.columns, J[k])
            x.drift[k] = 0.0
            if moving:
                t = x.twists[x.twist_row[i]]
                x.drift[k] = nx * t[0] + ny * t[1] + nz * t[2] + mx * t[3] + my * t[4] + mz * t[5]
            k += 1
    return k


@compiled
def _room_for_jerk(x: Any, i: int, value: float, step: float, room: float) -> float:
    """See `vectorised._room_for_jerk`."""
    speed, change, unit = -x.drift[i], 0.0, 0.0
    for c in range(len(x.v_last)):
        if x.J[i, c] != 0.0:
            speed -= x.J[i, c] * x.v_last[c]
            change -= x.J[i, c] * x.w_last[c]
            unit += abs(x.J[i, c]) * x.w_step[c]
    unit *= BRAKING_SHARE
    if not 0.0 < unit < np.inf:
        return -np.inf
    high = min((-value - speed) / unit, change / unit + 1.0 / BRAKING_SHARE)
    change = _change_to_stop(speed / unit, high, -np.inf, step / unit, room / unit)
    return -speed - unit * change


@compiled
def row_bounds(x: Any, k: int, moving: bool) -> None:
    """See `vectorised.row_bounds`."""
    for i in range(k):
        d = x.closest[i, 0] + x.offset - x.margin[x.twist_row[x.near[i]]]
        value = x.row_gain * (x.hold - d)
        parting = value > 0.0
        if x.switching and not parting:
            share = min(max((d - x.d1) / (x.d2 - x.d1), 0.0), 1.0)
            value *= 0.5 - 0.5 * np.cos(np.pi * share)
        if x.accelerated and value < 0.0:
            braking = 0.0
            for c in range(len(x.v_step)):
                if x.J[i, c] != 0.0:
                    braking += abs(x.J[i, c]) * x.v_step[c]
            if braking < np.inf:
                braking *= 0.5 * BRAKING_SHARE
                room = max(d - x.hold, 0.0) / x.dt
                value = max(value, braking - np.sqrt(braking * braking + 4.0 * braking * room))
                if x.jerked:
                    value = max(value, _room_for_jerk(x, i, value, 2.0 * braking, room))
        least = min(value, x.recovery) - x.drift[i]
        if parting:
            most = 0.0
            for c in range(len(x.lower)):
                if x.J[i, c] > 0.0:
                    most += x.J[i, c] * x.upper[c]
                elif x.J[i, c] < 0.0:
                    most += x.J[i, c] * x.lower[c]
            if x.drift[i] < 0.0:
                most = max(most, -x.drift[i])
            least = min(least, most)
        elif x.accelerated and x.drift[i] >= 0.0:
            stop = 0.0
            for c in range(len(x.lower)):
                stop += x.J[i, c] * x.v_stop[c]
            least = min(least, stop)
        x.d[i] = d
        x.least[i] = least
        x.touch[i] = min(x.row_gain * (x.offset - d) - x.drift[i], least)


@compiled
def closest_call(x: Any, v: Array, k: int, reach: float, horizon: float) -> float:
    """See `vectorised.closest_call`."""
    speeds, motions, joints = x.speeds, x.joint_velocities, len(x.joint_velocities)
    fastest = 0.0
    for i in range(joints):
        linear = np.sqrt(motions[i, 0] ** 2 + motions[i, 1] ** 2 + motions[i, 2] ** 2)
        angular = np.sqrt(motions[i, 3] ** 2 + motions[i, 4] ** 2 + motions[i, 5] ** 2)
        speeds[i] = linear + angular * x.joint_reach[i]
        fastest = np.maximum(fastest, speeds[i])  # keeps NaN, unlike max
    any_fastest = fastest
    for i in range(joints, len(speeds)):
        any_fastest = np.maximum(any_fastest, speeds[i])
    omega, slide = 0.0, 0.0
    for chain in range(len(x.turning)):
        turning, sliding = 0.0, 0.0
        for c in range(len(v)):
            turning += x.turning[chain, c] * abs(v[c])
            sliding += x.sliding[chain, c] * abs(v[c])
        omega, slide = max(omega, turning), max(slide, sliding)
    bend = horizon * horizon * omega * (omega * x.lever + 2.0 * slide)
    least = reach + x.offset - x.hold - (fastest + any_fastest) * horizon - bend
    for i in range(k):
        pair = x.near[i]
        closing = speeds[x.carriers[pair, 0]] + speeds[x.carriers[pair, 1]]
        least = np.minimum(least, x.d[i] - x.hold - closing * horizon - bend)
    return least


_rotation_vector = compiled(rotation_vector)


@compiled
def frame_rows(x: Any) -> None:
    """See `vectorised.frame_rows`."""
    poses, targets, screws, A, b, J_world = x.poses, x.targets, x.screws, x.A, x.b, x.J_world
    rows, columns = len(screws), J_world.shape[1]
    moving = rows // 3 - len(x.turns)
    for f in range(len(poses)):
        for c in range(12):
            poses[f, c] = x.frame_poses[x.frame_ids[f], c]
    for f in range(moving):
        r, px, py, pz = 3 * f, poses[f, 9], poses[f, 10], poses[f, 11]
        screws[r, 4], screws[r, 5] = pz, -py
        screws[r + 1, 3], screws[r + 1, 5] = -pz, px
        screws[r + 2, 3], screws[r + 2, 4] = py, -px
        for i in range(3):
            b[r + i] = targets[f, 12 + i] + x.gain[f] * (targets[f, i] - poses[f, 9 + i])
    missing = np.empty((3, 3))
    for n in range(len(x.turns)):
        f = x.turns[n]
        for i in range(3):
            for j in range(3):
                missing[i, j] = 0.0
                for c in range(3):
                    missing[i, j] += targets[f, 3 + 3 * i + c] * poses[f, 3 * c + j]
        errors = _rotation_vector(missing)
        for i in range(3):
            b[3 * (moving + n) + i] = targets[f, 15 + i] + x.gain[f] * errors[i]
    for part in range(len(x.cap)):
        r = 3 * part
        speed = np.sqrt(b[r] * b[r] + b[r + 1] * b[r + 1] + b[r + 2] * b[r + 2])
        if speed > x.cap[part]:
            for i in range(3):
                b[r + i] *= x.cap[part] / speed
    for r in range(rows):
        b[r] *= x.scale[r]
        row = x.mimicking if x.mimics else A[r]
        for c in range(columns):
            row[c] = 0.0
        for s in range(6):
            e = screws[r, s]
            if e != 0.0:
                for c in range(columns):
                    row[c] += e * J_world[s, c]
        for c in range(columns):
            row[c] *= x.task_support[r, c]
        if x.mimics:
            _fold(row, x.columns, A[r])


@compiled
def _speed_to_stop(room: float, step: float, dt: float) -> float:
    """See `vectorised.speed_to_stop`."""
    ticks = min(max(np.ceil(0.5 * np.sqrt(1.0 + 8.0 * room / (step * dt)) - 0.5), 1.0), 1e15)
    return room / (dt * ticks) + 0.5 * step * (ticks - 1.0)


_way_to_stop, _longest_way = compiled(way_to_stop), compiled(longest_way)


@compiled
def _change_to_stop(speed: float, high: float, low: float, most: float, room: float) -> float:
    """See `vectorised.change_to_stop`."""
    change = high
    for _ in range(MOST_STEPS):
        way, growth = _way_to_stop(speed + change, change, most)
        if not way > room:
            break
        change -= (way - room) / growth
    return max(change, low)


@compiled
def _within_jerk(x: Any, q: Array) -> None:
    """See `vectorised._within_jerk`."""
    below, above = np.full(len(x.v_max), np.inf), np.full(len(x.v_max), np.inf)
    for i in range(len(x.q_index)):
        here = q[x.q_index[i]]
        below[x.v_index[i]], above[x.v_index[i]] = here - x.q_lower[i], x.q_upper[i] - here
    for j in range(len(x.v_max)):
        x.lower[j], x.upper[j] = -np.inf, np.inf
        unit = x.w_step[j]
        if not unit < np.inf:
            continue
        speed, change, most, fastest = x.v_last[j] / unit, x.w_last[j] / unit, x.v_step[j] / unit, x.v_max[j] / unit
        target = min(_speed_to_stop(abs(speed), 1.0, 1.0), most)
        stop = min(max(-target if speed > 0.0 else target, change - 1.0), change + 1.0)
        faster, deeper = fastest if above[j] >= 0.0 else 0.0, fastest if below[j] >= 0.0 else 0.0
        high = min(change + 1.0, most, _speed_to_stop(max(faster - speed, 0.0), 1.0, 1.0))
        deep = min(1.0 - change, most, _speed_to_stop(max(deeper + speed, 0.0), 1.0, 1.0))
        up = _change_to_stop(speed, high, stop, most, max(above[j], 0.0) / (x.dt * unit))
        down = _change_to_stop(-speed, deep, -stop, most, max(below[j], 0.0) / (x.dt * unit))
        x.lower[j], x.upper[j] = x.v_last[j] - unit * down, x.v_last[j] + unit * up
        if above[j] < 0.0:
            x.hard_upper[j] = max(x.hard_upper[j], min(x.lower[j], x.v_max[j]))
        elif below[j] < 0.0:
            x.hard_lower[j] = min(x.hard_lower[j], max(x.upper[j], -x.v_max[j]))


@compiled
def velocity_bounds(x: Any, q: Array) -> None:
    """See `vectorised.velocity_bounds`."""
    lower, upper = x.hard_lower, x.hard_upper
    for j in range(len(x.v_max)):
        lower[j], upper[j] = -x.v_max[j], x.v_max[j]
    for i in range(len(x.q_index)):
        j, here = x.v_index[i], q[x.q_index[i]]
        fastest, step, last = x.v_max[j], x.v_step[j], x.v_last[j]
        below, above = here - x.q_lower[i], x.q_upper[i] - here
        if step < np.inf:
            faster, slower = min(step, x.w_step[j] + x.w_last[j]), min(step, x.w_step[j] - x.w_last[j])
            down = _speed_to_stop(below, step, x.dt) if below > 0.0 else max(x.rate * below, -last - faster)
            up = _speed_to_stop(above, step, x.dt) if above > 0.0 else max(x.rate * above, last - slower)
            if below < 0.0:
                down = max(down, -up)  # on the way back from outside one limit it can still brake for the other
            elif above < 0.0:
                up = max(up, -down)
        else:
            down, up = x.rate * below, x.rate * above
        lower[j] = max(min(-down, fastest), -fastest)
        upper[j] = max(min(up, fastest), -fastest)
    if x.jerked:
        _within_jerk(x, q)
    for j in range(len(x.v_max)):
        low = min(max(x.v_last[j] - x.v_step[j], lower[j]), upper[j])
        high = max(min(x.v_last[j] + x.v_step[j], upper[j]), lower[j])
        if x.jerked:
            low, high = min(max(x.lower[j], low), high), max(min(x.upper[j], high), low)
        x.lower[j], x.upper[j] = low, high


@compiled
def stop_velocity(x: Any) -> None:
    """See `vectorised.stop_velocity`."""
    slowing = 1.0 if x.accelerated else np.inf
    for j in range(len(x.v_last)):
        slowing = max(slowing, abs(x.v_last[j]) / x.v_step[j])
    share = 1.0 - 1.0 / slowing if x.accelerated else 0.0
    if x.jerked:
        _easing_stop(x, 1.0 / slowing)
    else:
        for j in range(len(x.v_last)):
            x.v_stop[j] = share * x.v_last[j]
    for j in range(len(x.v_last)):
        x.v_stop[j] = min(max(x.v_stop[j], x.lower[j]), x.upper[j])


@compiled
def _easing_stop(x: Any, braking: float) -> None:
    """See `vectorised.easing_stop`."""
    fastest, off = 0.0, 1.0
    for j in range(len(x.v_last)):
        fastest = max(fastest, abs(x.v_last[j]) / x.w_step[j])
    if fastest > 0.0:
        braking = min(braking, _speed_to_stop(fastest, 1.0, 1.0) / fastest)
    for j in range(len(x.v_last)):
        off = max(off, abs(x.w_last[j] + braking * x.v_last[j]) / x.w_step[j])
    kept = 1.0 - 1.0 / off
    share = 1.0 - (1.0 - kept) * braking
    for j in range(len(x.v_last)):
        x.v_stop[j] = share * x.v_last[j] + kept * x.w_last[j]


@compiled
def stop_way(x: Any, q: Array, w: Array, way: Array) -> int:
    """See `vectorised.stop_way`."""
    x.lower[:], x.upper[:] = -np.inf, np.inf
    count = _stop_ticks(x, q, w, way, False)
    below, above = np.full(len(w), np.inf), np.full(len(w), np.inf)
    for i in range(len(x.q_index)):
        here = q[x.q_index[i]]
        below[x.v_index[i]], above[x.v_index[i]] = here - x.q_lower[i], x.q_upper[i] - here
    for j in range(len(w)):
        unit, most = x.w_step[j], x.v_step[j] / x.w_step[j]
        if not unit < np.inf:
            if min(below[j], above[j], x.v_max[j]) < np.inf:
                return _stop_ticks(x, q.copy(), w, way, True)
            continue
        fastest = x.v_max[j] / unit * (1.0 + AT_REST)
        for k in range(1, count):
            below[j] += x.dt * way[k - 1, j]
            above[j] -= x.dt * way[k - 1, j]
            speed, change = way[k, j] / unit, (way[k, j] - way[k - 1, j]) / unit
            if (
                abs(speed) + 0.5 * change * change > fastest
                or _longest_way(speed, change, most) > above[j] / (x.dt * unit)
                or _longest_way(-speed, -change, most) > below[j] / (x.dt * unit)
            ):
                return _stop_ticks(x, q.copy(), w, way, True)
    return count


@compiled
def _stop_ticks(x: Any, q: Array, w: Array, way: Array, bounded: bool) -> int:
    """See `vectorised._stop_ticks`."""
    x.v_last[:], x.w_last[:] = way[0], w
    for k in range(1, len(way)):
        if bounded:
            for i in range(len(x.q_index)):
                q[x.q_index[i]] += x.dt * x.v_last[x.v_index[i]]
            velocity_bounds(x, q)
        stop_velocity(x)
        moves = False
        for j in range(len(w)):
            change = x.v_stop[j] - x.v_last[j]
            x.w_last[j], x.v_last[j] = min(max(change, -x.v_step[j]), x.v_step[j]), x.v_stop[j]
            way[k, j] = x.v_stop[j]
            moves = moves or abs(x.v_stop[j]) > AT_REST * x.v_step[j] or abs(x.w_last[j]) > x.w_step[j]
        if not moves:
            return k
    return len(way)


@compiled
def damped_solution(x: Any, v: Array) -> None:
    """See `vectorised.damped_solution`: Cholesky factorisation of the Gram matrix, row by row."""
    A, b, damping = x.A, x.b, x.damping
    rows, nv = A.shape
    L = np.empty((rows, rows))
    y = np.empty(rows)
    smallest, largest = np.inf, 0.0
    for i in range(rows):
        for j in range(i + 1):
            dot = 0.0
            for c in range(nv):
                dot += A[i, c] * A[j, c]
            if i == j:
                dot += damping * damping
            for c in range(j):
                dot -= L[i, c] * L[j, c]
            if i == j:
                smallest, largest = min(smallest, dot), max(largest, dot)
                if not dot > 0.0 or (damping == 0.0 and smallest < WELL_CONDITIONED * largest):
                    v[:] = np.nan
                    return
                L[i, i] = np.sqrt(dot)
            else:
                L[i, j] = dot / L[j, j]
        total = b[i]
        for c in range(i):
            total -= L[i, c] * y[c]
        y[i] = total / L[i, i]
    v[:] = 0.0
    for i in range(rows - 1, -1, -1):
        total = y[i]
        for c in range(i + 1, rows):
            total -= L[c, i] * y[c]
        y[i] = total / L[i, i]
        for c in range(nv):
            v[c] += A[i, c] * y[i]


@compiled
def shortfall(v: Array, J: Array, b: Array, lower: Array, upper: Array) -> float:
    """See `vectorised.shortfall`."""
    worst = -np.inf
    for i in range(len(v)):
        worst = np.maximum(worst, np.maximum(v[i] - upper[i], lower[i] - v[i]))  # keeps NaN, unlike max
    for k in range(len(b)):
        short = b[k]
        for i in range(len(v)):
            short -= J[k, i] * v[i]
        worst = np.maximum(worst, short)
    return worst


@compiled
def tracking_shortfall(x: Any, k: int) -> float:
    """See `vectorised.tracking_shortfall`."""
    return shortfall(x.v0, x.J[:k], x.least[:k], x.lower, x.upper)


@compiled
def assemble(x: Any, q: Array, pairs: IntArray, reach: float, moving: bool) -> tuple[int, float]:
    """See `vectorised.assemble`."""
    frame_rows(x)
    velocity_bounds(x, q)
    stop_velocity(x)
    damped_solution(x, x.v0)
    k = distance_rows(x, pairs, reach, moving)
    row_bounds(x, k, moving)
    return k, tracking_shortfall(x, k)


@compiled
def projection_cost(A: Array, regularization: float, v0: Array) -> tuple[Array, Array]:
    """See `vectorised.projection_cost`."""
    rows, nv = A.shape
    P = np.empty((nv, nv))
    q = np.zeros(nv)
    for i in range(nv):
        for j in range(i + 1):
            dot = 0.0
            for r in range(rows):
                dot += A[r, i] * A[r, j]
            P[i, j] = dot
            P[j, i] = dot
        P[i, i] += regularization
    for i in range(nv):
        for j in range(nv):
            q[i] -= P[i, j] * v0[j]
    return P, q
