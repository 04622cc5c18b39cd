"""A depth camera: its lens, where it is, and what depths it measures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from qpavoid.errors import ConfigError, NumericalError
from qpavoid.kernels.obstacles import NEARLY
from qpavoid.problem import Array, require_finite

_MOST_PIXELS = 8_000_000
"""Pixels of an image, at most [-]: each of them is looked at."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion, as its driver's rectified depth images have it.

    Its axes: x to the right of the picture, y down, z into it.
    """

    lens: Array
    """fx, fy, cx, cy: focal lengths, and the pixel that the axis z goes through, that of the first one's centre being 0
    [pixels]."""
    width: int
    height: int
    pose: Array
    """(12,) axes by columns, position [m]: in the world, or in a frame of the robot."""
    frame: str | None
    """Frame of the robot that the camera is mounted on; None for one that stands still."""
    ranges: tuple[float, float]
    """Least and largest depth that counts [m]."""
    unit: float
    """Of one step of an image's numbers [m]: 0.001 of those in millimetres."""

    @classmethod
    def at(
        cls,
        position: ArrayLike,
        rotation: ArrayLike,
        lens: ArrayLike,
        size: tuple[int, int],
        frame: str | None = None,
        ranges: tuple[float, float] = (0.1, 4.0),
        unit: float = 1.0,
    ) -> Camera:
        """Make a camera; what cannot be meant is refused.

        Args:
            position: (3,) in the world, or in `frame` [m].
            rotation: (3, 3) its axes as columns.
            lens: fx, fy, cx, cy (4,) [pixels].
            size: width and height [pixels].
            frame: frame of the robot that it is mounted on; the world if left out.
            ranges: least and largest depth that counts [m].
            unit: of the numbers in the images [m].

        Raises:
            ConfigError: naming the argument.
        """
        try:
            turn, place = require_finite("rotation", rotation, (3, 3)), require_finite("position", position, (3,))
            numbers = require_finite("lens", lens, (4,))
        except NumericalError as error:
            raise ConfigError(f"camera: {error}") from None
        if np.abs(turn.T @ turn - np.eye(3)).max() > NEARLY or np.linalg.det(turn) < 0.0:
            raise ConfigError("camera: rotation: no rotation (3, 3) with the camera's axes as columns")
        if not (numbers[:2] > 0.0).all():
            raise ConfigError(f"camera: lens: focal lengths {numbers[0]:g}, {numbers[1]:g}; expected more than 0")
        width, height = size
        if not (width > 0 and height > 0 and width * height <= _MOST_PIXELS):
            raise ConfigError(f"camera: size: {width} x {height}; expected at most {_MOST_PIXELS} pixels")
        if not (0.0 < ranges[0] < ranges[1] < np.inf and 0.0 < unit < np.inf):
            raise ConfigError(f"camera: ranges {ranges}, unit {unit}; expected 0 < least < largest, in metres")
        pose = np.concatenate((turn.T.ravel(), place))
        return cls(numbers.copy(), int(width), int(height), pose, frame, (float(ranges[0]), float(ranges[1])), unit)
