"""Poses and samples that a program gives: of obstacles, and of targets."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from qpavoid.errors import NumericalError
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, as_vector

_SHAPES = {"position": (3,), "rotation": (3, 3), "linear": (3,), "angular": (3,)}
_FLOAT = np.dtype(np.float64)
_AT_REST = np.zeros(3)
_AT_REST.setflags(write=False)


class Pose(NamedTuple):
    """Where an obstacle was seen, when nothing is known of its velocity."""

    position: Array
    """(3,) world position [m]."""
    rotation: Array
    """(3, 3) body axes to world axes."""
    t: float | None = None
    """Time stamp: when it was there [s]; the time of the control step if left out."""
    at_rest: bool = False
    """Whether it stays there until another pose is given: it is never stale."""

    @classmethod
    def at(
        cls, position: ArrayLike, rotation: ArrayLike | None = None, t: float | None = None, at_rest: bool = False
    ) -> Pose:
        """Make copies of what is given, checked; along the world axes where no rotation is given.

        Raises:
            NumericalError: an entry has the wrong shape, or holds what is not a finite number.
        """
        sample = Sample.at(position, rotation)
        return cls(sample.position, sample.rotation, t, at_rest)


def is_sample_of_arrays(sample: Sample) -> bool:
    """Return True if the parts of a sample are float arrays of the right shapes already."""
    position, rotation, linear, angular, _, _ = sample
    try:
        return (
            position.shape == linear.shape == angular.shape == (3,)
            and rotation.shape == (3, 3)
            and position.dtype is linear.dtype is angular.dtype is rotation.dtype is _FLOAT
        )
    except AttributeError:
        return False


def as_sample(what: Any) -> Any:
    """A sample or pose whose parts are float arrays of the right shapes, whatever their numbers are.

    Raises:
        NumericalError: wrong shapes, or not numbers; names the part.
    """
    if type(what) is Sample and is_sample_of_arrays(what):
        return what
    if not isinstance(what, (Sample, Pose)):
        remedy = "give Sample.at(position, rotation, linear, angular), all but the first optional"
        raise NumericalError(f"neither a Sample nor a Pose: {' '.join(repr(what).split()):.60}; {remedy}")
    parts = [as_vector(name, getattr(what, name), _SHAPES[name]) for name in what._fields[:-2]]
    kind_of: Any = type(what)
    return kind_of(*parts, what.t, what.at_rest)


def as_goal(what: Any) -> Sample:
    """`as_sample` of what a task should reach: a bare `Pose` is one at rest."""
    sample = as_sample(what)
    return sample if isinstance(sample, Sample) else Sample(sample.position, sample.rotation, _AT_REST, _AT_REST)
