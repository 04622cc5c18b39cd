"""The page "Real robots": its loop runs, and keeps the tool where it is until the ball is near."""

import re
from pathlib import Path

import numpy as np

PAGE = (Path(__file__).parent.parent / "docs" / "real_robots.md").read_text(encoding="utf-8")


def test_loop_of_the_page_runs():
    (snippet,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    names = {}
    exec(compile(snippet, "real_robots.md", "exec"), names)
    assert (np.abs(names["v"]) <= names["robot"].bounds().velocity + 1e-9).all()
    assert 0.01 < np.abs(names["q"] - names["robot"].home).max() < 1.0
