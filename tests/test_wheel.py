"""What users install: the wheel and the sdist hold what they should, and work away from the checkout.

Needs a package index for the build back end and the dependencies; takes about a minute.
"""

import json
import os
import subprocess
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from qpavoid.config.shipped import shipped_names

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parent.parent
BENCH = """
import qpavoid.cli, sys
sys.argv, sys.stderr = ["qpavoid", "bench", "list"], sys.stdout
try:
    qpavoid.cli.main()
except SystemExit as end:
    assert end.code == 2
"""


def call(*command: object, cwd: Path) -> str:
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=cwd, env=clean, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def python(tmp_path_factory) -> Path:
    """Interpreter of a fresh environment in which there is nothing but the build back end."""
    folder = tmp_path_factory.mktemp("venv")
    venv.create(folder, with_pip=True)
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    call(python, "-m", "pip", "install", "--quiet", "hatchling", cwd=folder)
    return python


@pytest.fixture(scope="module")
def built(python, tmp_path_factory) -> tuple[Path, Path]:
    """Wheel and sdist of this checkout."""
    folder = tmp_path_factory.mktemp("dist")
    call(python, "-m", "hatchling", "build", "--directory", folder, cwd=ROOT)
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


def in_wheel(path: Path) -> set[str]:
    with zipfile.ZipFile(path) as archive:
        return {name for name in archive.namelist() if not name.endswith("/")}


def modules(bench: Path) -> set[str]:
    """Return the modules of both packages, with `bench` in the place of the checkout's folder."""
    core = {path.relative_to(ROOT) for path in (ROOT / "qpavoid").rglob("*.py")}
    benches = {bench / path.relative_to(ROOT / "bench") for path in (ROOT / "bench/qpavoid_bench").rglob("*.py")}
    return {path.as_posix() for path in core | benches}


def test_wheel_holds_the_package_its_robots_and_scenarios(built):
    names = in_wheel(built[0])
    package = {name for name in names if ".dist-info/" not in name}
    assert {name for name in package if name.endswith(".py") and "_data/" not in name} == modules(Path())
    assert "qpavoid/py.typed" in package
    assert {f"qpavoid/_data/robots/{name}/robot.yaml" for name in shipped_names("robot")} <= package
    assert {f"qpavoid/_data/tasks/{name}.yaml" for name in shipped_names("scenario")} <= package
    assert {f"qpavoid/_data/tasks/families/{name}.yaml" for name in shipped_names("family")} <= package
    assert {f"qpavoid/_data/tasks/families/setups/{name}.yaml" for name in shipped_names("setup")} <= package
    assert "qpavoid/_data/robots/paper-dual-arm/paper_dual_arm.urdf" in package
    assert {name.split("/")[0] for name in package} == {"qpavoid", "qpavoid_bench"}
    assert not any("__pycache__" in name or name.endswith((".npz", ".png")) for name in names)
    assert {"LICENSE", "NOTICE.md"} <= {name.partition(".dist-info/licenses/")[2] for name in names}


def test_sdist_builds_the_same_wheel(built, python, tmp_path):
    wheel, sdist = built
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert modules(Path("bench")) | {"pyproject.toml", "README.md", "LICENSE", "robots/panda/robot.yaml"} <= names
    assert {f"tests/{path.name}" for path in (ROOT / "tests").glob("test_*.py")} <= names
    assert {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")} <= names  # which tests read
    assert {"mkdocs.yml", "Makefile", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "NOTICE.md"} <= names
    assert not any(name.startswith((".git/", ".ci", "out/")) for name in names)
    assert {name.split("/")[1] for name in names if name.startswith("bench/")} == {"qpavoid_bench", "results"}
    options = ("--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir")
    call(python, "-m", "pip", "wheel", *options, tmp_path, sdist, cwd=tmp_path)
    assert in_wheel(tmp_path / wheel.name) == in_wheel(wheel)


def test_installed_wheel_runs_away_from_the_checkout(built, python, tmp_path):
    call(python, "-m", "pip", "install", "--quiet", built[0], cwd=tmp_path)
    where = call(python, "-c", "import qpavoid; print(qpavoid.__file__)", cwd=tmp_path)
    assert ROOT not in Path(where.strip()).parents
    command = python.with_name("qpavoid.exe" if os.name == "nt" else "qpavoid")
    assert call(command, "list", "scenarios", cwd=tmp_path).split() == shipped_names("scenario")
    assert "qpavoid[arena]" in call(python, "-c", BENCH, cwd=tmp_path)  # the package is there, its dependencies are not
    arguments = ("--solver", "qp", "--set", "duration=0.5", "--no-figures", "--json")
    for scenario in ("situation1", "panda_line"):  # a robot that ships, and one from example-robot-data
        document = json.loads(call(command, "run", scenario, *arguments, cwd=tmp_path))
        assert document["scenario"] == scenario
        assert document["completed"] is True
        assert document["collided"] is False
        assert (tmp_path / document["files"][0]).is_file()


def test_installed_wheel_runs_with_the_lowest_versions_it_allows(built, tmp_path):
    """Direct dependencies at their lower bounds of `pyproject.toml`, as uv resolves them; it ships as a wheel."""
    venv.create(tmp_path / "lowest", with_pip=True)
    python = tmp_path / ("lowest/Scripts/python.exe" if os.name == "nt" else "lowest/bin/python")
    call(python, "-m", "pip", "install", "--quiet", "uv", cwd=tmp_path)
    install = (python, "-m", "uv", "pip", "install", "--quiet", "--python", python)
    call(*install, "--resolution", "lowest-direct", "-r", ROOT / "pyproject.toml", cwd=tmp_path)
    call(*install, "--no-deps", built[0], cwd=tmp_path)
    versions = call(python, "-m", "pip", "freeze", cwd=tmp_path)
    assert "numpy==2.2.0" in versions.splitlines()
    command = python.with_name("qpavoid.exe" if os.name == "nt" else "qpavoid")
    arguments = ("panda_line", "--set", "duration=0.5", "--no-figures", "--json")
    document = json.loads(call(command, "run", *arguments, cwd=tmp_path))
    assert document["completed"] is True
    assert document["collided"] is False
