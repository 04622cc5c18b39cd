"""Time stamps, rests and points of single updates of obstacles, and the reasons why one is not used."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from qpavoid.config import ObstacleShape, PointCloud
from qpavoid.control.inputs import as_time
from qpavoid.errors import NumericalError
from qpavoid.model.cloud import Points, Voxels
from qpavoid.model.sample import Sample
from qpavoid.reason import Reason, ReasonKind, Severity

_FLAGS = {bool, np.bool_}


def unlikely(name: str, detail: str) -> Reason:
    """Return the reason why an update of an obstacle is not used."""
    return Reason.of(ReasonKind.IMPLAUSIBLE, name, severity=Severity.WARNING, detail=detail)


def ignored(name: str) -> Reason:
    """Return the reason why an update of an attached obstacle is not used."""
    return Reason.of(ReasonKind.IGNORED, name, detail="attached to the robot")


def rest_flags(names: Sequence[str], samples: Sequence[Any]) -> list[bool]:
    """Return which of some samples or bare poses are at rest.

    Raises:
        NumericalError: that is neither true nor false, or one at rest has a velocity; names the obstacle.
    """
    for name, sample in zip(names, samples, strict=True):
        if type(sample.at_rest) not in _FLAGS:
            raise NumericalError(f"obstacle {name!r}: at_rest: {sample.at_rest!r:.60}; give true or false")
        if sample.at_rest and isinstance(sample, Sample) and (np.any(sample.linear) or np.any(sample.angular)):
            raise NumericalError(f"obstacle {name!r}: at_rest, but it has a velocity; leave one of them out")
    return [bool(sample.at_rest) for sample in samples]


def time_stamp(name: str, sample: Any, t: float) -> float:
    """Return the time stamp of a sample [s]: t, that of the step, where it brings none."""
    return t if sample.t is None else as_time(f"obstacle {name!r}: t", sample.t)


def read_voxels(name: str, shape: ObstacleShape, cloud: Points, notes: list[Reason]) -> Voxels | None:
    """Return the voxels of points that are given of an obstacle; None where none of them can be used.

    Raises:
        NumericalError: it is no point cloud, or its voxels are of another size.
    """
    if not isinstance(shape, PointCloud):
        raise NumericalError(f"obstacle {name!r}: points of a {shape.type}; give a Sample or a Pose")
    if isinstance(cloud.points, Voxels):
        voxels = cloud.points
        if voxels.resolution != shape.resolution:
            raise NumericalError(
                f"obstacle {name!r}: voxels of {voxels.resolution} m, but its resolution is {shape.resolution}"
            )
    else:
        try:
            voxels = Voxels.of(cloud.points, shape.resolution)
        except NumericalError as error:
            raise NumericalError(f"obstacle {name!r}: {error}") from None
    if voxels.dropped:
        everything = voxels.dropped == voxels.given
        notes.append(
            Reason.of(
                ReasonKind.POINTS_DROPPED,
                name,
                amount=voxels.dropped,
                unit="-",
                severity=Severity.WARNING if everything else None,
                detail=f"of {voxels.given}: NaN, infinite or more than 100 m away",
            )
        )
        if everything:
            return None
    return voxels
