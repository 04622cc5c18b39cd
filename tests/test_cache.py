"""Hulls and capsules from the disk cache: the same as without it, and no worse off when it is damaged."""

import os
import subprocess
import sys
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from conftest import EXAMPLES, random_q

from qpavoid import Robot
from qpavoid.geometry import bodies, cache
from qpavoid.geometry.bodies import enclosing_capsule
from qpavoid.geometry.cache import VERSION, cache_folder
from qpavoid.geometry.capsules import fit_capsule

PANDA = EXAMPLES / "panda_description/urdf/panda.urdf"
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache."""
    monkeypatch.setenv("QPAVOID_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def made(monkeypatch):
    """What was computed, in order."""
    names = []

    def counted(name):
        original = getattr(bodies, name)
        monkeypatch.setattr(bodies, name, lambda *arguments: [names.append(name), original(*arguments)][1])

    counted("run_qhull")
    counted("fit_capsule")
    return names


def make_mesh(points=CUBE):
    """A triangle mesh that has these vertices."""
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(12, len(points))
    mesh.addVertices(points)
    mesh.addTriangles(np.array([[0, 1, 2], [1, 2, 3]]))
    mesh.endModel()
    return mesh


def numbers(fit):
    return np.concatenate((fit.center, fit.rotation.ravel(), (fit.radius, fit.length)))


def files(folder):
    return sorted(folder.glob("*")) if folder.is_dir() else []


# --- the same results -----------------------------------------------------------------------------------------


def test_capsules_are_the_same_bit_for_bit(folder, made, monkeypatch):
    first = Robot.from_urdf(PANDA, bodies="capsule")
    assert {*made} == {"run_qhull", "fit_capsule"}
    made.clear()
    again = Robot.from_urdf(PANDA, bodies="capsule")
    assert made == []
    monkeypatch.setenv("QPAVOID_CACHE", "0")
    without = Robot.from_urdf(PANDA, bodies="capsule")
    for robot in (first, again):
        for a, b in zip(robot.bodies.geometryObjects, without.bodies.geometryObjects, strict=True):
            np.testing.assert_array_equal(a.placement.homogeneous, b.placement.homogeneous)
            assert a.geometry.radius == b.geometry.radius
            assert getattr(a.geometry, "halfLength", 0.0) == getattr(b.geometry, "halfLength", 0.0)


def test_hulls_have_the_same_distances_bit_for_bit(folder, made, monkeypatch):
    monkeypatch.setenv("QPAVOID_CACHE", "0")
    robots = [Robot.from_urdf(PANDA, bodies="convex")]
    monkeypatch.setenv("QPAVOID_CACHE", str(folder))
    robots += [Robot.from_urdf(PANDA, bodies="convex") for _ in range(2)]
    meshes = sum(isinstance(b.geometry, coal.Convex) for b in robots[0].bodies.geometryObjects)
    assert made.count("run_qhull") == 2 * meshes
    random = np.random.default_rng(0)
    data = [(robot.model.createData(), robot.bodies.createData()) for robot in robots]
    for _ in range(50):
        q, found = random_q(robots[0], random), []
        for robot, (of_model, of_bodies) in zip(robots, data, strict=True):
            pin.updateGeometryPlacements(robot.model, of_model, robot.bodies, of_bodies, q)
            pin.computeDistances(robot.bodies, of_bodies)
            results = of_bodies.distanceResults
            found.append([[r.min_distance, *r.getNearestPoint1(), *r.getNearestPoint2(), *r.normal] for r in results])
        np.testing.assert_array_equal(found[1], found[0])
        np.testing.assert_array_equal(found[2], found[0])


def test_other_points_are_another_entry(folder):
    moved = CUBE.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], 0.0)
    for points in (CUBE, moved, CUBE[:7]):
        np.testing.assert_array_equal(
            numbers(enclosing_capsule(make_mesh(points))), numbers(enclosing_capsule(make_mesh(points)))
        )
    assert len(files(folder)) == 6


def test_version_goes_with_the_results():
    """If a change of the fit lets this fail, raise VERSION in cache.py, else old fits stay in use; then adapt this."""
    fit = fit_capsule(np.random.default_rng(5).normal(size=(50, 3)) * (0.3, 0.1, 0.05))
    assert VERSION == 2
    assert (fit.radius, fit.length) == pytest.approx((0.2044491, 0.8608654), abs=1e-6)


# --- whatever happens to the files ----------------------------------------------------------------------------


@pytest.mark.parametrize("content", [b"", b"short", b"x" * 500, None])
def test_damaged_entries_are_made_again(folder, made, content):
    fit = enclosing_capsule(make_mesh())
    for path in files(folder):
        whole = path.read_bytes()
        path.write_bytes(whole[:20] + bytes([whole[20] ^ 1]) + whole[21:] if content is None else content)
    np.testing.assert_array_equal(numbers(enclosing_capsule(make_mesh())), numbers(fit))
    assert made == 2 * ["run_qhull", "fit_capsule"]
    enclosing_capsule(make_mesh())
    assert len(made) == 4


def test_an_entry_that_coal_cannot_read_is_made_again(folder, made, monkeypatch):
    """Whole, but of another archive version."""
    monkeypatch.setattr(bodies, "_pack_hull", lambda hull: b"no archive")
    for _ in range(2):
        assert enclosing_capsule(make_mesh()).radius > 1.0
    assert made == ["run_qhull", "fit_capsule", "run_qhull"]


def test_a_directory_that_cannot_be_made_is_no_error(tmp_path, monkeypatch, made):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("QPAVOID_CACHE", str(tmp_path / "file" / "below"))
    assert enclosing_capsule(make_mesh()).radius > 1.0
    assert made == ["run_qhull", "fit_capsule"]


@pytest.mark.parametrize("call", ["mkstemp", "replace", "scandir", "utime"])
def test_a_disk_that_is_full_or_read_only_is_no_error(folder, monkeypatch, call):
    def fails(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache.tempfile if call == "mkstemp" else os, call, fails)
    fits = [enclosing_capsule(make_mesh()) for _ in range(2)]
    np.testing.assert_array_equal(numbers(fits[0]), numbers(fits[1]))
    monkeypatch.undo()
    assert not [path for path in files(folder) if path.suffix == ".tmp"]


def test_it_does_not_grow_without_end_and_the_last_used_stay(folder, monkeypatch):
    clouds, entries = [CUBE * scale for scale in np.linspace(1.0, 2.0, 8)], []
    for age, points in enumerate(clouds):
        enclosing_capsule(make_mesh(points))
        entries.append(set(files(folder)) - {path for entry in entries for path in entry})
        for path in entries[-1]:
            os.utime(path, (1000 + age, 1000 + age))
    enclosing_capsule(make_mesh(clouds[0]))  # used now, so no longer the oldest
    monkeypatch.setattr(cache, "_LARGEST", sum(path.stat().st_size for path in files(folder)))
    stranger = folder / "notes.txt"
    stranger.write_text("none of the cache's")
    os.utime(stranger, (1, 1))
    enclosing_capsule(make_mesh(3.0 * CUBE))
    left = set(files(folder))
    assert {stranger} | entries[0] | entries[-1] < left
    assert not left & (entries[1] | entries[2])
    assert sum(path.stat().st_size for path in left) < cache._LARGEST


def test_processes_at_once(folder):
    """Two that start with an empty cache all get the same, and leave whole files only."""
    script = (
        "import sys; from qpavoid import Robot\n"
        "bodies = Robot.from_urdf(sys.argv[1], bodies='capsule').bodies.geometryObjects\n"
        "print([(b.geometry.radius, *b.placement.translation) for b in bodies])"
    )
    command = [sys.executable, "-c", script, str(PANDA)]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    printed = [process.communicate(timeout=300)[0] for process in running]
    assert all(process.returncode == 0 for process in running)
    assert len(set(printed)) == 1 and len(printed[0]) > 100
    assert {path.suffix for path in files(folder)} == {".bin"}


# --- where it is ----------------------------------------------------------------------------------------------


def test_it_can_be_switched_off(tmp_path, monkeypatch):
    monkeypatch.setenv("QPAVOID_CACHE", "0")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() is None
    enclosing_capsule(make_mesh())
    assert files(tmp_path) == []


@pytest.mark.parametrize(
    ("platform", "variables", "where"),
    [
        ("linux", {}, "{home}/.cache/qpavoid"),
        ("linux", {"XDG_CACHE_HOME": "{home}/x"}, "{home}/x/qpavoid"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, "{home}/.cache/qpavoid"),
        ("linux", {"XDG_CACHE_HOME": "{home}/x", "QPAVOID_CACHE": "{home}/own"}, "{home}/own"),
        ("darwin", {}, "{home}/Library/Caches/qpavoid"),
        ("win32", {"LOCALAPPDATA": "{home}/local"}, "{home}/local/qpavoid/Cache"),
        ("win32", {}, "{home}/AppData/Local/qpavoid/Cache"),
    ],
)
def test_where_it_is(tmp_path, monkeypatch, platform, variables, where):
    for name in ("QPAVOID_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value.format(home=tmp_path))
    monkeypatch.setattr(cache.sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_folder() == Path(where.format(home=tmp_path))


def test_nowhere_without_a_home(monkeypatch):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    for name in ("QPAVOID_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    assert cache_folder() is None
