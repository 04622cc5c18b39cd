"""Running the arena: nothing is lost, nothing is counted twice, nothing is done again, whatever is killed meanwhile."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("pyarrow")
pytest.importorskip("distributed")
pytest.importorskip("mujoco")

import pyarrow as pa
import pyarrow.parquet as pq

from qpavoid.config.shipped import family_names, suite_names
from qpavoid.errors import ConfigError, UnknownName
from qpavoid_bench.arena import commands, store, sweep
from qpavoid_bench.arena.entrant_file import entrant_from_file
from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.families import load_family, make_case
from qpavoid_bench.arena.plan import cases_of, is_complete, missing_cases, missing_runs, runs_of
from qpavoid_bench.arena.scores import COLUMNS, KEY
from qpavoid_bench.arena.store import Store, read_cases, read_runs
from qpavoid_bench.arena.suite import EntrantConfig, load_suite, origin
from qpavoid_bench.arena.summary import find_faults, summary
from qpavoid_bench.arena.trial import run_trial
from qpavoid_bench.arena.world import build_world

POST = {
    "title": "A post",
    "about": "The tool of a UR5 goes past a post.",
    "robots": ["ur5"],
    "parameters": {"y": {"type": "uniform", "range": [-0.25, -0.15], "about": "of the post [m]"}},
    "scenario": {
        "tasks": [
            {
                "frame": "tool0",
                "motion": {"type": "line", "displacement": [0, -0.2, 0], "speed": 0.2, "profile": "smooth"},
            }
        ],
        "obstacles": [
            {
                "name": "post",
                "shape": {"type": "capsule", "radius": 0.02, "length": 0.5},
                "motion": {"type": "fixed", "position": [0.6, "$y", 0.25]},
            }
        ],
        "avoidance": {"d1": 0.02, "d2": 0.12},
        "dt": 0.02,
        "duration": 3.0,
    },
}
"""A family that is solved at once."""
LAWS = '''
"""Entrants of each kind."""
import os, time
from dataclasses import dataclass
import numpy as np
from qpavoid import Solution
from qpavoid.solvers.analytic import tracking_velocity

@dataclass
class Halved:
    """A class with solve."""
    share: float = 0.5
    def solve(self, problem):
        return Solution(self.share * tracking_velocity(problem))

def solution(problem):
    return Solution(tracking_velocity(problem))

def velocity(problem, scale=1.0):
    return scale * tracking_velocity(problem)

class Still:
    def __init__(self, case, world):
        self.nv = world.scene.robot.model.nv
    def step(self, q, t, targets, obstacles):
        return Solution(np.zeros(self.nv))

def pilot(case, world):
    return Still(case, world)

class Slow(Still):
    def step(self, q, t, targets, obstacles):
        time.sleep(0.002)
        return Solution(np.zeros(self.nv))

class Deadly(Still):
    def __init__(self, case, world):
        os._exit(3)

class Picky:
    def __init__(self):
        raise RuntimeError("not with me")
    def solve(self, problem):
        raise AssertionError

class Mistyped:
    def solve(self, problem):
        return Solution(problem.v_tracking_)

def short(problem):
    return problem.v_tracking[:3]

def nan(problem):
    return np.nan * problem.v_tracking

def now_and_then(problem):
    if problem.v_tracking[0] > 0.0:
        raise ValueError("not now")
    return problem.v_tracking

NUMBER = 7
'''
PATH = f"{Path.cwd()}{os.pathsep}{Path.cwd() / 'bench'}"


@pytest.fixture
def folder(tmp_path):
    """Where a suite of one's own lies, with its family and its entrants."""
    (tmp_path / "post.yaml").write_text(yaml.safe_dump(POST))
    (tmp_path / "laws.py").write_text(LAWS)
    return tmp_path


def write_suite(folder, entrants=("tracking",), seeds=2, **more):
    path = folder / "mine.yaml"
    fields = {"title": "Mine", "families": ["post.yaml"], "entrants": list(entrants), "seeds": seeds, **more}
    path.write_text(yaml.safe_dump(fields))
    return path


@pytest.fixture(scope="module")
def client():
    """Two processes for all tests."""
    with sweep.local_cluster(2) as client:
        yield client


def swept(suite, out, client, tell=lambda tally: None):
    with Store(out) as there:
        return sweep.sweep(suite, there, client, tell)


def abandon(writer):
    """Leaves a folder as its writer does when it is killed: what the system closes is closed, nothing else happens."""
    for file in (writer.runs, writer.cases, writer._failures, writer._lock):
        file.close()


def keys_of(table, key=KEY):
    return list(zip(*(table[name].to_pylist() for name in key), strict=True))


def row_of(**fields):
    """A row of a run, with something in every column."""
    zero = {"str": "", "int": 0, "float": 0.0, "bool": False}
    return {**{name: zero[kind] for name, kind in COLUMNS.items()}, **fields}


# --- the store ---------------------------------------------------------------------------------------------------


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(steps=st.lists(st.sampled_from(["row", "again", "fold", "killed", "torn", "renamed"]), max_size=25))
def test_store_rows_survive_killed_writer(tmp_path_factory, steps):
    """Against a dictionary: rows, Parquet files in between, ends of all kinds; each row is read once, in order."""
    out, model = tmp_path_factory.mktemp("out"), {}
    writer = Store(out)
    for step in steps:
        if step in ("row", "again"):
            n = len(model) if step == "row" or not model else 0
            model.setdefault(f"case{n}", float(n))
            writer.runs.append(row_of(case=f"case{n}", jerk=float(n)))
        elif step == "fold":
            writer.runs.fold()
        else:  # gone without a word: nothing is folded; the next writer begins with what lies there
            journal = out / "runs.jsonl"
            before = journal.read_bytes()
            abandon(writer)
            if step == "torn":
                journal.write_bytes(before + b'{"case": "half')
            if step == "renamed":  # killed between the renaming of a Parquet file and the end of its journal
                with Store(out):
                    pass
                journal.write_bytes(before)
            writer = Store(out)
        table = read_runs(out)
        assert dict(zip(table["case"].to_pylist(), table["jerk"].to_pylist(), strict=True)) == model
        assert len(table) == len(model) and table["case"].to_pylist() == list(model)
    writer.__exit__(None, None, None)
    assert read_runs(out)["case"].to_pylist() == list(model)


def test_store_row_round_trip(tmp_path):
    """A row comes back as it was."""
    row = row_of(family="a – b", seed=2**40, success=True, min_distance=float("inf"), jerk=0.1 + 0.2, failure='"\n\\')
    for fold in (False, True):
        with Store(tmp_path / str(fold)) as writer:
            writer.runs.append(row)
            if not fold:
                assert read_runs(tmp_path / str(fold)).to_pylist() == [row]
        assert read_runs(tmp_path / str(fold)).to_pylist() == [row]


def test_store_folds_rows_into_few_files(tmp_path, monkeypatch):
    """Many rows become few files."""
    monkeypatch.setattr(store, "FOLD", 10)
    with Store(tmp_path) as writer:
        for n in range(35):
            writer.runs.append(row_of(case=str(n)))
        assert len(list((tmp_path / "runs").glob("*.parquet"))) == 3
        assert (tmp_path / "runs.jsonl").read_bytes().count(b"\n") == 5
    assert read_runs(tmp_path)["case"].to_pylist() == [str(n) for n in range(35)]
    assert len(list((tmp_path / "runs").iterdir())) == 4


def test_store_has_one_writer(tmp_path):
    """One writer a folder."""
    with Store(tmp_path), pytest.raises(ConfigError, match=rf"process {os.getpid()} on .* writes here; .*--out"):
        Store(tmp_path)
    with Store(tmp_path):
        pass


def test_folders_that_cannot_be_read(tmp_path):
    with pytest.raises(ConfigError, match="no results here"):
        read_runs(tmp_path)
    with Store(tmp_path) as writer:
        writer.runs.append(row_of())
    (part,) = (tmp_path / "runs").glob("*.parquet")
    part.write_bytes(part.read_bytes()[:-10])
    with pytest.raises(ConfigError, match=rf"{part.name}.*move the damaged file away"):
        read_runs(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"file: .*give a folder that can be written"):
        Store(tmp_path / "file")


# --- what is missing ---------------------------------------------------------------------------------------------


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(data=st.data())
def test_plan_missing_runs_equal_set_difference(tmp_path_factory, data):
    """Against loops over sets, with rows of other versions, settings and cases about."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "post.yaml").write_text(yaml.safe_dump(POST))
    suite = load_suite(write_suite(folder, ["tracking", "qp", "eq10"], seeds=4))
    made = data.draw(st.sets(st.integers(0, 6)))
    of = origin(suite.families[0])
    done = data.draw(st.sets(st.tuples(st.integers(0, 5), st.sampled_from(["tracking", "qp", "hqp"]), st.booleans())))
    with Store(folder / "out") as writer:
        for seed in made:
            writer.cases.append({"family": "post", "seed": seed, "origin": of, "case": f"c{seed}", "json": "{}"})
            writer.cases.append({"family": "post", "seed": seed, "origin": "old", "case": f"c{seed}-old", "json": "{}"})
        for seed, name, ours in done:
            digest, made_by = ENTRANTS[name].digest, version("qpavoid") if ours else "0.0.1"
            writer.runs.append(row_of(case=f"c{seed}", entrant=name, settings=digest, version=made_by))
    out = folder / "out"
    assert missing_cases(suite, out)["seed"].to_pylist() == [seed for seed in range(4) if seed not in made]
    cases = cases_of(suite, out)
    assert cases["case"].to_pylist() == [f"c{seed}" for seed in range(4) if seed in made]
    wanted = [(seed, name) for seed in range(4) if seed in made for name in ("tracking", "qp", "eq10")]
    left = [(f"c{seed}", name) for seed, name in wanted if (seed, name, True) not in done]
    assert keys_of(missing_runs(suite, out, cases), ("case", "entrant")) == left
    there = {(f"c{seed}", name) for seed, name in wanted if (seed, name, True) in done}
    runs = runs_of(suite, out)
    assert set(keys_of(runs, ("case", "entrant"))) == there and len(runs) == len(there)
    assert is_complete(suite, out) == (not left and set(range(4)) <= made)


def test_digest_changes_with_settings_and_families(folder):
    """Settings and families that change want results of their own."""

    def digests(**fields):
        entrant = EntrantConfig.model_validate({"name": "mine", "solver": "qp", **fields}).entrant()
        return entrant.digest

    assert len({digests(), digests(solver="eq10"), digests(avoidance={"d2": 0.2}), digests(avoidance={"d2": 0.3})}) == 4
    assert digests(description="other words") == digests()
    before = origin(load_family(folder / "post.yaml"))
    assert origin(load_family(folder / "post.yaml")) == before
    (folder / "post.yaml").write_text(yaml.safe_dump({**POST, "scenario": {**POST["scenario"], "dt": 0.01}}))
    assert origin(load_family(folder / "post.yaml")) != before
    made_by = {**POST, "generator": "posts.py:posts", "parameters": {}}
    made_by["scenario"] = {key: value for key, value in POST["scenario"].items() if key != "obstacles"}
    (folder / "post.yaml").write_text(yaml.safe_dump(made_by))
    (folder / "posts.py").write_text("def posts(draw, robot):\n    return {}\n")
    first = origin(load_family(folder / "post.yaml"))
    (folder / "posts.py").write_text("def posts(draw, robot):\n    return {'title': 'x'}\n")
    assert origin(load_family(folder / "post.yaml")) != first


# --- suites and entrants -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", suite_names())
def test_suites_that_ship(name):
    suite = load_suite(name)
    assert suite.families and suite.entrants and len(suite.seeds) >= 2


def test_the_full_suite_is_everything():
    suite = load_suite("full")
    assert sorted(family.name for family in suite.families) == family_names()
    assert {entrant.name for entrant in suite.entrants + suite.absent} == set(ENTRANTS)


def test_entrant_config_changes_only_its_settings(folder):
    """A law with settings of its own changes these and no others."""
    path = write_suite(
        folder, [{"name": "wide", "solver": {"name": "qp", "backend": "daqp"}, "avoidance": {"d2": 0.3}}]
    )
    (entrant,) = load_suite(path).entrants
    case = make_case(load_family(folder / "post.yaml"), 0)
    controller = entrant.start(case, build_world(case.scenario))
    assert controller.avoidance == case.scenario.avoidance.model_copy(update={"d2": 0.3})
    assert entrant.name == "wide" and entrant.settings["avoidance"] == {"d2": 0.3}


def test_suite_selects_entrants(folder, monkeypatch):
    """Who takes part."""
    monkeypatch.setitem(ENTRANTS, "absent", replace(ENTRANTS["qp"], name="absent", packages=("no_such_package",)))
    wide = {"name": "wide", "solver": "qp", "avoidance": {"d2": 0.3}}
    path = write_suite(folder, ["tracking", "absent", wide, "laws.py:Halved"])
    suite = load_suite(path)
    assert [entrant.name for entrant in suite.entrants] == ["tracking", "wide", "Halved"]
    assert [entrant.name for entrant in suite.absent] == ["absent"]
    chosen = load_suite(path, ["wide", "eq10"], [f"{folder}/laws.py:Still"], seeds=5)
    assert [entrant.name for entrant in chosen.entrants] == ["wide", "eq10", "Still"]
    assert chosen.entrants[0].digest == suite.entrants[1].digest and chosen.seeds == range(5)
    with pytest.raises(ConfigError, match="--solvers: entrant 'absent' needs no_such_package"):
        load_suite(path, ["absent"])
    with pytest.raises(ConfigError, match="none can take part: absent needs no_such_package"):
        load_suite(write_suite(folder, ["absent"]))


@pytest.mark.parametrize(
    ("fields", "options", "said"),
    [
        ({"entrants": ["trcking"]}, {}, r"mine.yaml: entrants.0: unknown entrant 'trcking'; did you mean 'tracking'"),
        ({"families": ["shelv"]}, {}, r"mine.yaml: families.0: unknown family 'shelv'; did you mean 'shelf'"),
        ({"famlies": ["shelf"]}, {}, r"famlies: unknown key; did you mean 'families'"),
        ({"entrants": ["qp", "qp"]}, {}, r"entrants.1: 'qp' is there twice"),
        ({"families": ["post.yaml", "post.yaml"]}, {}, r"'post' is there twice"),
        ({"entrants": [{"name": "a", "solver": "qp", "avoidance": {"d3": 1}}]}, {}, r"d3: unknown key"),
        ({"entrants": [{"name": "a", "solver": "qq"}]}, {}, r"unknown name 'qq'"),
        ({"entrants": ["laws.py:Halvd"]}, {}, r"laws.py: there is no 'Halvd' in it; did you mean 'Halved'"),
        ({"entrants": ["laws.py:NUMBER"]}, {}, r"laws.py:NUMBER: cannot take part; give a class with `solve"),
        ({"entrants": ["lows.py:Halved"]}, {}, r"lows.py: cannot be read: No such file"),
        ({}, {"solvers": ["trackin"]}, r"--solvers: unknown entrant 'trackin'; did you mean 'tracking'"),
        ({}, {"more": ["tracking"]}, r"--entrant: 'tracking' is there twice"),
        ({}, {"seeds": 0}, r"--seeds 0: give 1 to"),
        ({"seeds": 0}, {}, r"seeds: .*greater than or equal to 1"),
    ],
)
def test_suite_errors_are_one_line(folder, fields, options, said):
    with pytest.raises(ConfigError, match=said):
        load_suite(write_suite(folder, **fields), **options)


def test_no_such_suite():
    with pytest.raises(UnknownName, match="unknown suite 'smok'; did you mean 'smoke'"):
        load_suite("smok")


def test_entrant_file_errors_name_file(tmp_path):
    for text, said in (("def f(:", "SyntaxError"), ("1 / 0", "ZeroDivisionError"), ("exit()", "SystemExit")):
        (tmp_path / "bad.py").write_text(text)
        with pytest.raises(ConfigError, match=rf"bad.py: cannot be run: {said}"):
            entrant_from_file(tmp_path / "bad.py", "f")


def test_entrant_from_file_digest_depends_on_text_only(folder):
    """The digest of an own entrant follows its text and not its place."""
    first = entrant_from_file(folder / "laws.py", "Halved")
    (folder / "elsewhere").mkdir()
    (folder / "elsewhere" / "laws.py").write_text(LAWS)
    assert entrant_from_file(folder / "elsewhere" / "laws.py", "Halved").digest == first.digest
    (folder / "laws.py").write_text(LAWS.replace("0.5", "0.4"))
    assert entrant_from_file(folder / "laws.py", "Halved").digest != first.digest
    assert first.description == "A class with solve."


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Mistyped", "AttributeError: 'Problem' object has no attribute 'v_tracking_'"),
        ("short", r"NumericalError: its velocity: shape \(3,\), expected \(6,\)"),
        ("nan", "NumericalError: its velocity: NaN or infinity"),
    ],
)
def test_entrant_from_file_failure_names_cause(folder, name, said):
    """A controller brakes where its law fails; the arena must not take that for what the law wants."""
    row = run_trial(make_case(load_family(folder / "post.yaml"), 0), entrant_from_file(folder / "laws.py", name))
    assert row.failed == row.stopped == 1.0 and not row.success and re.search(said, row.failure)


def test_entrant_from_file_continues_after_failure(folder):
    """A law that fails now and then goes on."""
    row = run_trial(
        make_case(load_family(folder / "post.yaml"), 0), entrant_from_file(folder / "laws.py", "now_and_then")
    )
    assert 0.0 < row.failed < 1.0 and row.failure == "ValueError: not now" and row.path_length > 0.0


# --- sweeps ------------------------------------------------------------------------------------------------------


def test_sweep_rows_equal_single_runs(folder, client):
    """Also what shows that own entrants of every kind run: from text that was sent, in other processes."""
    own = [f"laws.py:{name}" for name in ("Halved", "solution", "velocity", "Still", "pilot")]
    path, out = write_suite(folder, ["tracking", "qp", *own], seeds=1), folder / "out"
    suite, reports = load_suite(path), []
    tally = swept(suite, out, client, reports.append)
    assert tally.done == tally.total == 7 and tally.failed == 0
    assert [t.done for t in reports if t.stage == "runs"] == list(range(8))
    runs = {row["entrant"]: row for row in read_runs(out).to_pylist()}
    case = make_case(load_family(folder / "post.yaml"), 0)
    timed = {"tick_p50", "tick_p99", "seconds"}
    for entrant in suite.entrants:
        alone = run_trial(case, entrant).row()
        row = runs[entrant.name]
        assert row["failure"] == ""
        for name in COLUMNS.keys() - timed:
            assert row[name] == (
                pytest.approx(alone[name], rel=1e-9, abs=1e-9) if COLUMNS[name] == "float" else alone[name]
            )
    figures = {
        name: {k: v for k, v in row.items() if k not in timed | {"entrant", "settings"}} for name, row in runs.items()
    }
    assert figures["solution"] == figures["velocity"] == figures["tracking"] != figures["Halved"]
    assert figures["Still"] == figures["pilot"] and runs["Still"]["path_length"] == 0.0

    before = read_runs(out).to_pylist()
    assert swept(suite, out, client).done == 0 and read_runs(out).to_pylist() == before
    (folder / "laws.py").write_text(LAWS + "# another one\n")
    more = load_suite(path, ["tracking", "eq10", f"{folder}/laws.py:Halved"], seeds=2)
    assert swept(more, out, client).done == 5  # all three in the new case, and two that are new in the old one
    after = read_runs(out)
    assert after.to_pylist()[: len(before)] == before and len(set(keys_of(after))) == len(after) == 12
    assert len(runs_of(suite, out)) == 7 and len(runs_of(more, out)) == 6  # of the text that Halved had, and has now
    facts = json.loads((out / "suite.json").read_text())
    assert {"tracking", "eq10", "Halved", "pilot"} <= {entry["name"] for entry in facts["entrants"].values()}
    assert facts["versions"]["qpavoid"] and facts["machine"]["cpu"]


def test_sweep_keeps_runs_of_dead_processes(folder, client):
    """What cannot be set up or takes its process down has failed and is not lost."""
    suite = load_suite(write_suite(folder, ["laws.py:Picky", "laws.py:Deadly", "laws.py:Still"], seeds=2))
    tally = swept(suite, folder / "out", client)
    assert tally.done == tally.total == 6 and tally.failed == 0
    rows = read_runs(folder / "out").to_pylist()
    assert len({(row["seed"], row["entrant"]) for row in rows}) == len(rows) == 6
    said = {"Picky": "cannot be set up: RuntimeError: not with me", "Deadly": "killed, out of memory or crashed"}
    for row in rows:
        assert row["path_length"] == 0.0 and not row["success"] and not row["arrived"]
        assert row["failed"] == (0.0 if row["entrant"] == "Still" else 1.0)
        assert said.get(row["entrant"], "") in row["failure"]
        assert row["stopped"] == row["failed"] and row["time_to_goal"] == 1.0
    assert is_complete(suite, folder / "out")


def test_sweep_replaces_lost_processes(folder, monkeypatch):
    """As when a machine is so busy that they take too long to start again; otherwise the sweep waits for ever."""

    def too_long(*_):
        raise AssertionError("the sweep waits for a process that never comes")

    monkeypatch.setitem(sweep._DASK_CONFIG, "distributed.deploy.lost-worker-timeout", "1 ms")
    suite = load_suite(write_suite(folder, ["laws.py:Deadly", "laws.py:Still"], seeds=1))
    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(120)
    try:
        with sweep.local_cluster(1) as client:
            assert swept(suite, folder / "out", client)[1:] == (2, 2, 0, 0)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def test_sweep_continues_after_case_failure(folder, client):
    (post,) = POST["scenario"]["obstacles"]
    around = {**post, "motion": {"type": "fixed", "position": [0.0, 0.0, 0.5]}}  # the arm itself: no draw will do
    crowded = {**POST, "scenario": {**POST["scenario"], "obstacles": [post, {**around, "name": "around"}]}}
    (folder / "crowded.yaml").write_text(yaml.safe_dump(crowded))
    suite = load_suite(write_suite(folder, ["tracking"], seeds=1, families=["crowded.yaml", "post.yaml"]))
    tally = swept(suite, folder / "out", client)
    assert tally.done == 1 and tally.failed == 1
    (failure,) = map(json.loads, (folder / "out" / "failures.jsonl").read_text().splitlines())
    assert failure["family"] == "crowded" and failure["entrant"] is None and "crowded.yaml" in failure["failure"]
    assert not is_complete(suite, folder / "out")
    assert read_runs(folder / "out")["family"].to_pylist() == ["post"]


@pytest.fixture
def cluster(tmp_path):
    """A scheduler and two workers of this test's own, as users start them: its address and the workers."""
    python, env = [sys.executable, "-m"], {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": PATH}
    processes, quiet = [], {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": env, "cwd": tmp_path}
    file = tmp_path / "scheduler.json"

    def start(*words):
        processes.append(subprocess.Popen([*python, *map(str, words)], **quiet))
        return processes[-1]

    try:
        start("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", 0, "--no-dashboard",
              "--dashboard-address", "127.0.0.1:0", "--scheduler-file", file)  # fmt: skip
        until(file.exists)
        address = json.loads(file.read_text())["address"]
        workers = [
            start("distributed.cli.dask_worker", address, "--nthreads", 1, "--no-nanny", "--no-dashboard")
            for _ in range(2)
        ]
        yield address, workers, processes[0]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def until(true, seconds=300.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def test_sweep_survives_lost_worker(folder, cluster):
    """A cluster loses a worker half way."""
    address, workers, scheduler = cluster
    suite, out = load_suite(write_suite(folder, ["tracking", "laws.py:Slow"], seeds=6)), folder / "out"

    def tell(tally):
        if tally.stage == "runs" and tally.done == 4:
            workers[0].kill()

    with sweep.remote_cluster(address) as client:
        client.wait_for_workers(2, timeout=300)
        tally = swept(suite, out, client, tell)
        assert len(client.nthreads()) == 1
    assert tally.done == tally.total == 12 and tally.failed == 0
    runs = read_runs(out)
    assert len(runs) == len(set(keys_of(runs))) == 12 and not any(runs["failed"].to_pylist())
    lines = sum(pq.read_metadata(part).num_rows for part in (out / "runs").glob("*.parquet"))
    assert lines == 12  # nor was a row written twice and dropped on reading

    # and when the scheduler goes, the sweep ends, and says so
    longer = load_suite(folder / "mine.yaml", seeds=30)
    with sweep.remote_cluster(address) as client, pytest.raises(sweep.ClusterLost), Store(out) as there:
        sweep.sweep(longer, there, client, lambda tally: scheduler.kill() if tally.stage == "cases" else None)


def bench(folder, *words):
    """`qpavoid bench run` of the suite in a folder, in a process group of its own."""
    command = [sys.executable, "-m", "qpavoid", "bench", "run", "mine.yaml", "--out", "out", "--jobs", "2", *words]
    env = {**os.environ, "PYTHONPATH": PATH}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=folder, env=env, start_new_session=True, **pipes)


def rows_in(folder):
    journal = folder / "out" / "runs.jsonl"
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def test_killed_then_interrupted_then_finished(folder, client):
    suite = load_suite(write_suite(folder, ["laws.py:Slow"], seeds=24))
    first = bench(folder)
    until(lambda: rows_in(folder) >= 3)
    first.kill()
    first.communicate()
    kept = keys_of(read_runs(folder / "out"))
    assert 3 <= len(kept) < 24 and len(set(kept)) == len(kept)
    made = len(read_cases(folder / "out"))

    second, folded = bench(folder), folder / "out" / "runs"
    until(lambda: list(folded.glob("*.parquet")) and rows_in(folder) >= 3)  # of its own: the first one's are folded
    os.killpg(second.pid, signal.SIGINT)  # as a terminal does at Ctrl-C: to the workers as well
    printed, said = second.communicate(timeout=300)
    assert second.returncode == 1 and printed == ""
    assert "interrupted: " in said and "the same command goes on" in said and "Traceback" not in said
    more = keys_of(read_runs(folder / "out"))
    assert more[: len(kept)] == kept and len(kept) + 3 <= len(more) < 24 and len(set(more)) == len(more)
    assert len(read_cases(folder / "out")) == made == 24

    tally = swept(suite, folder / "out", client)
    assert tally.done == 24 - len(more) and tally.failed == 0
    assert sorted(read_runs(folder / "out")["seed"].to_pylist()) == list(range(24))


# --- the commands ------------------------------------------------------------------------------------------------


def test_bench_run_show_and_resume(cli, folder, monkeypatch):
    """Run then show then nothing left to do."""
    write_suite(folder, ["tracking", {"name": "wide", "solver": "qp", "avoidance": {"d2": 0.3}}], seeds=2)
    first = cli("bench", "run", "mine.yaml", "--json", "--jobs", "1")
    assert first.status == 0
    document = json.loads(first.stdout)
    assert document["runs"] == document["new"] == 4 and document["failed"] == 0
    assert [entry["entrant"] for entry in document["entrants"]] == ["tracking", "wide"]
    with monkeypatch.context() as patch:
        patch.setattr(sweep, "local_cluster", None)  # no process is started for it
        rerun = cli("bench", "run", "mine.yaml")
    assert rerun.status == 0 and "4 runs, 0 of them new" in rerun.stdout and "tracking" in rerun.stdout
    out = Path("out/bench/mine")
    shown = cli(
        "bench", "show", out, "--family", "post", "--seed", 1, "--entrant", "wide", "--scenario", "case.yaml", "--json"
    )
    assert shown.status == 0
    run = json.loads(shown.stdout)["run"]
    (row,) = [row for row in read_runs(out).to_pylist() if row["entrant"] == "wide" and row["seed"] == 1]
    assert all(run[name] == row[name] for name in (*KEY, "success", "collided", "contacts"))
    assert cli("run", "case.yaml", "--no-figures").status in (0, 1)
    lines = cli("bench", "show", out, "--family", "post", "--seed", 1, "--entrant", "wide").stdout.splitlines()
    assert {line.split()[0] for line in lines} == {"solved_by", *COLUMNS}
    assert cli("bench", "show", out, "--family", "post", "--seed", 7, "--json").lines == [
        f"error: {out}: post has no seed 7; there are 2 from 0 to 1"
    ]


def test_list_names_everything(cli):
    document = json.loads(cli("bench", "list", "--json").stdout)
    assert document["entrants"].keys() == ENTRANTS.keys() and set(suite_names()) == document["suites"].keys()
    words = cli("bench", "list").stdout
    assert all(name in words for heading in document.values() for name in heading)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "smok"], "unknown suite 'smok'; did you mean 'smoke'?"),
        (["run", "smoke", "--solvers", ","], "--solvers: names none"),
        (["run", "smoke", "--jobs", "2", "--cluster", "tcp://127.0.0.1:1"], "leave one of --jobs and --cluster out"),
        (["run", "smoke", "--cluster", "tcp://127.0.0.1:1", "--out", "o"], "no scheduler answers: .*start one with"),
        (["run", "smoke", "--cluster", "nonsense://x", "--out", "o"], "no scheduler answers: .*start one with"),
        (["show", "nowhere", "--family", "post", "--seed", "1"], "nowhere: no results here"),
    ],
)
def test_bad_input_is_a_line_and_exit_status_2(cli, monkeypatch, words, said):
    monkeypatch.setattr(sweep, "_CONNECT_TIMEOUT", 0.5)
    result = cli("bench", *words)
    lines = [line for line in result.lines if "does not take part" not in line]
    assert result.status == 2 and len(lines) == 1
    assert re.search(said, lines[0])


def test_bench_without_extra_names_remedy(cli, monkeypatch):
    """Without the extra the bench says what to install."""
    monkeypatch.setattr(commands, "find_spec", lambda name: None if name in ("pyarrow", "distributed") else True)
    result = cli("bench", "list")
    assert result.status == 2
    assert result.lines == ["error: qpavoid bench needs distributed, pyarrow: pip install 'qpavoid[arena]'"]


def test_cli_does_not_import_arena_dependencies():
    """The rest of the command line brings nothing of the arena in."""
    code = (
        "import sys, qpavoid.cli; "
        "sys.exit(bool({'dask', 'distributed', 'pyarrow', 'mujoco', 'matplotlib'} & sys.modules.keys()))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=300).returncode == 0


# --- what must hold of any results -------------------------------------------------------------------------------


def smoke_rows(folder, **changes):
    """Rows of a suite in which all is well, but for those that are changed: (entrant, seed) → fields."""
    suite = load_suite(write_suite(folder, ["tracking", "qp"], seeds=2))
    cases = [make_case(load_family(folder / "post.yaml"), seed) for seed in range(2)]
    rows = [
        {
            **row_of(
                family="post", seed=case.seed, case=case.key, entrant=entrant.name, collided=entrant.name == "tracking"
            ),
            **changes.get(f"{entrant.name}{case.seed}", {}),
        }
        for case in cases
        for entrant in suite.entrants
    ]
    table = pa.table({"case": [case.key for case in cases], "json": [case.to_json() for case in cases]})
    return suite, [row for row in rows if row["family"]], table


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, []),
        ({"qp0": {"collided": True}}, ["qp touches something in post, seed 0"]),
        ({"tracking0": {"collided": False}, "tracking1": {"collided": False}}, ["tracking touches nothing"]),
        ({"qp1": {"failed": 1.0, "failure": "no"}}, ["qp fails at every tick of post, seed 1: no"]),
        ({"qp0": {"failed": 0.1, "failure": "no"}, "qp1": {"failed": 0.1}}, ["qp fails in all of its 2 runs: no"]),
        ({"qp1": {"family": ""}}, ["qp: 1 rows for 2 cases"]),
        ({"tracking1": {"deviation": 0.05}}, ["tracking is 50.0 mm off its path"]),
        ({"qp1": {"jerk": np.nan}}, ["jerk: NaN"]),
    ],
)
def test_find_faults_names_faults(folder, changes, said):
    """The smoke test tells what is broken."""
    suite, rows, cases = smoke_rows(folder, **changes)
    faults = list(find_faults(suite, pa.Table.from_pylist(rows, schema=store.RUNS.schema), cases))
    assert len(faults) == len(said) and all(fault.startswith(start) for fault, start in zip(faults, said, strict=True))


def test_the_summary_is_that_of_numpy(tmp_path):
    rng = np.random.default_rng(0)
    figures = [{"failed": x, "min_distance": y, "tick_p50": z} for x, y, z in rng.normal(size=(200, 3))]
    rows = [
        row_of(
            entrant=str(rng.choice(["b", "a"])), case=str(n), success=bool(rng.random() < 0.5), failure=f"{n}", **fields
        )
        for n, fields in enumerate(figures)
    ]
    table = summary(pa.Table.from_pylist(rows, schema=store.RUNS.schema))
    assert [entry["entrant"] for entry in table] == list(dict.fromkeys(row["entrant"] for row in rows))
    for entry in table:
        own = [row for row in rows if row["entrant"] == entry["entrant"]]
        failed = [row["failure"] for row in own if row["failed"] > 0]
        assert entry["runs"] == len(own) and entry["failed"] == len(failed) and entry["failure"] == failed[0]
        assert entry["success"] == pytest.approx(np.mean([row["success"] for row in own]))
        assert entry["min_distance"] == min(row["min_distance"] for row in own)
        assert entry["tick_p50"] == pytest.approx(np.median([row["tick_p50"] for row in own]), abs=0.1)
    assert summary(store.RUNS.schema.empty_table()) == []
