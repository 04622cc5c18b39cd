"""Gains that switch between tracking and avoiding (eqs. 11, 12)."""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array


def alpha(d: Array, d2: float) -> Array:
    """Compute the share of the approaching primary motion that is removed (eq. 11).

    Args:
        d: distances (k,) [m].
        d2: influence distance [m].

    Returns:
        (k,) 0 for d >= d2, ((d2 - d)/d)² below, infinite for d <= 0 [-]; callers cap it.
    """
    with np.errstate(divide="ignore"):
        ratio = np.maximum(d2 - d, 0.0) / np.maximum(d, 0.0)
    return np.asarray(ratio * ratio)


def beta(d: Array, d1: float, d2: float) -> Array:
    """Compute the weight of the avoidance task (eq. 12).

    Args:
        d: distances (k,) [m].
        d1: distance below which it is 1 [m].
        d2: distance above which it is 0 [m].

    Returns:
        (k,) cosine blend from 1 at d1 to 0 at d2 [-].
    """
    fraction = np.minimum(np.maximum((d - d1) / (d2 - d1), 0.0), 1.0)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * fraction))
