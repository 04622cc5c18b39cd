"""A line through the last poses of an obstacle: where it is, and its twist as the slope.

A *state* is a row of 18, see `kernels.obstacles`.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.tasks import _rotation_vector
from qpavoid.problem import Array

FIT = 27
"""Numbers in the fit of an obstacle's poses: its last pose; the weighted sums of 1, x, x², y and x y over all poses,
with times x and displacements y (6,) from the last one, rotations as vectors."""
POSE_WEIGHT = 0.6
"""Weight of a pose in the fit, to that of the next one [-]: errors are those of a line through 7 poses of equal weight;
a change of velocity takes 3 poses."""
_JUMP = 0.03, 0.3
"""Distance [m] and angle [rad] from the fit at which a pose starts it anew: several times the noise of a camera."""


@compiled
def fit_pose(x: Array, fit: Array, interval: float, max_speed: float, y: Array, line: Array) -> bool:
    """Put a pose on the line through it and those before, and estimate its twist as the slope of that line.

    The line of least weighted squares, a + b x with times x from now and displacements from this pose: the pose is
    moved by a, and gets the twist b. Two poses give the difference over the interval, one gives a twist of zero.

    Args:
        x: state (18,) with a pose; overwritten.
        fit: (FIT,) of the poses before; overwritten.
        interval: time since the pose before [s].
        max_speed: largest component of a twist between two poses [m/s, rad/s].
        y: scratch (6,).
        line: scratch (2, 6).

    Returns:
        False where the pose is too far from the one before for that; nothing is changed then.
    """
    T = interval
    for c in range(6):
        y[c] = 0.0
    if fit[12] > 0.0:
        for r in range(3):
            y[r] = x[9 + r] - fit[9 + r]
        y[3], y[4], y[5] = _rotation_vector((_row(x, fit, 0), _row(x, fit, 1), _row(x, fit, 2)))
        for c in range(6):
            if not abs(y[c]) <= max_speed * interval:
                return False
        _write_line(fit, line)
        shift, turn = 0.0, 0.0
        for c in range(3):
            shift += (y[c] - line[0, c] - T * line[1, c]) ** 2
            turn += (y[3 + c] - line[0, 3 + c] - T * line[1, 3 + c]) ** 2
        if np.sqrt(shift) > _JUMP[0] or np.sqrt(turn) > _JUMP[1]:
            _restart(fit)
    s, sx, sxx = fit[12], fit[13], fit[14]
    for c in range(6):
        sy, sxy = fit[15 + c], fit[21 + c]
        fit[15 + c] = POSE_WEIGHT * (sy - y[c] * s)
        fit[21 + c] = POSE_WEIGHT * (sxy - y[c] * sx - T * sy + T * y[c] * s)
    fit[12], fit[13] = 1.0 + POSE_WEIGHT * s, POSE_WEIGHT * (sx - T * s)
    fit[14] = POSE_WEIGHT * (sxx - 2.0 * T * sx + T * T * s)
    for c in range(12):
        fit[c] = x[c]
    _write_line(fit, line)
    for c in range(6):
        x[12 + c] = line[0, c]
    extrapolate(x, 1.0)
    for c in range(6):
        x[12 + c] = line[1, c]
    return True


@compiled
def _row(x: Array, fit: Array, r: int) -> tuple[float, float, float]:
    """Return a row of R(x) R(fit)ᵀ, the rotation from one pose to another."""
    return (
        x[r] * fit[0] + x[3 + r] * fit[3] + x[6 + r] * fit[6],
        x[r] * fit[1] + x[3 + r] * fit[4] + x[6 + r] * fit[7],
        x[r] * fit[2] + x[3 + r] * fit[5] + x[6 + r] * fit[8],
    )


@compiled
def start_fit(fit: Array, pose: Array) -> None:
    """Let the fit (FIT,) begin with one pose (12,), the first entries of `pose`."""
    for c in range(12):
        fit[c] = pose[c]
    _restart(fit)


@compiled
def _restart(fit: Array) -> None:
    """Let the fit (FIT,) begin with its last pose."""
    fit[12] = 1.0
    for c in range(13, FIT):
        fit[c] = 0.0


@compiled
def _write_line(fit: Array, line: Array) -> None:
    """Write displacement and slope, rows of `line`, of a fit at its last pose; zero of less than two poses."""
    s, sx, sxx = fit[12], fit[13], fit[14]
    det = s * sxx - sx * sx
    for c in range(6):
        line[0, c] = (sxx * fit[15 + c] - sx * fit[21 + c]) / det if det > 0.0 else 0.0
        line[1, c] = (s * fit[21 + c] - sx * fit[15 + c]) / det if det > 0.0 else 0.0


@compiled
def extrapolate_states(states: Array, times: Array) -> None:
    """Bring bodies to where they are some time later at constant twists about their origins.

    Args:
        states: (k, 18), overwritten.
        times: (k,) [s].
    """
    for k in range(len(states)):
        extrapolate(states[k], times[k])


@compiled
def extrapolate(x: Array, t: float) -> None:
    """Bring one body (18,) to where it is after t [s]: p + t v, and R + sin φ [a] R + (1 - cos φ) [a]² R.

    The angle is φ = t |ω|, about the axis a = ω / |ω| (Rodrigues).
    """
    for r in range(3):
        x[9 + r] += t * x[12 + r]
    rate = np.sqrt(x[15] * x[15] + x[16] * x[16] + x[17] * x[17])
    if rate > 0.0:
        ax, ay, az = x[15] / rate, x[16] / rate, x[17] / rate
        sin, versin = np.sin(t * rate), 2.0 * np.sin(0.5 * t * rate) ** 2
        for c in range(3):
            u, v, w = x[3 * c], x[3 * c + 1], x[3 * c + 2]
            cu, cv, cw = ay * w - az * v, az * u - ax * w, ax * v - ay * u
            x[3 * c] += sin * cu + versin * (ay * cw - az * cv)
            x[3 * c + 1] += sin * cv + versin * (az * cu - ax * cw)
            x[3 * c + 2] += sin * cw + versin * (ax * cv - ay * cu)
