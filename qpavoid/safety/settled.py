"""Backup trajectories in settled control steps: in one compiled call, whether the kept one stays valid."""

from __future__ import annotations

import numpy as np

from qpavoid import kernels
from qpavoid.control.assembler import RowAssembler
from qpavoid.kernels.rollout import HORIZON
from qpavoid.safety.rollout import ROUND_OFF, BackupRollouts, BackupTrajectory


class SettledSteps:
    """Checks kept trajectories with what the control step has in the memory of the kernels."""

    def __init__(self, rollouts: BackupRollouts, rows: RowAssembler) -> None:
        """Compile the check; `rows` are those of the control step."""
        self._rollouts, self._rows, self._separable = rollouts, rows, rollouts.query.table.separable
        if not rollouts.adds_up:
            return
        path = np.zeros((2, len(rows.v)))
        self._offset = kernels.direct(
            kernels.offset_after_step, rollouts.packed_memory, rows.packed, rows.q, path, path, 1, rollouts.enabled,
            self._separable, rollouts.is_accelerated,
        )  # fmt: skip

    def leaves_valid(self, trajectory: BackupTrajectory, steps: int, t: float) -> bool:
        """Return whether a sufficient trajectory is certainly so after the step at t [s], without its first steps.

        False says nothing. The step is settled, at the velocity of the rows, and obstacles move as the trajectory has
        it; see `BackupRollouts.is_valid_from`.
        """
        x, start = self._rollouts, trajectory.start
        if not x.adds_up:
            return False
        end, then = t + x.dt, start.t + steps * x.dt
        if len(trajectory.v) <= steps or trajectory.contact_time < end + HORIZON - 1e-9 or abs(end - then) > ROUND_OFF:
            return False
        rows = self._rows
        offset = self._offset(
            x.packed_memory, rows.packed, rows.q, trajectory.q, trajectory.v, steps, start.enabled, self._separable,
            x.is_accelerated,
        )  # fmt: skip
        return bool(trajectory.clearance - x.lever_arm * offset >= x.sufficient_score.clearance)
