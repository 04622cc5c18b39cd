"""`qpavoid serve` as a process: the clients of examples/service, and a robot that stands when the server ends."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from qpavoid_bench.arena.commands import app

msgpack, zmq = pytest.importorskip("msgpack"), pytest.importorskip("zmq")

CLIENTS = Path(__file__).parent.parent / "examples" / "service"


@pytest.fixture
def server():
    """Runs `qpavoid serve panda_ball`; gives the process and the addresses of requests and of commands."""
    command = [sys.executable, "-m", "qpavoid", "serve", "panda_ball", "--port", "0", "--heartbeat", "2"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        words = process.stdout.readline().replace(",", " ").split()
        yield process, words[words.index("steps:") + 1], words[words.index("commands:") + 1]
        process.terminate()
        assert process.wait(60) == 0


def run(command):
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


def test_python_client(server):
    done = run([sys.executable, str(CLIENTS / "client.py"), server[1]])
    assert done.returncode == 0 and "SOLVED" in done.stdout, done.stderr


def test_cpp_client(server, tmp_path):
    compiler = shutil.which("g++")
    headers = all(any((Path(p) / name).exists() for p in ("/usr/include", "/usr/local/include"))
                  for name in ("zmq.hpp", "nlohmann/json.hpp"))  # fmt: skip
    if not (compiler and headers):
        assert "QPAVOID_REQUIRE_CPP" not in os.environ
        pytest.skip("no g++, or no cppzmq-dev and nlohmann-json3-dev")
    client = tmp_path / "client"
    built = run([compiler, "-std=c++17", "-O1", str(CLIENTS / "client.cpp"), "-lzmq", "-o", str(client)])
    assert built.returncode == 0, built.stderr
    done = run([str(client), server[1]])
    assert done.returncode == 0 and "SOLVED" in done.stdout, done.stderr


def test_clients_are_short():
    assert len((CLIENTS / "client.py").read_text().splitlines()) <= 35
    assert len((CLIENTS / "client.cpp").read_text().splitlines()) <= 40


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_server_stops_the_robot_before_it_ends(server, number):
    """Asked to end while it moves: the last commands brake to zero, and say why."""
    process, requests, commands = server
    context = zmq.Context()
    ask, stream = context.socket(zmq.REQ), context.socket(zmq.SUB)
    stream.setsockopt(zmq.SUBSCRIBE, b"")
    stream.connect(commands)
    ask.connect(requests)

    def answer(**fields):
        ask.send(msgpack.packb({"version": 1, **fields}))
        return msgpack.unpackb(ask.recv())

    q = np.array(answer(type="hello")["q0"])
    for k in range(30):
        q = q + 0.01 * np.array(answer(type="step", q=q.tolist(), t=0.01 * k,
                                       targets={"panda_hand_tcp": {"position": [0.4, 0.5, 0.5]}})["v"])  # fmt: skip
    process.send_signal(number)
    assert process.wait(60) == 0
    received = []
    while stream.poll(500):
        received.append(msgpack.unpackb(stream.recv()))
    context.destroy(0)
    speeds = [np.abs(command["v"]).max() for command in received]
    assert max(speeds) > 0.1 and speeds[-1] == 0.0
    assert received[-1]["reasons"][0]["kind"] == "SERVER_ENDS"


def test_bench_serve_prints_percentiles(tmp_path):
    result = CliRunner().invoke(app, ["serve", "--steps", "20", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    rows = [line for line in (tmp_path / "serve.md").read_text().splitlines() if line.startswith(("| hello", "| step"))]
    assert len(rows) == 4
    for row in rows:
        p50, p99, worst = map(float, row.split("|")[3:6])
        assert 0.0 < p50 <= p99 <= worst


def test_serve_without_its_packages_says_what_to_install(cli, monkeypatch):
    monkeypatch.setitem(sys.modules, "qpavoid.service.server", None)
    monkeypatch.setitem(sys.modules, "zmq", None)
    monkeypatch.delitem(sys.modules, "qpavoid.service.server")
    result = cli("serve", "panda_ball")
    assert result.status == 2 and "pip install 'qpavoid[serve]'" in result.stderr
