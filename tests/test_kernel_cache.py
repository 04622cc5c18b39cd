"""Compiled kernels on disk: never stale, never in the way of an installation, of other processes or of other people."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit

import qpavoid
from qpavoid.kernels.cache import FOLDER

PACKAGE = Path(qpavoid.__file__).parent
TURN = """
import numpy as np
from qpavoid import kernels

last = np.zeros((1, 18))
last[0, :9] = np.eye(3).ravel()
new = last.copy()
new[0, :9] = np.array([[np.cos(0.1), -np.sin(0.1), 0.0], [np.sin(0.1), np.cos(0.1), 0.0], [0.0, 0.0, 1.0]]).T.ravel()
numbers, kind, times = np.zeros(1, dtype=np.intp), np.ones(1, dtype=np.intp), np.array([0.5])
kernels.update_measured_states(numbers, kind, times, new, np.zeros(1), last, np.zeros((1, 18)), 1e-9, 1e3)
print(new[0, 17])
print(sum(kernels.update_measured_states.stats.cache_hits.values()))
kernels.first_use.end()
"""
"""Prints the speed of a turn, which `rotation_vector` of another file finds, and whether the code was on disk."""
ALONE = """
import numpy as np
from qpavoid import kernels

print(kernels.sorted_setxor({a}, np.arange(3, 8)).sum())
print(sum(kernels.sorted_setxor.stats.cache_hits.values()))
kernels.first_use.end()
"""
SHORT = ALONE.format(a="np.arange(5)")
"""The same of a function that is quickly compiled: the sum of what is in one of two arrays alone."""


@pytest.fixture
def installed(tmp_path):
    """A copy of the package, whose kernels can be imported without the rest."""
    shutil.copytree(PACKAGE, tmp_path / "site" / "qpavoid", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "site" / "qpavoid" / "__init__.py").write_text("")
    return tmp_path / "site"


def start(site, cache, script=SHORT):
    """A process with a package of its own, and a folder for compiled kernels."""
    environment = {**os.environ, "PYTHONPATH": str(site), "NUMBA_CACHE_DIR": str(cache), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", script], env=environment, cwd=site, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def run(site, cache, script=SHORT):
    """Numbers that the script prints, and lines on stderr."""
    process = start(site, cache, script)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return [float(line) for line in out.split()], err.splitlines()


def test_a_changed_callee_in_another_file_is_compiled_anew(installed, tmp_path):
    """Even if the time stamps of its file do not show that it has changed, and back again."""
    rotation = installed / "qpavoid" / "kernels" / "rotation.py"
    original, stamp = rotation.read_text(), rotation.stat()
    assert run(installed, tmp_path, TURN)[0] == pytest.approx([0.2, 0])
    assert run(installed, tmp_path, TURN)[0] == pytest.approx([0.2, 1])
    changed = original.replace("return scale * x, scale * y, scale * z", "return scale * x, scale * y, -scale * z")
    assert changed != original
    for text, expected in ((changed, [-0.2, 0]), (original, [0.2, 1])):
        rotation.write_text(text)
        os.utime(rotation, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        assert run(installed, tmp_path, TURN)[0] == pytest.approx(expected)


def test_nothing_is_written_beside_the_sources(installed, tmp_path):
    """An installation may be read-only: compiled kernels are kept all the same."""
    before = sorted(path for path in installed.rglob("*"))
    for path in before:
        path.chmod(path.stat().st_mode & ~0o222)
    try:
        assert [run(installed, tmp_path)[0][1] for _ in range(2)] == [0, 1]
    finally:
        for path in before:
            path.chmod(path.stat().st_mode | 0o200)
    assert sorted(path for path in installed.rglob("*")) == before


def test_the_first_compilation_is_announced_and_timed_and_no_other(installed, tmp_path):
    _, first = run(installed, tmp_path)
    assert len(first) == 2
    assert first[0].startswith("qpavoid: compiling kernels, once on this machine: about ")
    assert first[1].startswith("qpavoid: compiled kernels in ")
    assert run(installed, tmp_path)[1] == []
    other_types = ALONE.format(a="np.repeat(np.arange(5), 2)[::2]")  # later compilations are not the first
    assert run(installed, tmp_path, other_types) == ([21, 0], [])


def test_a_controller_ends_the_first_use():
    """All that its construction compiles is on disk, in the user's cache or where NUMBA_CACHE_DIR says."""
    assert (FOLDER / "complete").exists() and any(FOLDER.glob("step.assemble-*.code"))


def test_an_unwritable_cache_is_named_and_optional(installed, tmp_path):
    nowhere = tmp_path / "file"
    nowhere.touch()
    for _ in range(2):
        values, said = run(installed, nowhere)
        assert values == [21, 0]
        assert len(said) == 3 and "cannot keep compiled kernels" in said[1] and "NUMBA_CACHE_DIR" in said[1]


def test_damaged_code_is_not_run(installed, tmp_path):
    run(installed, tmp_path)
    (path,) = tmp_path.glob("kernels-*/broadphase.sorted_setxor-*.code")
    content = path.read_bytes()
    for damaged in (b"", content[: len(content) // 2], content[:5000] + b"\0" * 8 + content[5008:]):
        path.write_bytes(damaged)
        assert run(installed, tmp_path)[0] == [21, 0]
    assert run(installed, tmp_path)[0] == [21, 1]


def test_concurrent_processes_do_not_mix_their_code(installed, tmp_path):
    """Each compiles the same function for other types first; afterwards the code of all of them is there."""
    script = """
import numpy as np
from qpavoid.kernels import sorted_setxor as alone
a, b = np.arange(5), np.arange(3, 8)
calls = [(a, b), (a[::2], b), (a, b[::2]), (a[::2], b[::2])]
for i in range(4):
    one, two = calls[(i + {number}) % 4]
    assert alone(one, two).tolist() == sorted(set(one.tolist()) ^ set(two.tolist()))
print(sum(alone.stats.cache_hits.values()))
"""
    together = [start(installed, tmp_path, script.format(number=number)) for number in range(4)]
    for process in together:
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
    assert run(installed, tmp_path, script.format(number=0))[0] == [4]


def test_only_old_folders_are_deleted(installed, tmp_path):
    for age in range(10):
        folder = tmp_path / f"kernels-{age}"
        folder.mkdir()
        (folder / "complete").touch()
        os.utime(folder / "complete", (1e9 - age, 1e9 - age))
    for other in ("kernels", "kernels-of-somebody-else", "hulls"):
        (tmp_path / other).mkdir()
    run(installed, tmp_path)
    left = {path.name for path in tmp_path.iterdir()} - {"site", "kernels", "kernels-of-somebody-else", "hulls"}
    assert len(left) == 8 and {f"kernels-{age}" for age in range(7)} < left


def test_functions_of_other_packages_use_the_cache_of_numba(tmp_path, monkeypatch):
    (tmp_path / "theirs.py").write_text("def double(x):\n    return 2 * x\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    import theirs

    double = njit(cache=True)(theirs.double)
    assert double(np.float64(2.0)) == 4.0
    assert not Path(double.stats.cache_path).is_relative_to(FOLDER)
    assert any(Path(double.stats.cache_path).glob("theirs.double-*.nbi"))
