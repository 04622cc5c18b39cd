"""The page on architecture: its folders and order of imports are those of the package."""

import re
from pathlib import Path

from test_import_order import LEVELS

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def test_architecture_page_has_the_order_of_imports():
    (line,) = re.findall(r"`(errors, reason.*? < .*?)`", PAGE, re.S)
    rooms = [tuple(level.split(", ")) for level in " ".join(line.split()).split(" < ")]
    assert rooms == list(LEVELS[:-1])


def test_architecture_page_names_files_that_exist():
    for name in re.findall(r"`((?:config|control|kernels|safety|solvers|model)/\w+(?:\.py|/)?)`", PAGE):
        path = ROOT / "qpavoid" / name
        assert path.exists() or path.with_suffix(".py").exists(), name
