"""The page "Your own robot in five minutes", followed word by word."""

import re
import shlex
from pathlib import Path

import pytest

PAGE = (Path(__file__).parent.parent / "docs" / "your_own_robot.md").read_text(encoding="utf-8")


def blocks(kind):
    return re.findall(rf"```{kind}\n(.*?)```", PAGE, re.S)


def figures(table):
    """Figures of each solver in a table of runs, but for the time of a step."""
    lines = re.findall(r"^ (tracking|qp) +(.*)$", table, re.M)
    return {solver: [float(number) for number in re.findall(r"-?\d+\.\d+", line)[:6]] for solver, line in lines}


@pytest.mark.slow
def test_robot_page_output_is_that_of_its_commands(cli, tmp_path, capfd):
    """But for digits of all that are no figures of runs, and for what an ellipsis stands for."""
    (scenario,), digits = blocks("yaml"), re.compile(r"\d+(?:\.\d+)?")
    (tmp_path / "reach.yaml").write_text(scenario)
    for block in blocks("console"):
        command, *said = block.splitlines()
        printed = cli(*shlex.split(command.removeprefix("$ qpavoid ")))
        assert printed.status == 0
        lines = "\n".join(re.sub(" +", " ", digits.sub("0", line.rstrip())) for line in printed.stdout.splitlines())
        wanted = [re.escape(re.sub(" +", " ", digits.sub("0", line))) for line in said]
        pattern = "\n".join("(?:.*\n)*?.*" if line == "…" else line.replace("…", ".*") for line in wanted)
        assert re.fullmatch(pattern, lines), f"{command} printed\n{printed.stdout}"
        if " compare " in command:
            assert figures(block).keys() == figures(printed.stdout).keys() == {"tracking", "qp"}
            for solver, shown in figures(block).items():
                assert shown == pytest.approx(figures(printed.stdout)[solver], rel=0.02, abs=0.02), printed.stdout
    (snippet,) = blocks("python")
    exec(compile(snippet, "your_own_robot.md", "exec"), {})
    assert "SOLVED" in capfd.readouterr().out


def test_robot_page_options_exist(cli):
    shown = cli("robot", "add", "--help").stdout + cli("robot", "check", "--help").stdout
    for option in set(re.findall(r"--[a-z-]+", PAGE)) - {"--solvers", "--no-figures", "--verbose"}:
        assert option in shown
