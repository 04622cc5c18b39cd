"""docs/arena.md, followed: its suite runs and goes on as it says, its snippets run, its options exist."""

import re
import shlex
from pathlib import Path

import pytest
from in_process import InProcess

pytest.importorskip("distributed")
pytest.importorskip("mujoco")

from qpavoid.config.shipped import shipped_names
from qpavoid_bench.arena.store import read_runs

DOCS = Path(__file__).parent.parent / "docs"
PAGE = (DOCS / "arena.md").read_text(encoding="utf-8")


def blocks(page, kind):
    return re.findall(rf"```{kind}\n(.*?)```", page, re.S)


@pytest.fixture
def folder(tmp_path):
    """Where everything lies that the page speaks of."""
    (suite,), (snippet, law) = blocks(PAGE, "yaml"), blocks(PAGE, "python")
    (tmp_path / "suite.yaml").write_text(suite)
    (tmp_path / "my_law.py").write_text(law)
    (tmp_path / "post.yaml").write_text(blocks((DOCS / "arena_families.md").read_text(encoding="utf-8"), "yaml")[0])
    (tmp_path / "snippet.py").write_text(snippet)
    return tmp_path


def test_page_sweeps_output(cli, folder, capfd, monkeypatch):
    """Sweeps of the page print what it says."""
    monkeypatch.setattr("qpavoid.run.pool.Workers", InProcess)
    said = [line for block in blocks(PAGE, "console") for line in block.splitlines()]
    for command, printed in zip(said, [*said[2:], "", ""], strict=False):
        if not command.startswith("$ qpavoid bench run suite.yaml"):
            continue
        done = cli(*shlex.split(command.removeprefix("$ qpavoid ")))
        assert done.status == 0
        assert done.stdout.splitlines()[-1] == printed, command
    assert len(read_runs(Path("out/bench/suite"))) == 15
    exec(compile((folder / "snippet.py").read_text(), "arena.md", "exec"), {})
    *means, case = capfd.readouterr().out.splitlines()
    assert [line.split()[0] for line in means[2:]] == ["Slow", "qp", "qp-wide", "tracking"]
    assert re.match(r"post \d 8.0 RRT-Connect", case)
    (show,) = [line for line in said if line.startswith("$ qpavoid bench show")]
    assert cli(*shlex.split(show.removeprefix("$ qpavoid "))).status == 0
    assert (folder / "case.yaml").exists()


def test_every_command_option_and_suite_of_the_page_exists(cli):
    commands = re.findall(r"^\$ qpavoid bench (\w+)", PAGE, re.M)
    shown = {command: cli("bench", command, "--help").stdout for command in set(commands)}
    for line in re.findall(r"^\$ qpavoid bench (.*?)(?: +#.*)?$", PAGE, re.M):
        command, *words = line.split()
        assert all(word in shown[command] for word in words if word.startswith("--")), line
        assert command != "run" or words[0] in [*shipped_names("suite"), "suite.yaml"]
    table = re.findall(r"^\| `(--[a-z]+)", PAGE, re.M)
    assert set(table) == set(re.findall(r"--[a-z]+", shown["run"])) - {"--help"}
