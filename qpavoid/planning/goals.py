"""What a plan is to attain: configurations, or poses of frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from qpavoid.errors import NumericalError
from qpavoid.kernels.planning_goals import FrameTargets
from qpavoid.model.robot import Robot
from qpavoid.model.sample import POSE, as_sample
from qpavoid.problem import Array, as_numbers

Frame = str | tuple[str, str]
"""Name of a frame; or of a frame, and of another one in whose axes its target is given."""

NO_TARGETS = FrameTargets(
    np.zeros(0, dtype=np.intp), np.zeros((0, 12)), np.zeros(0, dtype=bool), np.zeros(0, dtype=bool), 0
)
"""Where goals are configurations."""


def read_targets(robot: Robot, targets: Mapping[Frame, Any]) -> tuple[FrameTargets, list[int]]:
    """Read where frames should be.

    Args:
        robot: with these frames.
        targets: by frame: `Sample`, `Pose`, `pin.SE3` or 4×4 matrix for a pose, a position (3,) or an orientation
            (3, 3) alone. A pair (frame, other) has its target in the axes of the other frame.

    Returns:
        The targets; the frames that kinematics have to keep up to date, those of the targets first.

    Raises:
        UnknownName: there is no such frame.
        NumericalError: a target of another shape, NaN or infinity; no targets.
    """
    if not targets:
        raise NumericalError("targets: empty; give a mapping of frames to poses or positions")
    pairs = [(key, None) if isinstance(key, str) else (key[0], key[1]) for key in targets]
    frames = [robot.frame_id(frame, "targets") for frame, _ in pairs]
    others = [robot.frame_id(other, "targets") for _, other in pairs if other is not None]
    base, next_base = np.full(len(pairs), -1, dtype=np.intp), len(pairs)
    for k, (_, other) in enumerate(pairs):
        if other is not None:
            base[k], next_base = next_base, next_base + 1
    parts = [_read(f"targets: {frame}", target) for (frame, _), target in zip(pairs, targets.values(), strict=True)]
    poses = np.array([pose for pose, *_ in parts])
    has_position = np.array([position for _, position, _ in parts])
    has_rotation = np.array([rotation for *_, rotation in parts])
    rows = 3 * int(has_position.sum() + has_rotation.sum())
    return FrameTargets(base, poses, has_position, has_rotation, rows), frames + others


def _read(name: str, target: Any) -> tuple[Array, bool, bool]:
    """Return a target's pose (12,), whether its position counts, and whether its orientation does."""
    array = target if not hasattr(target, "row") and not hasattr(target, "translation") else None
    if array is not None and np.shape(array) in ((3,), (3, 3)):
        numbers, pose = as_numbers(name, array), np.eye(3).ravel()
        pose = np.append(pose, numbers) if numbers.shape == (3,) else np.append(numbers.T.ravel(), np.zeros(3))
        is_position = numbers.shape == (3,)
    else:
        pose, is_position = np.array(as_sample(target).row[:POSE]), None
    if not np.isfinite(pose).all():
        raise NumericalError(f"{name}: NaN or infinity")
    return pose, is_position is not False, is_position is not True


def read_goals(q: Any, nq: int) -> Array:
    """Read goal configurations (k, nq), of one (nq,) or several.

    Raises:
        NumericalError: wrong shape, NaN or infinity.
    """
    goals = np.atleast_2d(as_numbers("q_goal", q))
    if goals.ndim != 2 or goals.shape[1] != nq or not len(goals):
        raise NumericalError(f"q_goal: shape {np.shape(q)}, expected ({nq},) or (k, {nq})")
    if not np.isfinite(goals).all():
        raise NumericalError("q_goal: NaN or infinity")
    return goals
