"""Avoidance rows: how fast each near pair may close, as a function of its distance.

With h = d - hold and gain ξ (hold is d1 for the switching row, d_safe for the others), ḋ = J v + drift stays above

- switching: -(1 - β) ξ h, and for h < 0 min(-ξ h, recovery_speed);
- damper: -ξ h, capped in the same way (Faverjon and Tournassoud 1987, in its linear form);
- cbf: -γ h, not capped (Ames et al. 2019, with a linear class-K function).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.config import Avoidance, Cbf, Switching


def row_form(config: Avoidance) -> dict[str, Any]:
    """The numbers of a row, as `RowLayout` has them."""
    row = config.row
    return {
        "offset": config.offset,
        "hold": config.hold,
        "row_gain": row.gain,
        "recovery": np.inf if isinstance(row, Cbf) else config.recovery_speed,
        "switching": isinstance(row, Switching),
        "d1": config.d1,
        "d2": config.d2,
    }
