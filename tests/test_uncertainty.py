"""What an obstacle may be off counts as if it were so much larger: the same velocities, to rounding."""

import numpy as np
import pytest
from closed_loop import cartesian, drive, make_controller
from hypothesis import example, given, settings
from hypothesis import strategies as st

from qpavoid import Avoidance, ConfigError, Obstacle, Pose
from qpavoid.config import Line, Sphere
from qpavoid.model.trajectory import build_motion

FAR = 0.15
"""An uncertainty beyond d2 - d1 [m]: rows have to begin before d2 between surfaces."""


def loop(robot, kind, radius, uncertainty, offset):
    """Velocities towards a goal behind a ball, which rests, comes nearer on a trajectory, or is given at first."""
    shape, place = Sphere(radius=radius), np.array([0.6, offset, 0.0])
    ball = Obstacle.at("ball", shape, place, uncertainty=uncertainty)
    if kind == "trajectory":
        line = Line(start=(0.6, offset, 0.0), displacement=(-0.3, 0.0, 0.0), speed=0.2)
        ball = Obstacle("ball", shape, build_motion(line, None, None), moves=True, uncertainty=uncertainty)
    controller = make_controller(robot, [ball], "z", avoidance=Avoidance(d1=0.02, d2=0.1))
    seen = (lambda t: {"ball": Pose.at(place - [0.1 * t, 0, 0])} if t < 0.5 else None) if kind == "given" else None
    ticks = drive(controller, np.zeros(3), 90, target=np.array([0.9, 0.0, 0.0]), obstacles=seen)
    return np.array([tick.solution.v for tick in ticks])


@pytest.fixture(scope="module")
def tool(tmp_path_factory):
    return cartesian(tmp_path_factory.mktemp("uncertainty"))


@settings(max_examples=6, deadline=None)
@given(uncertainty=st.sampled_from([0.003, 0.05, FAR]), offset=st.floats(-0.05, 0.05))
@example(uncertainty=FAR, offset=0.015625)
@pytest.mark.parametrize("kind", ["rest", "trajectory", "given"])
def test_an_uncertain_obstacle_is_avoided_as_a_larger_one(tool, kind, uncertainty, offset):
    larger = loop(tool, kind, 0.05 + uncertainty, 0.0, offset)
    assert np.abs(loop(tool, kind, 0.05, uncertainty, offset) - larger).max() < 1e-7
    assert np.abs(loop(tool, kind, 0.05, 0.0, offset) - larger).max() > 1e-2


@pytest.mark.parametrize("wrong", [-1e-3, np.nan, np.inf])
def test_an_uncertainty_that_is_none_is_refused(wrong):
    with pytest.raises(ConfigError, match="uncertainty"):
        Obstacle.at("ball", Sphere(radius=0.1), (1.0, 0.0, 0.0), uncertainty=wrong)
