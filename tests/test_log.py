"""Records of runs: what is written, read back, cut short and run again."""

from dataclasses import fields

import numpy as np
import pytest
from closed_loop import Ruler

from qpavoid import ConfigError, Controller, Log, ScenarioConfig, Severity, load_scenario
from qpavoid.run.log import STATUSES
from qpavoid.run.simulate import simulate

ARRAYS = [f.name for f in fields(Log) if f.name != "meta"]
SHORT = ("duration=0.2", "tasks.0.motion={type: circle, radius: 0.1, period: 2}")


@pytest.fixture(scope="module")
def log():
    """A run with a box among its obstacles and all kinds of metadata."""
    return simulate(load_scenario("panda_line", SHORT))


def assert_equal(a: Log, b: Log) -> None:
    for name in ARRAYS:
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
        assert getattr(a, name).dtype == getattr(b, name).dtype, name


def test_log_steps_integrate_velocities(log):
    """Each tick follows from the one before."""
    assert np.allclose(np.diff(log.q, axis=0), 0.01 * log.v[:-1], atol=1e-12)


def test_closest_pair_holds_the_smallest_distance(log):
    bodies = log.meta["bodies"]
    for k in range(len(log.t)):
        near = [name for name in log.meta["pairs"][log.closest_pair[k]] if name in bodies]
        assert near
        assert {log.body_distance[k, bodies.index(name)] for name in near} == {log.min_distance[k]}


@pytest.mark.parametrize("scenario", ["five_spheres", "panda_line", "ur5_pole"])
def test_distance_of_each_body_is_that_of_its_nearest_pair(scenario):
    """Among all pairs, each measured on its own: balls roll by, and what is nearest changes all the time."""
    config = load_scenario(scenario)
    log, (controller, _) = simulate(config), Controller.from_scenario(config)
    scene, ruler = controller.scene, Ruler(controller.scene)
    moving = [(i, obstacle.motion) for i, obstacle in enumerate(scene.slots) if obstacle.moves]
    bodies = len(scene.body_names)
    of_body = [np.flatnonzero((scene.pairs == i).any(axis=1)) for i in range(bodies)]
    for k in range(0, len(log.t), 7):
        distances = ruler.distances(log.q[k], {i: motion.sample(log.t[k]) for i, motion in moving})
        assert distances.min() == pytest.approx(log.min_distance[k], abs=1e-9)
        for i, pairs in enumerate(of_body):
            assert log.body_distance[k, i] == pytest.approx(np.min(distances[pairs], initial=np.inf), abs=1e-9)
            assert distances[log.body_pair[k, i]] == pytest.approx(log.body_distance[k, i], abs=1e-9)


def test_saved_and_loaded_log_is_the_same(log, tmp_path):
    path = log.save(tmp_path / "new" / "folder" / "run")
    assert path == tmp_path / "new" / "folder" / "run.npz"
    loaded = Log.load(path)
    assert_equal(loaded, log)
    assert loaded.meta == log.meta
    assert loaded.metrics() == log.metrics()


def test_log_versions_and_configuration(log):
    """Log knows what made it."""
    scenario = load_scenario("panda_line", SHORT)
    assert log.meta["config"] == scenario.model_dump(mode="json")
    assert log.meta["scenario"] == "panda_line"
    assert log.meta["solver"] == "qp"
    assert log.meta["robot"] == "panda"
    assert log.meta["frames"] == ["panda_hand_tcp"]
    assert [obstacle["name"] for obstacle in log.meta["obstacles"]] == ["box", "ball"]
    assert {"python", "qpavoid", "pin", "coal", "numpy", "daqp"} <= log.meta["versions"].keys()
    assert log.meta["completed"] is True
    assert log.meta["stopped_by"] is None


@pytest.mark.parametrize(
    ("scenario", "solver"),
    [("situation1", s) for s in ("tracking", "eq10-literal", "eq10", "qp", "qp:proxqp")] + [("panda_line", "qp")],
)
def test_saved_configuration_runs_again_to_the_same_bits(tmp_path, scenario, solver):
    first = simulate(load_scenario(scenario, SHORT, solver))
    saved = Log.load(first.save(tmp_path / "run"))
    again = simulate(ScenarioConfig.model_validate(saved.meta["config"]))
    assert np.abs(again.v).max() > 0.01
    for name in sorted(set(ARRAYS) - {"build_time", "solve_time"}):
        assert np.array_equal(getattr(again, name), getattr(first, name)), name


def test_until_keeps_the_ticks_before(log):
    for count in range(22):
        assert len(log.until(0.01 * count).t) == count
    part = log.until(0.1)
    assert all(np.array_equal(getattr(part, name), getattr(log, name)[:10]) for name in ARRAYS)
    assert part.meta == log.meta
    assert_equal(log.until(99.0), log)


# Runs that end early


def assert_partial(log: Log, ticks: int, whole: Log, tmp_path) -> None:
    assert np.array_equal(log.v, whole.v[:ticks])
    loaded = Log.load(log.save(tmp_path / "partial"))
    assert_equal(loaded, log)
    assert loaded.meta["completed"] is False
    assert loaded.metrics()["completed"] is False


def test_interrupt_keeps_what_was_done(log, tmp_path):
    def interrupt(done: int, total: int) -> None:
        assert total == 21
        if done >= 7:
            raise KeyboardInterrupt

    partial = simulate(load_scenario("panda_line", SHORT), progress=interrupt)
    assert 7 <= len(partial.t) < 7 + 10
    assert_partial(partial, len(partial.t), log, tmp_path)
    assert "keyboard" in partial.meta["stopped_by"]


def said(log: Log) -> list[tuple]:
    """Kind, subject and severity of all reasons in its events."""
    reasons = [reason for *_, reasons in log.meta["events"] for reason in reasons]
    return [(reason["kind"], reason["subject"], reason["severity"]) for reason in reasons]


def test_log_of_malformed_state_names_cause(log, monkeypatch, tmp_path):
    """Malformed state stops the robot and says why."""
    tick = Controller.tick

    def lose_the_encoder(self, q, t=0.0, **named):
        return tick(self, np.full_like(q, np.nan) if t > 0.045 else q, t, **named)

    monkeypatch.setattr(Controller, "tick", lose_the_encoder)
    monkeypatch.setattr(Controller, "closed_loop", lambda self: None)
    blind = simulate(load_scenario("panda_line", SHORT))
    np.testing.assert_array_equal(blind.v[:5], log.v[:5])
    stopped = blind.status == STATUSES.index("STOPPED")
    assert stopped[5:].all() and not stopped[:5].any()
    assert (np.diff(np.abs(blind.v[4:]), axis=0) <= 0.0).all() and not blind.v[-1].any()
    assert ("IMPLAUSIBLE", ["q"], "ALARM") in said(blind)
    assert (blind.severity[stopped] == Severity.ALARM).all() and (blind.severity[:5] == 0).all()
    loaded = Log.load(blind.save(tmp_path / "blind"))
    assert loaded.meta == blind.meta
    for name in ARRAYS:  # NaN is kept
        np.testing.assert_array_equal(getattr(loaded, name), getattr(blind, name))


# Files that are no logs


@pytest.mark.parametrize("kept", [0.3, 0.999])
def test_log_that_was_cut_off_while_copied(log, tmp_path, kept):
    path = log.save(tmp_path / "run")
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(ConfigError, match=r"run\.npz"):
        Log.load(path)
