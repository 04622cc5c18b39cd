"""Gains (eqs. 11, 12) and avoidance rows by hand-computed numbers, limits and monotony."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import SPHERE, Bench, make_layout, obstacle

from qpavoid import Avoidance, Sample, build_scene, kernels
from qpavoid.control.avoidance import row_form


def alpha(d, d2):
    return np.array([kernels.alpha(x, d2) for x in d])


def beta(d, d1, d2):
    return np.array([kernels.beta(x, d1, d2) for x in d])


D1, D2, XI = 0.12, 0.24, 5.0
NEAR_SPEEDS = 0.0, 0.02, 10.0


def bound(d, cap=0.2, **row):
    """Right-hand sides of rows at distances d, for a robot without limits among obstacles at rest."""
    settings = Avoidance(d1=D1, d2=D2, recovery_speed=cap, row={"type": "beta", "gain": XI, **row})
    closest = np.zeros((len(d), 10))
    closest[:, 0] = d
    free = np.full(2, np.inf)
    x = make_layout(
        2, pairs=len(d), closest=closest, near_pairs=np.arange(len(d)), feedforward=np.zeros(len(d)),
        J=np.ones((len(d), 2)), lower=-free, upper=free, **row_form(settings),
    )  # fmt: skip
    kernels.row_bounds(kernels.pack(x), len(d), False)
    return x.rhs


# --- eq. 11 --------------------------------------------------------------------------------------------------


def test_alpha_by_hand():
    """((0.24 - d) / d)²: 1 at half the influence distance, where approaching is cancelled altogether."""
    np.testing.assert_allclose(alpha(np.array([0.06, 0.08, 0.12, 0.16, 0.24, 0.5]), D2), [9, 4, 1, 0.25, 0, 0])
    values = alpha(np.linspace(1e-3, D2 + 1e-6, 500), D2)
    assert (np.diff(values[:-1]) < 0.0).all() and values[-1] == 0.0
    assert np.isposinf(alpha(np.array([0.0, -0.01, -1.0]), D2)).all()


# --- eq. 12 --------------------------------------------------------------------------------------------------


def test_beta_by_hand():
    quarter = 0.5 + 0.25 * np.sqrt(2.0)
    d = np.array([-1.0, 0.0, D1, 0.15, 0.16, 0.18, 0.20, D2, 1.0])
    np.testing.assert_allclose(beta(d, D1, D2), [1, 1, 1, quarter, 0.75, 0.5, 0.25, 0, 0], atol=1e-15)
    assert (np.diff(beta(np.linspace(D1, D2, 500), D1, D2)) < 0.0).all()
    for edge in (D1, D2):  # a kink would show as 1e-6 / (d2 - d1)
        np.testing.assert_allclose(np.diff(beta(edge + np.array([-1e-6, 0.0, 1e-6]), D1, D2)), 0.0, atol=1e-9)


# --- rows ----------------------------------------------------------------------------------------------------


def test_beta_row_by_hand():
    """-(1 - β) ξ (d - d1) outside d1: at 0.18 half of -0.3, at 0.16 a quarter of -0.2; inside it ξ (d1 - d)."""
    found = bound([0.24, 0.18, 0.16, 0.12, 0.11, 0.09])
    np.testing.assert_allclose(found, [-0.6, -0.15, -0.05, 0.0, 0.05, 0.15], atol=1e-12)


def test_beta_row_lets_a_pair_close_at_the_near_speed():
    """At 0.14 1 - β is 0.067: of ξ h = 0.1 m/s it leaves 6.7 mm/s, the near speed 20, and at 0.121 all of 5 mm/s."""
    np.testing.assert_allclose(bound([0.14, 0.121], near_speed=0.02), [-0.02, -0.005], atol=1e-12)
    np.testing.assert_allclose(bound([0.14, 0.121], near_speed=0.0), [-6.6987e-3, -8.567e-7], rtol=1e-4)
    np.testing.assert_allclose(bound([0.24, 0.18, 0.12, 0.09], near_speed=10.0), [-0.6, -0.3, 0.0, 0.15], atol=1e-12)


@pytest.mark.parametrize("near_speed", NEAR_SPEEDS)
def test_row_caps_the_recovery_speed(near_speed):
    """5 · (0.12 - d) reaches the cap of 0.2 m/s at d = 0.08, deep in penetration it is still 0.2."""
    np.testing.assert_allclose(bound([0.08, 0.05, -1.0], near_speed=near_speed), [0.2] * 3, atol=1e-12)
    np.testing.assert_allclose(bound([0.08, 0.05, -1.0], cap=None, near_speed=near_speed), [0.2, 0.35, 5.6], atol=1e-12)


@pytest.mark.parametrize("near_speed", NEAR_SPEEDS)
def test_row_is_continuous_and_falls_with_the_distance(near_speed):
    d = np.linspace(-0.1, D2, 34001)  # steps of 1e-5 m
    found = bound(d, near_speed=near_speed)
    steps = np.diff(found)
    assert (steps <= 0.0).all()
    slope = XI * (1.0 + np.pi)  # of (1 - β) ξ h at most ξ + ξ π h / 2 (d2 - d1)
    assert steps.min() >= -slope * 1e-5 - 1e-12


def test_row_met_exactly_settles_at_the_safety_distance():
    """ḋ = bound from either side: the distance settles at d1 and is not crossed."""
    dt = 0.01
    for near_speed in NEAR_SPEEDS:
        d = np.array([0.23, 0.05])
        for _ in range(600):
            d = d + dt * bound(d, near_speed=near_speed)
            assert d[0] >= D1 - 1e-12 and d[1] <= D1 + 1e-12
        assert d[1] == pytest.approx(D1, abs=1e-9)


def test_rows_include_offset_and_feedforward(panda):
    """ḋ = J v + drift >= bound becomes J v >= bound - drift; one ball touches the arm, one is out of reach."""
    places = [(0.25, 0.0, 0.6), (9.0, 0.0, 0.0), (0.1, 0.3, 0.3)]
    panda = replace(panda, acceleration={})
    scene = build_scene(panda, [obstacle(f"o{i}", SPHERE, place) for i, place in enumerate(places)])
    settings = Avoidance(d1=D1, d2=D2, offset=0.1, row={"type": "beta", "gain": XI})
    bench = Bench(scene, avoidance=settings)
    bench.place({i: Sample.at(place, linear=[0.1, 0.2, -0.3]) for i, place in enumerate(places)})
    everything, _ = bench.compute(panda.home)
    distance, rate = everything.distance.copy(), everything.feedforward.copy()
    near = np.flatnonzero(distance < D2 - 0.1)
    proximity, problem = bench.compute(panda.home, reach=D2 - 0.1)
    rows = problem.avoidance
    assert 3 < len(near) < len(distance)
    np.testing.assert_array_equal(rows.pair, near)
    np.testing.assert_allclose(rows.d, distance[near] + 0.1, rtol=0, atol=1e-12)
    h = rows.d - D1
    closing = np.maximum((1.0 - beta(rows.d, D1, D2)) * XI * h, np.minimum(XI * h, settings.row.near_speed))
    expected = np.where(h < 0.0, np.minimum(-XI * h, settings.recovery_speed), -closing)
    most = np.maximum(rows.J * problem.lower, rows.J * problem.upper).sum(axis=1)  # the fastest that the arm can part
    most = np.where(rate[near] < 0.0, np.maximum(most, -rate[near]), most)
    expected = np.where(h < 0.0, np.minimum(expected - rate[near], most), expected - rate[near])
    np.testing.assert_allclose(rows.b, expected, rtol=0, atol=1e-12)
    assert (h < 0.0).any() and (h > 0.0).any() and np.ptp(rate[near]) > 0.1
    np.testing.assert_array_equal(rows.J, proximity.J)
    np.testing.assert_array_equal(proximity.feedforward, rate[near])


@pytest.mark.parametrize("kind", ["beta", "task-switching"])
def test_rows_of_no_pair_are_none(kind, panda):
    bench = Bench(build_scene(panda), avoidance=Avoidance(row={"type": kind}))
    rows = bench.compute(panda.home, reach=-1.0)[1].avoidance
    assert rows.J.shape == (0, 7) and rows.pair.shape == rows.d.shape == rows.b.shape == (0,)
    assert alpha(rows.d, rows.d2).shape == beta(rows.d, rows.d1, rows.d2).shape == (0,)
