"""The vocabulary of docs/glossary.md: words that it replaces occur nowhere else."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def lists():
    """Words that occur nowhere, and words that are no names in code: two lists, each after a line that says so."""
    texts = re.split(r"^# Names:.*$", (ROOT / "tests" / "banned_words.txt").read_text(encoding="utf-8"), flags=re.M)
    return [[line.strip() for line in text.splitlines() if line.strip() and line[0] != "#"] for text in texts]


WORDS, NAMES = lists()
PATTERN = re.compile(
    r"\b(" + "|".join(re.escape(word).replace(r"\ ", r"\s+") for word in WORDS) + r")\b", re.IGNORECASE
)
FOLDERS = ("qpavoid", "tests", "bench", "docs", "examples", "tasks", "robots")
LEFT_OUT = {"docs/glossary.md", "tests/banned_words.txt", "tests/test_banned_words.py"}


def texts():
    """Files that people write, and their text; measured results are as they were measured."""
    files = [
        path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".md", ".yaml")
    ]
    for path in [*files, *ROOT.glob("*.md"), ROOT / "Makefile", ROOT / "pyproject.toml"]:
        name = path.relative_to(ROOT).as_posix()
        if path.is_file() and name not in LEFT_OUT and not name.startswith("bench/results/"):
            yield name, path.read_text(encoding="utf-8")


def test_banned_words_occur_nowhere():
    found = [
        f"{name}:{text.count(chr(10), 0, match.start()) + 1}: {match[0]}"
        for name, text in texts()
        for match in PATTERN.finditer(text)
    ]
    assert not found, "\n".join(found)


def test_banned_words_are_in_the_glossary():
    """The glossary says what to write instead: the first letters of each word are there."""
    page = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8").lower()
    stems = {word: word.split()[0][:3] for word in WORDS}
    assert [word for word, stem in stems.items() if stem not in page] == []


def names_in(tree):
    """Line and name of all that a module gives a name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id if isinstance(node, ast.Name) else node.attr
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.lineno, node.name


def test_banned_names_are_no_names():
    files = [path for folder in ("qpavoid", "bench") for path in (ROOT / folder).rglob("*.py")]
    found = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in files
        for line, name in names_in(ast.parse(path.read_text(encoding="utf-8")))
        if name.strip("_").lower() in NAMES
    ]
    assert len(NAMES) > 10 and not found, "\n".join(found)
