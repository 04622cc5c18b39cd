"""The page "Your own robot in five minutes", followed word by word."""

import re
import shlex
from pathlib import Path

PAGE = (Path(__file__).parent.parent / "docs" / "your_own_robot.md").read_text(encoding="utf-8")


def blocks(kind):
    return re.findall(rf"```{kind}\n(.*?)```", PAGE, re.S)


def test_page_output_equals_commands(cli, tmp_path, capfd):
    """The page prints what it says."""
    (scenario,) = blocks("yaml")
    (tmp_path / "reach.yaml").write_text(scenario)
    for block in blocks("console"):
        command, *said = block.splitlines()
        words = shlex.split(command.removeprefix("$ qpavoid "))
        printed = cli(*words)
        assert printed.status == 0
        lines = [line.rstrip() for line in printed.stdout.splitlines()]
        pattern = "\n".join(re.escape(line).replace("…", ".*" if line != "…" else "(?:.*\n)*?.*") for line in said)
        assert re.fullmatch(pattern, "\n".join(lines)), f"{command} printed\n{printed.stdout}"
    (snippet,) = blocks("python")
    exec(compile(snippet, "your_own_robot.md", "exec"), {})
    assert "SOLVED" in capfd.readouterr().out


def test_every_option_of_the_page_exists(cli):
    shown = cli("robot", "add", "--help").stdout + cli("robot", "check", "--help").stdout
    for option in set(re.findall(r"--[a-z-]+", PAGE)) - {"--solvers", "--no-figures", "--verbose"}:
        assert option in shown
