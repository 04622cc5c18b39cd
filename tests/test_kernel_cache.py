"""Compiled kernels on disk: never stale, never in the way of an installation, of other processes or of other people."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from numba import njit

import qpavoid
from qpavoid.kernels.cache import FOLDER

PACKAGE = Path(qpavoid.__file__).parent
KERNELS = {
    "double.py": """
        from qpavoid.kernels.packing import compiled

        @compiled
        def double(x):
            return 2 * x
        """,
    "total.py": """
        from qpavoid.kernels.double import double
        from qpavoid.kernels.packing import compiled

        @compiled
        def total(a):
            result = 0
            for x in a:
                result += double(x)
            return result
        """,
    "large.py": """
        from qpavoid.kernels.packing import compiled

        @compiled
        def large(x):
            y = x
            {}
            return y
        """.format("\n            ".join(f"y = {i}.0 + x / (y * y + 1.0)" for i in range(100))),
    "callers.py": """
        from qpavoid.kernels.large import large
        from qpavoid.kernels.packing import compiled

        @compiled
        def small(x):
            return large(x) - x

        @compiled
        def caller(x):
            return small(x) + x

        @compiled
        def other_caller(x):
            return small(x) + 2.0 * x
        """,
}
"""Kernels that are quickly compiled, of which some call others in other files."""
SCRIPT = """
import numpy as np
from qpavoid.kernels.cache import first_use
from qpavoid.kernels.total import total

print(total(np.arange(5)))
print(sum(total.stats.cache_hits.values()))
first_use.end()
"""
"""Prints what a kernel returns, and whether its code was on disk."""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A copy of the package with these kernels, which can be imported without the rest."""
    site = tmp_path_factory.mktemp("site")
    shutil.copytree(PACKAGE, site / "qpavoid", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in (site / "qpavoid", site / "qpavoid" / "kernels"):
        (folder / "__init__.py").write_text("")
    for name, text in KERNELS.items():
        (site / "qpavoid" / "kernels" / name).write_text(dedent(text))
    return site


@pytest.fixture(scope="module")
def used(site, tmp_path_factory):
    """A folder for compiled kernels after the first process, and the lines that this one printed on stderr."""
    cache, before = tmp_path_factory.mktemp("cache"), sorted(site.rglob("*"))
    values, lines = run(site, cache)
    assert values == [20, 0]
    assert sorted(site.rglob("*")) == before, "written beside the sources"
    return cache, lines


def start(site, cache, script=SCRIPT):
    """A process with a package of its own, and a folder for compiled kernels."""
    environment = {**os.environ, "PYTHONPATH": str(site), "NUMBA_CACHE_DIR": str(cache), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", script], env=environment, cwd=site, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def run(site, cache, script=SCRIPT):
    """Numbers that the script prints, and lines on stderr."""
    process = start(site, cache, script)
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    return [float(line) for line in out.split()], err.splitlines()


def test_cache_announces_the_first_compilation_and_no_other(site, used):
    cache, first = used
    assert len(first) == 2
    assert first[0].startswith("qpavoid: compiling kernels, once on this machine: about ")
    assert first[1].startswith("qpavoid: compiled kernels in ")
    assert run(site, cache) == ([20, 1], [])
    other_types = SCRIPT.replace("np.arange(5)", "np.arange(5.0)")
    assert run(site, cache, other_types) == ([20, 0], [])


def test_cache_compiles_anew_where_a_callee_in_another_file_changed(site, used):
    """Even if the time stamps of its file do not show that it has changed, and back again."""
    callee = site / "qpavoid" / "kernels" / "double.py"
    original, stamp = callee.read_text(), callee.stat()
    for text, expected in ((original.replace("2 * x", "3 * x"), [30, 0]), (original, [20, 1])):
        callee.write_text(text)
        os.utime(callee, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        assert run(site, used[0])[0] == expected


def test_cache_is_complete_once_a_controller_is_built():
    """All that its construction compiles is on disk, in the user's cache or where NUMBA_CACHE_DIR says."""
    assert (FOLDER / "complete").exists() and any(FOLDER.glob("step.control_step-*.code"))


CALL = """
from qpavoid.kernels.callers import {0}
from qpavoid.kernels.large import large

print({0}(3.0) - large.py_func(3.0))
print(sum({0}.stats.cache_hits.values()))
"""


def test_a_large_kernel_is_called_and_not_contained(site, tmp_path):
    """So that it is compiled once; in a process that loads its caller it is loaded, too, or compiled."""
    for hits in (0, 1):
        difference, found = run(site, tmp_path, CALL.format("caller"))[0]
        assert abs(difference) < 1e-9 and found == hits
    (large,), (caller,) = tmp_path.glob("*/large.large-*"), tmp_path.glob("*/callers.caller-*")
    assert caller.stat().st_size < 0.7 * large.stat().st_size
    large.unlink()
    difference, found = run(site, tmp_path, CALL.format("caller"))[0]
    assert abs(difference) < 1e-9 and found == 1 and large.exists()


def test_callers_know_a_large_kernel_that_another_process_compiled_after_them(site, tmp_path):
    """Its name has another number there; so do new callers of a small kernel from disk, and later processes."""
    run(site, tmp_path, CALL.format("caller"))
    (large,) = tmp_path.glob("*/large.large-*")
    before = large.read_bytes()
    large.unlink()
    others = "from numba import njit\nfor k in range(5):\n    njit(lambda x: x + k)(1)\n"
    run(site, tmp_path, SCRIPT + others + "from qpavoid.kernels.large import large\nlarge(3.0)")
    assert large.read_bytes() != before
    for name, hits in (("caller", 1), ("other_caller", 0), ("other_caller", 1)):
        difference, found = run(site, tmp_path, CALL.format(name))[0]
        assert abs(difference - 3.0 * (name == "other_caller")) < 1e-9 and found == hits


def test_cache_that_is_unwritable_is_named_and_optional(site, tmp_path):
    nowhere = tmp_path / "file"
    nowhere.touch()
    values, lines = run(site, nowhere)
    assert values == [20, 0]
    assert len(lines) == 3 and "cannot keep compiled kernels" in lines[1] and "NUMBA_CACHE_DIR" in lines[1]


def test_cache_does_not_run_damaged_code(site, used, tmp_path):
    cache = tmp_path / "cache"
    shutil.copytree(used[0], cache)
    for path in cache.glob("kernels-*/total.total-*.code"):
        content = path.read_bytes()
        path.write_bytes(content[:5000] + bytes(255 - byte for byte in content[5000:5008]) + content[5008:])
    assert [run(site, cache)[0] for _ in range(2)] == [[20, 0], [20, 1]]


def test_cache_does_not_mix_the_code_of_concurrent_processes(site, tmp_path):
    """Each compiles the same function for other types first; afterwards the code of all of them is there."""
    script = """
import numpy as np
from qpavoid.kernels.total import total
calls = [np.arange(5), np.arange(5.0), np.arange(5.0).repeat(2)[::2], np.arange(5).repeat(2)[::2]]
for i in range(4):
    assert total(calls[(i + {number}) % 4]) == 20
print(sum(total.stats.cache_hits.values()))
"""
    together = [start(site, tmp_path, script.format(number=number)) for number in range(3)]
    for process in together:
        _, err = process.communicate(timeout=600)
        assert process.returncode == 0, err
    assert run(site, tmp_path, script.format(number=0))[0] == [4]


def test_cache_deletes_old_folders_alone(site, tmp_path):
    for age in range(10):
        folder = tmp_path / f"kernels-{age}"
        folder.mkdir()
        (folder / "complete").touch()
        os.utime(folder / "complete", (1e9 - age, 1e9 - age))
    for other in ("kernels", "kernels-of-somebody-else", "hulls"):
        (tmp_path / other).mkdir()
    run(site, tmp_path)
    left = {path.name for path in tmp_path.iterdir()} - {"kernels", "kernels-of-somebody-else", "hulls"}
    assert len(left) == 8 and {f"kernels-{age}" for age in range(7)} < left


def test_cache_leaves_functions_of_other_packages_to_numba(tmp_path, monkeypatch):
    (tmp_path / "theirs.py").write_text("def double(x):\n    return 2 * x\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    import theirs

    double = njit(cache=True)(theirs.double)
    assert double(np.float64(2.0)) == 4.0
    assert not Path(double.stats.cache_path).is_relative_to(FOLDER)
    assert any(Path(double.stats.cache_path).glob("theirs.double-*.nbi"))
