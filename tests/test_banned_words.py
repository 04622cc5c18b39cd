"""The vocabulary of docs/glossary.md: words that it replaces occur nowhere else."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
WORDS = [
    line.strip()
    for line in (ROOT / "tests" / "banned_words.txt").read_text(encoding="utf-8").splitlines()
    if line.strip() and not line.startswith("#")
]
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
