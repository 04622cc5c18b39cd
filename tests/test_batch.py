"""What comes out of many processes is what comes out of one, in order, whatever happens to some of them."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from qpavoid import ConfigError, Controller, NumericalError, SolverNotInstalled, UnknownName, load_scenario
from qpavoid.run.batch import BatchError, simulate_many, steps
from qpavoid.run.log import STATUSES
from qpavoid.run.pool import ClusterWorkers, WorkerDied, Workers
from qpavoid.run.simulate import simulate

DIE = "__import__('os')._exit(3)"


@pytest.fixture(scope="module")
def workers():
    with Workers(2) as workers:
        yield workers


def situation(*overrides, solver=None):
    return load_scenario("situation1", ["duration=0.2", *overrides], solver)


class Deadly:
    """Ends the process that unpickles it."""

    def __reduce__(self):
        return os._exit, (1,)


# --- simulate_many ---------------------------------------------------------------------------------------------


def test_logs_are_those_of_single_runs_in_order(workers):
    scenarios = [
        situation("duration=0.5"),
        situation(solver="eq10"),
        situation("duration=0.1"),
        situation("avoidance.d2=0.4"),
    ]
    seen = []
    logs = simulate_many(scenarios, workers, lambda done, total: seen.append((done, total)))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    for scenario, log in zip(scenarios, logs, strict=True):
        alone = simulate(scenario)
        assert log.meta == alone.meta
        for name in ("t", "q", "v", "status", "body_distance", "slack"):
            np.testing.assert_array_equal(getattr(log, name), getattr(alone, name))


def test_failing_scenarios_do_not_lose_the_others(workers):
    good = situation()
    bad = good.model_copy(update={"robot": "no_such_robot"})
    with pytest.raises(
        BatchError, match=r"(?s)2 of 4 scenarios.*1: UnknownName: .*no_such_robot.*3: ConfigError: .*none\.yaml"
    ) as error:
        simulate_many([good, bad, good, "./none.yaml"], workers)
    first, none, second, also_none = error.value.logs
    assert none is None
    assert also_none is None
    assert first.meta["completed"]
    np.testing.assert_array_equal(first.v, second.v)
    assert [type(e) for e in error.value.errors.values()] == [UnknownName, ConfigError]


def test_dead_process_takes_one_scenario_with_it(workers):
    good = situation()
    with pytest.raises(BatchError) as error:
        simulate_many([good, Deadly(), good, good, Deadly(), good], workers)
    assert list(error.value.errors) == [1, 4]
    assert all(isinstance(e, WorkerDied) for e in error.value.errors.values())
    assert [log is None for log in error.value.logs] == [False, True, False, False, True, False]


# --- steps -----------------------------------------------------------------------------------------------------


def test_steps_are_those_of_a_controller(workers):
    """At different times: the obstacles of the scenario move."""
    scenario = load_scenario("panda_line")
    controller, q0 = Controller.from_scenario(scenario)
    random = np.random.default_rng(0)
    q, t = q0 + random.uniform(-0.5, 0.5, (101, len(q0))), random.uniform(0.0, 6.0, 101)
    v, status = steps(scenario, q, t, workers)
    alone = [controller.reset() or controller.step(*state) for state in zip(q, t, strict=True)]
    np.testing.assert_allclose(v, [solution.v for solution in alone], atol=1e-9)
    assert [STATUSES[code] for code in status] == [solution.status for solution in alone]
    assert np.abs(steps(scenario, q, 0.0, workers).v - v).max() > 1e-3  # time counts
    one_time = steps("panda_line", q[:1], t[0], workers)
    np.testing.assert_allclose(one_time.v, v[:1], atol=1e-9)


def test_steps_refuse_bad_input(workers):
    scenario = situation()
    nq = len(Controller.from_scenario(scenario)[1])
    q = np.zeros((3, nq))
    q[2, 1] = np.nan
    with pytest.raises(NumericalError, match="q: NaN or infinity at index 2, 1"):
        steps(scenario, q, 0.0, workers)
    with pytest.raises(NumericalError, match="expected"):
        steps(scenario, np.zeros((3, nq + 1)), 0.0, workers)
    with pytest.raises(NumericalError, match=r"t: shape \(2,\), expected \(3,\)"):
        steps(scenario, np.zeros((3, nq)), np.zeros(2), workers)
    with pytest.raises((SolverNotInstalled, UnknownName)):
        steps(situation(solver="qp:nothing"), np.zeros((3, nq)), 0.0, workers)


# --- Workers ---------------------------------------------------------------------------------------------------


def test_answers_and_errors_come_in_order(workers):
    answers = workers.map(eval, [("1 + 1",), (DIE,), ("1 / 0",), ("'three'",), (DIE,), ("4",)])
    assert [type(a) for a in answers] == [int, WorkerDied, ZeroDivisionError, str, WorkerDied, int]
    assert (answers[0], answers[3], answers[5]) == (2, "three", 4)


def test_killed_while_idle(workers):
    """Both processes are replaced, no call is lost, and nothing hangs."""
    for pid in set(workers.map(eval, [("__import__('time').sleep(0.2) or __import__('os').getpid()",)] * 2)):
        os.kill(pid, signal.SIGKILL)
    assert workers.map(int, [()] * 6) == [0] * 6


def test_a_cluster_gives_the_same_answers():
    """In one process, whose calls are done by threads: the code is that of many."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as cluster,
        ClusterWorkers(cluster.scheduler_address) as workers,
    ):
        answers = workers.map(eval, [("1 + 1",), ("1 / 0",), ("'three'",)])
    assert [type(a) for a in answers] == [int, ZeroDivisionError, str]
    with pytest.raises(ConfigError, match="no scheduler answers"):
        ClusterWorkers("nothing://here")


def test_processes_have_one_thread_and_this_one_is_left_alone(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    before = dict(os.environ)
    with Workers(1) as workers:
        threads = workers.map(os.getenv, [("OMP_NUM_THREADS",), ("OPENBLAS_NUM_THREADS",)])
    assert threads == ["1", "1"]
    assert dict(os.environ) == before
    with pytest.raises(ValueError, match="closed"):
        workers.map(int, [()])
    with pytest.raises(ValueError, match="at least one"):
        Workers(0)


def test_script_without_main_guard_names_remedy(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("from qpavoid.run.batch import simulate_many\nsimulate_many(['situation1'] * 50, jobs=1)\n")
    run = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300, check=False)
    assert run.returncode != 0
    assert "WorkerDied" in run.stderr
    assert 'if __name__ == "__main__":' in run.stderr.splitlines()[-1]


def test_interrupt_does_not_wait_for_a_call_that_began_meanwhile(tmp_path):
    """The next call begins as soon as one is done, whenever the interrupt of that is raised."""
    done = tmp_path / "done"
    long = f"__import__('time').sleep(100) or open({str(done)!r}, 'w')"

    def interrupt(*_):
        raise KeyboardInterrupt

    with Workers(1) as workers:
        with pytest.raises(KeyboardInterrupt):
            workers.map(eval, [("1",), (long,), (long,)], interrupt)
        assert not done.exists()
        assert workers.map(int, [()] * 4) == [0] * 4


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="process groups")
def test_interrupt_ends_the_batch(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from qpavoid import load_scenario\n"
        "from qpavoid.run.batch import simulate_many\n"
        "from qpavoid.run.pool import Workers\n"
        "if __name__ == '__main__':\n"
        "    with Workers(1) as workers:\n"
        "        print('started', flush=True)\n"
        "        simulate_many([load_scenario('situation1', ['duration=2000'])] * 50, workers)\n"
    )
    with subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # tests in the background may have it ignored
    ) as run:  # fmt: skip
        assert run.stdout.readline() == "started\n"
        time.sleep(0.3)
        os.killpg(run.pid, signal.SIGINT)
        assert "KeyboardInterrupt" in run.communicate(timeout=300)[1]
    assert run.returncode != 0
