"""Files from anybody: each is read or refused in one line, whatever is in it; nothing hangs or is half read."""

import json
import os
import re
import signal
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import write_chain
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from urdfs import TETRAHEDRON, arm

from qpavoid import ConfigError, Controller, Log, Robot, Sample, load_scenario
from qpavoid.config import Csv, RobotConfig
from qpavoid.config.loading import read_config
from qpavoid.config.shipped import data_folder
from qpavoid.model.trajectory import build_motion
from qpavoid.run.simulate import simulate

if not hasattr(signal, "SIGALRM"):
    pytest.skip("a hang can only be stopped with SIGALRM", allow_module_level=True)

pytestmark = pytest.mark.filterwarnings("ignore::qpavoid.model.notes.RobotWarning")
LIMIT = 300
"""Seconds after which a test counts as hanging, however busy the machine is."""


@pytest.fixture(autouse=True)
def in_time():
    def stop(*_):
        pytest.fail(f"not done after {LIMIT} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LIMIT)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def read_srdf(path: Path) -> Robot:
    write_chain(path.parent)
    robot = path.with_name("of_srdf.yaml")
    robot.write_text(f"name: chain\nurdf: chain.urdf\nsrdf: {path.name}\n")
    return Robot.load(str(robot))


READERS = {
    "scene.yaml": load_scenario,
    "robot.yaml": lambda path: read_config(path, RobotConfig),
    "arm.urdf": Robot.from_urdf,
    "arm.srdf": read_srdf,
    "path.csv": lambda path: build_motion(Csv(path=path.name), Sample.at([0.0, 0.0, 0.0]), path.parent),
    "run.npz": Log.load,
}
YAML, XML = ("scene.yaml", "robot.yaml"), ("arm.urdf", "arm.srdf")


def refusal(name: str, folder: Path) -> str:
    """Why a file is refused, or nothing: then what it holds must make sense."""
    try:
        found = READERS[name](folder / name)
    except ConfigError as error:
        message = str(error)
        assert message.isprintable() and len(message) < 2100
        assert str(folder / name) in message or "of_srdf.yaml" in message
        return message
    if isinstance(found, Robot):
        data = found.model.createData()
        assert np.isfinite(pin.computeJointJacobians(found.model, data, found.home)).all()
        assert np.all(found.bounds().lower < found.bounds().upper)
    if name == "path.csv":
        assert all(np.isfinite(found.sample(t).row).all() for t in (-1.0, 0.05, 0.5, 9.0))
    return ""


INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
TAIL = (
    '<link name="c"/><joint name="j3" type="continuous"><parent link="b"/><child link="c"/><mimic joint="j1"/></joint>'
)
SRDF = """<robot name="chain"><disable_collisions link1="link0" link2="link2" reason="Never"/>
<group_state name="home" group="all"><joint name="joint1" value="1"/></group_state></robot>"""
CSV = "t,x,y,z,qx,qy,qz,qw\n0,0,0,0.5,0,0,0,1\n0.5,0.1,0,0.5,0,0,0.6,0.8\n1,0.1,0.2,0.5,0,0,0,1\n"
ORIGINALS = {
    "scene.yaml": (data_folder("tasks") / "panda_line.yaml").read_bytes(),
    "robot.yaml": (data_folder("robots") / "panda" / "robot.yaml").read_bytes(),
    "arm.urdf": arm(joint_tags=INERTIAL, inside=TAIL).encode(),
    "arm.srdf": SRDF.encode(),
    "path.csv": CSV.encode(),
}
COUNTS = {"scene.yaml": 100, "robot.yaml": 100, "arm.urdf": 300, "arm.srdf": 80, "path.csv": 200}
PIECES = [
    *(b"nan .nan inf -.inf 1e308 -1e308 1e999 1e-320 -1 0 0x10 1_000".split()),
    *(b"\x00 \xff\xfe \xef\xbb\xbf < > & &amp; &#0; \" ' <!-- ]]> <!DOCTYPE />".split()),
    *(b'{ } [ ] : - &a *a <<: | ? ~ !!int "\\ud800" !!binary ../ /dev/zero fixed planar'.split()),
    *(b"", b"\n", b"\t", b"A" * 3000, b"[" * 400, b"<a>" * 400),
]


def numbers_changed(draw, content: bytes) -> bytes:
    spans = [match.span() for match in re.finditer(rb"-?\d+(\.\d+)?", content)] or [(0, 0)]
    begin, end = draw(st.sampled_from(spans))
    return content[:begin] + draw(st.sampled_from(PIECES)) + content[end:]


def bytes_changed(draw, content: bytes) -> bytes:
    begin = draw(st.integers(0, len(content)))
    end = min(len(content), begin + draw(st.sampled_from([0, 1, 5, 40])))
    return content[:begin] + draw(st.sampled_from(PIECES) | st.binary(max_size=3)) + content[end:]


def parts_repeated(draw, content: bytes) -> bytes:
    parts = re.split(rb"(?<=[>\n])", content)
    i = draw(st.integers(0, len(parts) - 1))
    return b"".join(parts[:i] + draw(st.sampled_from([0, 2])) * parts[i : i + 1] + parts[i + 1 :])


@pytest.mark.parametrize("mutate", [numbers_changed, bytes_changed, parts_repeated])
@pytest.mark.parametrize("name", ORIGINALS)
def test_mutated_file_is_read_or_refused(name, mutate, tmp_path):
    @settings(derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck),
              max_examples=COUNTS[name] // 3)  # fmt: skip
    @given(st.data())
    def check(data):
        content = ORIGINALS[name]
        for _ in range(data.draw(st.integers(1, 3))):
            content = mutate(data.draw, content)
        (tmp_path / name).write_bytes(content)
        refusal(name, tmp_path)

    (tmp_path / name).write_bytes(ORIGINALS[name])
    assert refusal(name, tmp_path) == ""
    check()


def laughs(depth: int = 8) -> str:
    """Ten lines of aliases that stand for a billion values."""
    lines = [f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 10)}]" for i in range(1, depth + 1)]
    return "\n".join(["x0: &x0 [0]", *lines])


@pytest.mark.parametrize(
    ("names", "content", "expected"),
    [
        (YAML, "", "must be a mapping of fields, got NoneType"),
        (YAML, "- 1\n- 2\n", "must be a mapping of fields, got list"),
        (YAML, "tasks: [", "not valid YAML"),
        (YAML, laughs(), "more than 50000 values, aliases written out"),
        (YAML, re.sub(r"(\[\*.*\])", r"{<<: \1}", laughs().replace("[0]", "{a: 0}")), "more than 50000 values"),
        (YAML, "a: &a [*a]", "more than 50000 values"),
        (YAML, "a: " + "[" * 100_000, "nested too deep"),
        (YAML, "a: " + "x" * 2_000_000, "2000003 bytes; at most 1000000 are read"),
        (YAML, "".join(f"k{i}: 1\n" for i in range(2_000)), r"k0: unknown key.*; and \d+ more$"),
        (YAML, "a: 0x" + "f" * 100_000, "a number of 100002 characters"),
        (YAML, "a: !!timestamp x", "does not fit its !!tag"),
        (YAML, "a: !!python/object:os.system x", "not valid YAML"),
        (YAML, 'a: "\\ud800"', "half a character pair"),
        (YAML, "a: 1\na: 2", "key 'a' is given twice.*line 2"),
        (YAML, "robot: panda\n1: 2\n", "1: Keys should be strings"),
        (XML, '<!DOCTYPE r [<!ENTITY b "b">]><robot name="&b;"/>', "."),
        (XML, "<robot name='x'>" + "<a>" * 10_000 + "</a>" * 10_000 + "</robot>", "."),
        (XML, "<robot><!--" + "x" * 11_000_000 + "--></robot>", "at most 10000000 are read"),
        (("path.csv",), "t,x,y,z\n0,0,0,0\n1,0,0\n", "columns changed from 4 to 3 at row 2"),
        (("path.csv",), "t,x,y,z\n0,0,0,0\ninf,1,0,0\n", "row 2 of poses: not finite numbers"),
        (("path.csv",), "t,x,y,z\n0,0,0,0\n1e-320,1,0,0\n", r"faster than 1e\+09 m/s; give it time"),
        (
            ("path.csv",),
            "t,x,y,z\n" + "".join(f"{i},0,0,0\n" for i in range(1_000_000)),
            "1000000 rows of poses; give",
        ),
        ((*YAML, *XML, "path.csv"), bytes(range(256)), "cannot be read: .*give a UTF-8 text file"),
        ((*YAML, *XML, "path.csv"), "a\0b", "holds NUL characters; give a text file"),
        (("run.npz",), bytes(range(256)), "not a qpavoid log: .*; give one written by `qpavoid run`"),
        (("run.npz",), b"", "not a qpavoid log"),
    ],
)
def test_file_is_refused(names, content, expected, tmp_path):
    for name in names:
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        assert re.search(expected, refusal(name, tmp_path))


@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo], ids=["folder", "pipe"])
def test_what_is_no_ordinary_file_is_refused(make, tmp_path):
    for name in READERS:
        make(tmp_path / name)
        assert re.search("folder|no such file|ordinary", refusal(name, tmp_path))
    for name in ("a/" * 3000, "a\0/b", "\ud800/b"):
        for call in (load_scenario, Robot.load, Log.load):
            with pytest.raises(ConfigError, match="no such file") as error:
                call(name)
            assert str(error.value).isprintable()


def test_aliases_and_marks_that_do_no_harm_are_read(tmp_path):
    text = "\ufeff" + ORIGINALS["scene.yaml"].decode().replace("[panda, ", "[&p panda, *p, ")
    (tmp_path / "scene.yaml").write_text(text)
    assert load_scenario(tmp_path / "scene.yaml").tags[:2] == ["panda", "panda"]
    (tmp_path / "path.csv").write_text("\ufeff" + CSV, encoding="utf-8")
    assert refusal("path.csv", tmp_path) == ""


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("tags=" + "[" * 5000, "is not a YAML value"),
        ("tasks." + "9" * 5000 + ".gain=1", "is not an index below 1"),
        ("duration=1e8", r"duration / dt is 1e\+10 control steps; at most 1000000"),
        ("obstacles.0.motion.position=[1e308, 0, 0]", "less than or equal to 1000000000"),
        ("obstacles.0.motion={type: circle, center: [0, 0, 0], radius: 1, period: 1.0e-320}", r"faster than 1e\+09"),
        ("obstacles.0.motion={type: csv, path: /dev/zero}", "cannot be read"),
    ],
)
def test_absurd_scenario_is_refused(override, expected):
    with pytest.raises(ConfigError, match=expected) as error:
        Controller.from_scenario(load_scenario("panda_line", [override]))
    assert str(error.value).isprintable()


def test_log_of_another_version_or_that_would_run_code_is_refused(tmp_path):
    path = simulate(load_scenario("situation1", ["duration=0.05"])).save(tmp_path / "whole")
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    meta = json.loads(str(arrays["meta"]))
    for changes, expected in (
        ({"slack": np.array([None])}, "allow_pickle=False"),
        ({"meta": np.array("[" * 100_000)}, "recursion"),
        ({"meta": np.array(json.dumps({**meta, "format": [1]}))}, "written by another version"),
        ({"q": arrays["q"][:-1]}, r"q has shape .* must be \(N nq\)"),
    ):
        np.savez(tmp_path / "run.npz", **{**arrays, **changes})
        assert re.search(expected, refusal("run.npz", tmp_path))


def stl(*triangles, count=None) -> bytes:
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *np.ravel(corners), 0) for corners in triangles)
    return bytes(80) + struct.pack("<I", len(triangles) if count is None else count) + body


NOT_A_NUMBER, READER = "a corner is NaN, infinite or beyond 1e.09 m", "; export it again"
MESHES = {
    "good.stl": (stl(*TETRAHEDRON), None),
    "one.stl": (stl(TETRAHEDRON[0]), None),
    "line.stl": (stl([[0, 0, 0], [0, 0, 1], [0, 0, 2]]), None),
    "quads.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3 4\n", None),
    "point.stl": (stl(*[np.ones((3, 3))] * 4), READER),
    "nan.stl": (stl(np.diag([np.nan, 1, 1]), *TETRAHEDRON), NOT_A_NUMBER),
    "huge.stl": (stl(np.diag([3e38, 3e38, 3e38]), *TETRAHEDRON), NOT_A_NUMBER),
    "all_nan.stl": (stl(np.full((3, 3), np.nan)), "has no triangle|a corner is NaN"),
    "empty.stl": (b"", READER),
    "garbage.stl": (bytes(range(256)) * 20, READER),
    "count.stl": (stl(*TETRAHEDRON, count=2**32 - 1), READER),
    "cut.stl": (stl(*TETRAHEDRON)[:-30], READER),
    "index.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999\n", READER),
    "deep.dae": (b"<COLLADA>" + b"<node>" * 20_000, READER),
    "x.unknown": (b"zz", READER),
}
IN_A_CHILD = """
import json, sys, warnings
from pathlib import Path
from qpavoid import ConfigError, Robot
warnings.simplefilter("ignore")
answers = {}
for path in sorted(Path(sys.argv[1]).glob("*.urdf")):
    for kind in ("convex", "capsule", "mesh"):
        try:
            Robot.from_urdf(path, bodies=kind)
        except ConfigError as error:
            answers[f"{path.stem} {kind}"] = str(error)
print(json.dumps(answers))
"""


def test_mesh_is_read_or_refused(tmp_path):
    """In a process of its own, which a reader in C++ would take down."""
    for name, (content, _) in MESHES.items():
        (tmp_path / name).write_bytes(content)
        write_chain(tmp_path, shape=f'<mesh filename="{name}"/>').rename(tmp_path / f"{name}.urdf")
    command = [sys.executable, "-c", IN_A_CHILD, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout)
    for name, (_, expected) in MESHES.items():
        for answer in [answers.get(f"{name} {kind}") for kind in ("convex", "capsule", "mesh")]:
            assert (answer is None) == (expected is None), (name, answer)
            assert answer is None or (re.search(expected, answer) and name in answer and "\n" not in answer)
