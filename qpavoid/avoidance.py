"""Avoidance rows: how fast each near pair may close, as a function of its distance."""

from __future__ import annotations

import numpy as np

from qpavoid import kernels
from qpavoid.config import Avoidance, Cbf, Switching
from qpavoid.problem import Array, AvoidanceRows, Proximity


def avoidance_rows(proximity: Proximity, config: Avoidance) -> AvoidanceRows:
    """Rows J v >= b of all near pairs at once: ḋ = J v + drift stays above `closing_speed_bound`.

    Args:
        proximity: closest points of the pairs within d2.
        config: distances, offset and form of the row.

    Returns:
        The rows, in the order of `proximity`.
    """
    d = proximity.distance + config.offset
    b = closing_speed_bound(d, config) - proximity.drift
    return AvoidanceRows(proximity.pair, d, proximity.J, b, config.d1, config.d2)


def closing_speed_bound(d: Array, config: Avoidance) -> Array:
    """Lower bound on ḋ for each pair.

    With h = d - d_hold and gain ξ (d_hold is d1 for the switching row):

    - switching: -(1 - β) ξ h, and for h < 0 min(-ξ h, recovery_speed);
    - damper: -ξ h, capped in the same way (Faverjon and Tournassoud 1987, in its linear form);
    - cbf: -γ h, not capped (Ames et al. 2019, with a linear class-K function).

    Args:
        d: distances (k,) [m].
        config: which row, with which gain.

    Returns:
        (k,) [m/s].
    """
    row = config.row
    hold = config.d1 if isinstance(row, Switching) or row.d_safe is None else row.d_safe
    cap = np.inf if isinstance(row, Cbf) else config.recovery_speed
    return kernels.closing_speed_bound(d, hold, row.gain, cap, isinstance(row, Switching), config.d1, config.d2)
