"""A frame that follows a motion."""

from __future__ import annotations

from qpavoid import config
from qpavoid.control.tasks.base import PARTS, RowTask
from qpavoid.control.tasks.start import Start
from qpavoid.model.trajectory import Motion


class FrameTask(RowTask):
    """One frame and the motion that it follows: v_frame = v_ref + K (x_ref - x). Kernels write its rows."""

    settings: config.Task
    motion: Motion

    def __init__(self, settings: config.Task, start: Start) -> None:
        self.frame_id = start.frame_id(settings.frame)
        motion = start.motion(settings.motion, start.data.oMf[self.frame_id])
        super().__init__(settings, motion, len(range(6)[PARTS[settings.type]]), (self.frame_id,))
        self.moves = settings.type != "orientation"
        """Whether the position counts."""
        self.turns = settings.type != "position"
        """Whether the orientation counts."""
