"""Avoidance rows: how fast each near pair may close, as a function of its distance.

With h = d - d1 and gain ξ, ḋ = J v + ḋ_obs stays above

- beta: -max((1 - β) ξ h, min(ξ h, near_speed)), and for h < 0 min(-ξ h, recovery_speed): far off it is slowed down by
  β of eq. 12, and near d1, where that would let it creep, it goes on at a walking speed. A large near_speed leaves
  -ξ h, the velocity damper (Faverjon and Tournassoud 1987, in its linear form), which without the cap is the control
  barrier function of Ames et al. 2019 with a linear class-K function;
- task-switching: (1 - β)(1 - α) min(u, ẋ0) + β ẋ0, at least -ξ h for h < 0 and at most recovery_speed. That is the rate
  of eq. 10 with the consistent bracket. u = J v0 + ḋ_obs is the rate that tracking alone would give; α, capped, counts
  for u < 0 only. No more of h than there is may be used in a tick: ḋ >= -h / dt.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.config import Avoidance, Beta, TaskSwitching


def row_form(config: Avoidance) -> dict[str, Any]:
    """The numbers of a row, as `RowLayout` has them."""
    row = config.row
    return {
        "offset": config.offset,
        "row_gain": row.gain,
        "recovery_speed": np.inf if config.recovery_speed is None else config.recovery_speed,
        "near_speed": row.near_speed if isinstance(row, Beta) else 0.0,
        "task_switching": isinstance(row, TaskSwitching),
        "retreat_speed": row.retreat_speed if isinstance(row, TaskSwitching) else 0.0,
        "alpha_cap": row.alpha_cap if isinstance(row, TaskSwitching) else 0.0,
        "d1": config.d1,
        "d2": config.d2,
    }
