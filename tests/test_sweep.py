"""Running the arena: nothing is lost, nothing is counted twice, nothing is done again, whatever is killed meanwhile."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from in_process import InProcess

pytest.importorskip("distributed")
pytest.importorskip("mujoco")

from qpavoid.config.shipped import shipped_names
from qpavoid.errors import ConfigError
from qpavoid.run.pool import ClusterLost, ClusterWorkers, Workers
from qpavoid_bench.arena import commands, sweep
from qpavoid_bench.arena.entrant_file import entrant_from_file
from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.families import load_family, make_case
from qpavoid_bench.arena.scores import COLUMNS, KEY
from qpavoid_bench.arena.store import FILE, Store, read_cases, read_facts, read_failures, read_runs
from qpavoid_bench.arena.suite import EntrantConfig, load_suite, origin
from qpavoid_bench.arena.summary import find_faults, summary
from qpavoid_bench.arena.trial import run_trial
from qpavoid_bench.arena.world import build_world

POST = yaml.safe_load("""
title: A post
about: The tool of a UR5 goes past a post.
robots: [ur5]
parameters: {y: {type: uniform, range: [-0.25, -0.15], about: "of the post [m]"}}
scenario:
  tasks: [{frame: tool0, motion: {type: line, displacement: [0, -0.2, 0], speed: 0.2, profile: smooth}}]
  obstacles:
  - name: post
    shape: {type: capsule, radius: 0.02, length: 0.5}
    motion: {type: fixed, position: [0.6, $y, 0.25]}
  avoidance: {d1: 0.02, d2: 0.12}
  dt: 0.02
  duration: 3.0
""")
"""A family that is solved at once."""
LAWS = '''
"""Entrants of each kind."""
import os, time
from dataclasses import dataclass
import numpy as np
from qpavoid import Solution

@dataclass
class Halved:
    """A class with solve."""
    share: float = 0.5
    def solve(self, problem):
        return Solution(self.share * problem.v_tracking)

def solution(problem):
    return Solution(problem.v_tracking)

def velocity(problem, scale=1.0):
    return scale * problem.v_tracking

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
ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{Path.cwd()}{os.pathsep}{Path.cwd() / 'bench'}"}
"""In which processes find this checkout."""


@pytest.fixture
def folder(tmp_path):
    """Where a suite of one's own lies, with its family and its entrants."""
    (tmp_path / "post.yaml").write_text(yaml.safe_dump(POST))
    (tmp_path / "laws.py").write_text(LAWS)
    (tmp_path / "exits.py").write_text("exit()")
    return tmp_path


def write_suite(folder, entrants=("tracking",), seeds=2, **more):
    path = folder / "mine.yaml"
    fields = {"title": "Mine", "families": ["post.yaml"], "entrants": list(entrants), "seeds": seeds, **more}
    path.write_text(yaml.safe_dump(fields))
    return path


def swept(suite, out, workers=None, tell=lambda tally: None):
    with Store(out) as store:
        return sweep.sweep(suite, store, workers or InProcess(), tell)


def plan_of(suite, out):
    with Store(out) as store:
        return sweep.plan(suite, store)


def rows_in(folder):
    return read_runs(folder / "out").to_dict("records")


def row_of(**fields):
    """A row of a run, with something in every column."""
    zero = {"str": "", "int": 0, "float": 0.0, "bool": False}
    return {**{name: zero[kind] for name, kind in COLUMNS.items()}, **fields}


# --- the store ---------------------------------------------------------------------------------------------------


def test_store_row_round_trip(tmp_path):
    """A row comes back as it was, once, however often it is added; NaN is read as NaN."""
    row = row_of(family="a – b", seed=2**40, success=True, min_distance=float("inf"), jerk=0.1 + 0.2, failure='"\n\\')
    with Store(tmp_path) as store:
        store.add("runs", row)
        assert read_runs(tmp_path).to_dict("records") == [row]
        store.add("runs", {**row, "jerk": 7.0})
        with Store(tmp_path) as second:  # another process may write meanwhile
            second.add("runs", {**row, "case": "other", "jerk": float("nan")})
    runs = read_runs(tmp_path)
    assert runs.iloc[:1].to_dict("records") == [row] and np.isnan(runs["jerk"][1]) and len(runs) == 2
    assert list((tmp_path).iterdir()) == [tmp_path / FILE]


def test_store_errors_name_file_and_remedy(tmp_path):
    with pytest.raises(ConfigError, match="no results here"):
        read_runs(tmp_path)
    (tmp_path / FILE).write_text("not a database, though long enough to be one" * 100)
    with pytest.raises(ConfigError, match=rf"{FILE}.*move the damaged file away"):
        read_runs(tmp_path)
    with pytest.raises(ConfigError, match=rf"give a folder that can be written, with no damaged {FILE} in it"):
        Store(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"file: .*give a folder that can be written"):
        Store(tmp_path / "file")


# --- what is missing ---------------------------------------------------------------------------------------------


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(data=st.data())
def test_plan_is_what_is_wanted_less_what_is_done(tmp_path_factory, data):
    """Rows of other versions, settings and cases do not count."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "post.yaml").write_text(yaml.safe_dump(POST))
    suite = load_suite(write_suite(folder, ["tracking", "qp", "eq10"], seeds=4))
    made = data.draw(st.sets(st.integers(0, 6)))
    of = origin(suite.families[0])
    done = data.draw(st.sets(st.tuples(st.integers(0, 5), st.sampled_from(["tracking", "qp", "hqp"]), st.booleans())))
    with Store(folder / "out") as store:
        for seed in made:
            for made_of in (of, "old"):
                case = {"case": f"c{seed} {made_of}", "json": f"text {seed} {made_of}"}
                store.add("cases", {"family": "post", "seed": seed, "origin": made_of, **case})
        for seed, name, ours in done:
            digest, made_by = ENTRANTS[name].digest, version("qpavoid") if ours else "0.0.1"
            store.add("runs", row_of(case=f"c{seed} {of}", entrant=name, settings=digest, version=made_by))
        plan = sweep.plan(suite, store)
    there = [seed for seed in range(4) if seed in made]
    assert plan.cases == [("post", seed, of) for seed in range(4) if seed not in made]
    assert plan.texts == [f"text {seed} {of}" for seed in there]
    wanted = [(seed, name) for seed in there for name in ("tracking", "qp", "eq10")]
    assert {(case, name) for case, name, *_ in plan.keys} == {(f"c{seed} {of}", name) for seed, name in wanted}
    left = [(f"text {seed} {of}", name) for seed, name in wanted if (seed, name, True) not in done]
    assert [(text, entrant.name) for text, entrant in plan.runs] == left


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


def test_suites_that_ship():
    """The four largest together have all families with a proof, and all entrants."""
    assert all(load_suite(name).seeds for name in shipped_names("suite"))
    large = [load_suite(name) for name in ("full", "teleoperation", "noise", "torque")]
    proved = {name for name in shipped_names("family") if load_family(name).config.proved}
    assert {family.name for suite in large for family in suite.families} == proved
    assert {entrant.name for suite in large for entrant in suite.entrants + suite.absent} == set(ENTRANTS)


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
    case = make_case(load_family(folder / "post.yaml"), 0)
    controller = chosen.entrants[0].start(case, build_world(case.scenario))
    assert controller.avoidance == case.scenario.avoidance.model_copy(update={"d2": 0.3})  # and nothing else
    with pytest.raises(ConfigError, match=r"--solvers: entrant 'absent' .*needs no_such_package"):
        load_suite(path, ["absent"])
    with pytest.raises(ConfigError, match=r"none can take part: absent .*no_such_package"):
        load_suite(write_suite(folder, ["absent"]))


@pytest.mark.parametrize(
    ("fields", "options", "said"),
    [
        ({"entrants": ["trcking"]}, {}, r"mine.yaml: entrants.0: unknown entrant 'trcking'; did you mean 'tracking'"),
        ({"entrants": ["qp", "qp"]}, {}, r"entrants.1: 'qp' is there twice"),
        ({"families": ["post.yaml", "post.yaml"]}, {}, r"'post' is there twice"),
        ({"entrants": [{"name": "a", "solver": "qp", "avoidance": {"d3": 1}}]}, {}, r"d3: unknown key"),
        ({"entrants": ["laws.py:Halvd"]}, {}, r"laws.py: there is no 'Halvd' in it; did you mean 'Halved'"),
        ({"entrants": ["exits.py:f"]}, {}, r"exits.py: cannot be run: SystemExit"),
        ({"entrants": ["laws.py:NUMBER"]}, {}, r"laws.py:NUMBER: cannot take part; give a class with `solve"),
        ({}, {"solvers": ["trackin"]}, r"--solvers: unknown entrant 'trackin'; did you mean 'tracking'"),
        ({}, {"more": ["tracking"]}, r"--entrant: 'tracking' is there twice"),
        ({}, {"seeds": 0}, r"--seeds 0: give 1 to"),
    ],
)
def test_suite_errors_are_one_line(folder, fields, options, said):
    with pytest.raises(ConfigError, match=said):
        load_suite(write_suite(folder, **fields), **options)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Mistyped", "AttributeError: 'Problem' object has no attribute 'v_tracking_'"),
        ("short", r"NumericalError: its velocity: shape \(3,\), expected \(6,\)"),
        ("nan", "NumericalError: its velocity: NaN or infinity"),
        ("now_and_then", "ValueError: not now"),
    ],
)
def test_entrant_from_file_failure_names_cause(folder, name, said):
    """A controller brakes where its law fails; the arena must not take that for what the law wants."""
    row = run_trial(make_case(load_family(folder / "post.yaml"), 0), entrant_from_file(folder / "laws.py", name))
    assert re.search(said, row.failure)
    if name == "now_and_then":
        assert 0.0 < row.failed < 1.0 and row.path_length > 0.0
    else:
        assert row.failed == row.stopped == 1.0 and not row.success


# --- sweeps ------------------------------------------------------------------------------------------------------


def test_sweep_goes_on_where_it_ended(folder):
    path, out = write_suite(folder, ["tracking", "laws.py:Halved", "laws.py:Still"], seeds=1), folder / "out"
    suite, reports = load_suite(path), []
    assert swept(suite, out, tell=reports.append) == ("runs", 3, 3, 0, 0)
    assert [(t.stage, t.done) for t in reports] == [("cases", 0), ("cases", 1), *(("runs", n) for n in range(4))]
    before = rows_in(folder)
    assert swept(suite, out).done == 0 and rows_in(folder) == before
    (folder / "laws.py").write_text(LAWS + "# another one\n")
    more = load_suite(path, ["tracking", "eq10", f"{folder}/laws.py:Halved"], seeds=2)
    assert swept(more, out).done == 5  # all three in the new case, and two that are new in the old one
    assert rows_in(folder)[:3] == before and len({tuple(row[name] for name in KEY) for row in rows_in(folder)}) == 8
    facts = read_facts(out)
    assert [entry["name"] for entry in facts["entrants"].values()] == ["tracking", "Halved", "Still", "eq10", "Halved"]
    assert facts["versions"]["qpavoid"] and facts["machine"]["cpu"]


def test_sweep_in_processes(folder):
    """Entrants of every kind run from text that was sent; what ends its process has failed, and is not lost."""
    own = [f"laws.py:{name}" for name in ("Halved", "solution", "velocity", "pilot", "Picky", "Deadly")]
    suite = load_suite(write_suite(folder, ["tracking", "qp", *own], seeds=1))
    with Workers(1) as workers:
        assert swept(suite, folder / "out", workers)[1:] == (8, 8, 0, 0)
    assert not plan_of(suite, folder / "out").runs
    runs = {row["entrant"]: row for row in rows_in(folder)}
    timed = {"tick_p50", "tick_p99", "tick_max", "seconds"}
    case = make_case(load_family(folder / "post.yaml"), 0)
    for entrant in suite.entrants[:6]:
        alone, row = run_trial(case, entrant).row(), runs[entrant.name]
        for name in COLUMNS.keys() - timed:
            expected = pytest.approx(alone[name], rel=1e-9, abs=1e-9) if COLUMNS[name] == "float" else alone[name]
            assert row[name] == expected and row["failure"] == ""
    assert runs["solution"]["path_length"] == runs["velocity"]["path_length"] == runs["tracking"]["path_length"] > 0.0
    for name, said in {"Picky": "cannot be set up: RuntimeError: not with me", "Deadly": "crashed or too slow"}.items():
        row = runs[name]
        assert row["failed"] == row["stopped"] == row["time_to_goal"] == 1.0 and said in row["failure"]
        assert row["path_length"] == 0.0 and not row["success"] and not row["arrived"]


def test_a_case_that_hangs_is_ended():
    """A worker that exceeds the time limit ends, with its traceback, as one that crashes does."""
    code = (
        "import time; from qpavoid_bench.arena import sweep; sweep.TIME_LIMIT = 0.2\n"
        "sweep.load_family = lambda path: time.sleep(600)\nsweep._make_case('x', 'y', 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "Timeout" in done.stderr and "_make_case" in done.stderr


def test_sweep_continues_after_case_failure(folder):
    (post,) = POST["scenario"]["obstacles"]
    around = {**post, "motion": {"type": "fixed", "position": [0.0, 0.0, 0.5]}}  # the arm itself: no draw will do
    crowded = {**POST, "scenario": {**POST["scenario"], "obstacles": [post, {**around, "name": "around"}]}}
    (folder / "crowded.yaml").write_text(yaml.safe_dump(crowded))
    suite = load_suite(write_suite(folder, ["tracking"], seeds=1, families=["crowded.yaml", "post.yaml"]))
    assert swept(suite, folder / "out") == ("runs", 1, 1, 0, 1)
    (failure,) = read_failures(folder / "out")
    assert failure["family"] == "crowded" and failure["entrant"] is None and "crowded.yaml" in failure["failure"]
    assert [family for family, *_ in plan_of(suite, folder / "out").cases] == ["crowded"]
    assert [row["family"] for row in rows_in(folder)] == ["post"]


def until(true, seconds=300.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


@pytest.mark.slow
def test_sweep_on_a_cluster_survives_a_lost_worker(folder, tmp_path):
    """A cluster loses a worker half way, and in the end its scheduler."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": ENVIRONMENT, "cwd": tmp_path}

    def start(module, *words):
        processes.append(subprocess.Popen([sys.executable, "-m", module, *map(str, words)], **quiet))
        return processes[-1]

    processes, file = [], tmp_path / "scheduler.json"
    suite = load_suite(write_suite(folder, ["tracking", "laws.py:Slow"], seeds=6))
    try:
        local = ("--host", "127.0.0.1", "--port", 0, "--no-dashboard")
        scheduler = start("distributed.cli.dask_scheduler", *local, "--scheduler-file", file)
        until(file.exists)
        address = json.loads(file.read_text())["address"]
        options = ("--nthreads", 1, "--no-nanny", "--no-dashboard")
        lost, _ = (start("distributed.cli.dask_worker", address, *options) for _ in range(2))
        with ClusterWorkers(address) as workers:
            until(lambda: len(workers) == 2)
            kill = lambda tally: lost.kill() if tally[:2] == ("runs", 4) else None  # noqa: E731
            assert swept(suite, folder / "out", workers, kill)[1:3] == (12, 12)
            assert len(workers) == 1
        rows = rows_in(folder)
        assert len({(row["case"], row["entrant"]) for row in rows}) == len(rows) == 12
        assert not any(row["failed"] for row in rows)
        longer = load_suite(folder / "mine.yaml", seeds=30)
        with ClusterWorkers(address) as workers, pytest.raises(ClusterLost):
            swept(longer, folder / "out", workers, lambda tally: scheduler.kill() if tally.stage == "cases" else None)
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_killed_then_interrupted_then_finished(folder):
    def bench():
        """`qpavoid bench run` of the suite, in a process group of its own."""
        command = [sys.executable, "-m", "qpavoid", "bench", "run", "mine.yaml", "--out", "out", "--jobs", "2"]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, start_new_session=True, **pipes)

    def seeds():
        with suppress(ConfigError):  # there are no results yet
            return read_runs(folder / "out")["seed"].to_list()
        return []

    write_suite(folder, ["laws.py:Slow"], seeds=24)
    first = bench()
    try:
        until(lambda: len(seeds()) >= 3)
    finally:
        first.kill()
    first.communicate()
    kept, made = seeds(), len(read_cases(folder / "out"))
    assert 3 <= len(kept) < 24 and made == 24

    second = bench()
    until(lambda: len(seeds()) >= len(kept) + 3)
    os.killpg(second.pid, signal.SIGINT)  # as a terminal does at Ctrl-C: to the workers as well
    printed, said = second.communicate(timeout=300)
    assert second.returncode == 1 and printed == ""
    assert "interrupted: " in said and "the same command goes on" in said and "Traceback" not in said
    more = seeds()
    assert more[: len(kept)] == kept and len(kept) + 3 <= len(more) < 24

    third = bench()
    printed, said = third.communicate(timeout=300)
    assert third.returncode == 0 and f"24 runs, {24 - len(more)} of them new" in printed
    assert sorted(seeds()) == list(range(24))


# --- the commands ------------------------------------------------------------------------------------------------


def test_bench_run_show_and_resume(cli, folder, monkeypatch):
    """Run then show then nothing left to do."""
    write_suite(folder, ["tracking", {"name": "wide", "solver": "qp", "avoidance": {"d2": 0.3}}], seeds=2)
    with monkeypatch.context() as patch:
        patch.setattr("qpavoid.run.pool.Workers", InProcess)
        first = cli("bench", "run", "mine.yaml", "--json", "--jobs", "1")
    assert first.status == 0
    document = json.loads(first.stdout)
    assert document["runs"] == document["new"] == 4 and document["failed"] == 0
    assert [entry["entrant"] for entry in document["entrants"]] == ["tracking", "wide"]
    with Store(Path("out/bench/mine")) as store:  # of an earlier sweep, which asked for more
        store.fail({"family": "shelf", "seed": 0, "entrant": None, "failure": "no plan"})
    with monkeypatch.context() as patch:
        patch.setattr("qpavoid.run.pool.Workers", None)  # no process is started for it
        rerun = cli("bench", "run", "mine.yaml")
    assert not rerun.lines
    assert rerun.status == 0 and "4 runs, 0 of them new" in rerun.stdout and "tracking" in rerun.stdout
    out = Path("out/bench/mine")
    shown = cli(
        "bench", "show", out, "--family", "post", "--seed", 1, "--entrant", "wide", "--scenario", "case.yaml", "--json"
    )
    assert shown.status == 0
    run = json.loads(shown.stdout)["run"]
    (row,) = [row for row in read_runs(out).to_dict("records") if row["entrant"] == "wide" and row["seed"] == 1]
    assert all(run[name] == row[name] for name in (*KEY, "success", "collided", "contacts"))
    assert cli("run", "case.yaml", "--no-figures").status in (0, 1)
    lines = cli("bench", "show", out, "--family", "post", "--seed", 1, "--entrant", "wide").stdout.splitlines()
    assert {line.split()[0] for line in lines} == {"solved_by", *COLUMNS}
    assert cli("bench", "show", out, "--family", "post", "--seed", 7, "--json").lines == [
        f"error: {out}: post has no seed 7; there are 2 from 0 to 1"
    ]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "smok"], "unknown suite 'smok'; did you mean 'smoke'?"),
        (["run", "smoke", "--solvers", ","], "--solvers: names none"),
        (["run", "smoke", "--jobs", "2", "--cluster", "tcp://127.0.0.1:1"], "leave one of --jobs and --cluster out"),
        (["run", "smoke", "--cluster", "tcp://127.0.0.1:1", "--out", "o"], "no scheduler answers: .*start one with"),
        (["run", "smoke", "--cluster", "nonsense://x", "--out", "o"], "no scheduler answers: .*start one with"),
        (["show", "nowhere", "--family", "post", "--seed", "1"], "nowhere: no results here"),
        (["run", "smoke", "--entrant", "my_law.py"], r"my_law\.py: give FILE\.py:NAME"),
    ],
)
def test_bad_input_is_a_line_and_exit_status_2(cli, monkeypatch, words, said):
    monkeypatch.setattr("qpavoid.run.pool.CONNECT_TIMEOUT", 0.5)
    result = cli("bench", *words)
    lines = [line for line in result.lines if "does not take part" not in line]
    assert result.status == 2 and len(lines) == 1
    assert re.search(said, lines[0])


def test_bench_without_extra_names_remedy(cli, monkeypatch):
    """Without the extra the bench says what to install."""
    monkeypatch.setattr(commands, "find_spec", lambda name: None if name in ("pandas", "distributed") else True)
    result = cli("bench", "list")
    assert result.status == 2
    assert result.lines == ["error: qpavoid bench needs distributed, pandas: pip install 'qpavoid[arena]'"]


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
    return suite, [row for row in rows if row["family"]], cases


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
    faults = list(find_faults(suite, pd.DataFrame(rows), cases))
    assert len(faults) == len(said) and all(fault.startswith(start) for fault, start in zip(faults, said, strict=True))


def test_summary_by_hand():
    values = [("b", 0, 0.0, 3.0), ("a", 1, 0.5, 2.0), ("b", 1, 0.1, 1.0), ("b", 1, 0.2, 5.0)]
    rows = [
        row_of(entrant=name, success=bool(won), failed=failed, tick_p50=x, min_distance=-x, failure=f"said at {x}")
        for name, won, failed, x in values
    ]
    b, a = summary(pd.DataFrame(rows))
    expected = {"entrant": "b", "runs": 3, "success": 2 / 3, "collided": 0.0, "min_distance": -5.0, "failed": 2}
    assert b == {**expected, "tick_p50": 3.0, "failure": "said at 1.0"} and a["entrant"] == "a" and a["failed"] == 1
    assert summary(pd.DataFrame(columns=list(COLUMNS))) == []
