"""Avoidance rows: how fast each near pair may close, as a function of its distance."""

from __future__ import annotations

import numpy as np

from qpavoid import gains
from qpavoid.config import Avoidance, Cbf, Switching
from qpavoid.problem import Array, AvoidanceRows, Proximity


def avoidance_rows(proximity: Proximity, config: Avoidance) -> AvoidanceRows:
    """Rows J v + drift >= bound of all near pairs at once.

    Args:
        proximity: closest points; its near pairs are those within d2.
        config: distances, offset and form of the row.

    Returns:
        The rows, in the order of `proximity.near`.
    """
    d = proximity.distance[proximity.near] + config.offset
    beta = gains.beta(d, config.d1, config.d2)
    return AvoidanceRows(
        pair=proximity.near,
        d=d,
        J=proximity.J,
        drift=proximity.drift,
        bound=closing_speed_bound(d, beta, config),
        alpha=gains.alpha(d, config.d2),
        beta=beta,
    )


def closing_speed_bound(d: Array, beta: Array, config: Avoidance) -> Array:
    """Lower bound on ḋ for each pair.

    With h = d - d_hold and gain ξ (d_hold is d1 for the switching row):

    - switching: -(1 - β) ξ h, and for h < 0 min(-ξ h, recovery_speed);
    - damper: -ξ h, capped in the same way (Faverjon and Tournassoud 1987, in its linear form);
    - cbf: -γ h, not capped (Ames et al. 2019, with a linear class-K function).

    Args:
        d: distances (k,) [m].
        beta: eq. 12 at these distances (k,).
        config: which row, with which gain.

    Returns:
        (k,) [m/s].
    """
    row = config.row
    hold = config.d1 if isinstance(row, Switching) or row.d_safe is None else row.d_safe
    bound = -row.gain * (d - hold)
    if isinstance(row, Cbf):
        return bound
    if isinstance(row, Switching):
        bound = np.where(d >= hold, (1.0 - beta) * bound, bound)
    return np.minimum(bound, config.recovery_speed)
