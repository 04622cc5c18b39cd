"""The documentation as a whole: every page has its place, every public name is described, every named test exists."""

import posixpath
import re
from pathlib import Path

import pytest
import yaml

import qpavoid

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
LINK = re.compile(r"\[([^\]]*)\]\(([^)#\s:]+)(?:#[^)\s]*)?\)")


def linked_tests(page):
    """(name, test file) of each link of a page to a test."""
    for name, path in LINK.findall(page.read_text(encoding="utf-8")):
        if re.fullmatch(r"(?:\.\./)?tests/test_\w+\.py", path):
            yield name, (page.parent / path).resolve()


def test_every_page_has_its_place_in_the_navigation():
    text = re.sub(r"!!python\S+", "", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    named = set(re.findall(r"[\w/]+\.md", str(yaml.safe_load(text)["nav"])))
    assert {name for name in named if "/" not in name} == {page.name for page in PAGES}


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=lambda page: page.stem)
def test_links_of_a_page_lead_to_files(page):
    for _, path in LINK.findall(page.read_text(encoding="utf-8")):
        assert (page.parent / posixpath.normpath(path)).exists(), path


def test_every_public_name_is_on_the_page_of_names_once():
    names = re.findall(r"^::: qpavoid\.(\w+)$", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.M)
    assert sorted(names) == sorted(qpavoid.__all__)


def test_tests_that_pages_name_exist():
    for page in [*PAGES, ROOT / "README.md"]:
        for name, file in linked_tests(page):
            defined = re.findall(r"^def (test_\w+)", file.read_text(encoding="utf-8"), re.M)
            assert name in {*defined, file.stem, f"tests/{file.name}"}, f"{page.name}: {name} in {file.name}"


def test_every_guarantee_names_a_test_function():
    page = ROOT / "docs" / "guarantees.md"
    rows = [
        line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("| ") and "| [test_" in line
    ]
    stems = {file.stem for _, file in linked_tests(page)}
    assert len(rows) > 10
    assert not any(name in stems for row in rows for name in re.findall(r"\[(test_\w+)\]", row))
