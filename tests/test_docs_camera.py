"""The page on cameras: its loop runs, and gets pictures."""

import re
from pathlib import Path

PAGE = (Path(__file__).parent.parent / "docs" / "camera.md").read_text(encoding="utf-8")


def test_loop_of_the_page_runs():
    (snippet,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    names = {}
    exec(compile(snippet, "camera.md", "exec"), names)
    timing = names["timing"]
    assert (timing.submitted, timing.refused) == (9, 1)  # the first one was taken before the loop began
