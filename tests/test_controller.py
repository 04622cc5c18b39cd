"""The embeddable tick: what it accepts, and that bad input is named and leaves it usable."""

import numpy as np
import pytest

from qpavoid import (
    Avoidance,
    Controller,
    NumericalError,
    Obstacle,
    Sample,
    Status,
    UnknownName,
    build_scene,
    build_tasks,
    kernels,
)
from qpavoid.config import Sphere, Task


@pytest.fixture
def controller(panda):
    scene = build_scene(panda, [Obstacle.at("ball", Sphere(radius=0.05), [0.6, 0.0, 0.5])])
    tasks = build_tasks([Task(frame="panda_hand_tcp")], panda, panda.home)
    return Controller(scene, tasks, "qp", dt=0.01, avoidance=Avoidance(d1=0.03, d2=0.2))


def test_an_obstacle_that_moves_while_the_robot_rests_is_seen(controller, panda):
    far = controller.step(panda.home, obstacles={"ball": Sample.at([2.0, 0.0, 0.5])})
    np.testing.assert_allclose(far.v, 0.0, atol=1e-9)
    near = controller.step(panda.home, obstacles={"ball": Sample.at([0.45, 0.0, 0.5], linear=[-0.3, 0.0, 0.0])})
    assert np.abs(near.v).max() > 1e-3


def test_targets_given_by_the_caller_replace_the_motion(controller, panda):
    here = controller.tick(panda.home).kinematics.position[0]
    solution = controller.step(panda.home, targets={"panda_hand_tcp": Sample.at(here + np.array([0.0, 0.0, 0.05]))})
    assert solution.status is Status.SOLVED
    assert np.abs(solution.v).max() > 1e-2


@pytest.mark.parametrize("field", ["position", "linear", "angular", "rotation"])
def test_nan_in_an_obstacle_is_named_and_the_next_tick_works(controller, panda, field):
    good = Sample.at([0.6, 0.0, 0.5])
    before = controller.step(panda.home, obstacles={"ball": good}).v
    bad = good._replace(**{field: np.full_like(getattr(good, field), np.nan)})
    with pytest.raises(NumericalError, match="obstacle 'ball': NaN"):
        controller.step(panda.home, obstacles={"ball": bad})
    np.testing.assert_allclose(controller.step(panda.home, obstacles={"ball": good}).v, before, atol=1e-9)


@pytest.mark.parametrize("q", [np.full(7, np.nan), np.zeros(6), "home", np.r_[np.zeros(6), np.inf]])
def test_bad_states_are_named(controller, q):
    with pytest.raises(NumericalError, match=r"^q: "):
        controller.step(q)


def test_unknown_names_come_with_the_nearest(controller, panda):
    with pytest.raises(UnknownName, match=r"no target 'panda_hand'; did you mean 'panda_hand_tcp'"):
        controller.step(panda.home, targets={"panda_hand": Sample.at([0, 0, 0])})
    with pytest.raises(UnknownName, match=r"no obstacle 'bal'; did you mean 'ball'"):
        controller.step(panda.home, obstacles={"bal": Sample.at([0, 0, 0])})


def test_nan_distances_stop_the_robot_instead_of_being_dropped(controller, panda):
    """Whatever makes coal return NaN: the pair is not hidden."""
    query = controller._query
    poisoned = np.array(query._results)
    poisoned[:, 0] = np.nan
    query._results = poisoned
    solution = controller.step(panda.home)
    assert solution.status is Status.STOPPED
    np.testing.assert_array_equal(solution.v, 0.0)


@pytest.mark.skipif(not kernels.ACCELERATED, reason="nothing is compiled")
def test_nothing_is_compiled_after_construction(controller, panda):
    def compiled():
        return {name: len(getattr(kernels, name).signatures) for name in kernels.__all__ if name != "ACCELERATED"}

    assert controller.warm_up_time > 0.0
    before = compiled()
    for x in (2.0, 0.45, 0.40):  # out of range, in range, so near that the QP is needed
        controller.step(panda.home, obstacles={"ball": Sample.at([x, 0.0, 0.5], linear=[-0.3, 0.0, 0.0])})
    assert compiled() == before
