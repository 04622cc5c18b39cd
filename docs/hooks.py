"""What the documentation site adds to these pages: files of the repository that they link to, and maths.

Pages link to tests, examples and results beside `docs`. The site has a copy of each, below `tree/`, so that no link
leads out of it. Maths is written to MathML when the site is built, and indices in prose (κ_c) as such: a browser draws
both.
"""

import posixpath
import re
from html import unescape
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"(\]\()([^)#\s:]+)((?:#[^)\s]*)?\))")
APART = re.compile(r"(<(pre|code|math|script|style|h\d)\b.*?</\2>|<[^>]+>)", re.DOTALL)
"""What is no prose: code, maths, headings, and tags themselves."""
INDEXED = re.compile(r"(?<![A-Za-z0-9_.])([A-Za-zα-ωΑ-Ωẋḋ]\u0307?)_([a-z0-9]{1,3})(?![a-z0-9_(])")
"""A symbol of one letter with an index, such as κ_c or J_p2."""
MATHS = re.compile(r'<(div|span) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
ALWAYS = ("CHANGELOG.md", "CONTRIBUTING.md", "NOTICE.md")
"""Files that the navigation names."""
NOT_FOUND = "---\nsearch:\n  exclude: true\n---\n\n"
"""Of pages that a search should not come up with."""


def place(path):
    """Where a file or folder of the repository is in the site."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"tree/{path}" if Path(path).suffix in (".md", ".png", ".gif", ".svg") else f"tree/{path}.md"


def linked(path, text):
    """Files and folders of the repository that a Markdown file links to."""
    links = (posixpath.normpath(posixpath.join(posixpath.dirname(path), match[2])) for match in LINK.finditer(text))
    return {link for link in links if not link.startswith("..") and (ROOT / link).exists()}


def content(path):
    """Text of a file in Markdown, or the names in a folder."""
    file = ROOT / path
    if file.is_dir():
        names = sorted(child.name for child in file.iterdir() if child.suffix in (".py", ".yaml", ".cpp", ".xml"))
        return f"{NOT_FOUND}# {path}\n\n" + "\n".join(f"- [{name}]({file.name}/{name})" for name in names) + "\n"
    if file.suffix == ".md":
        return file.read_text(encoding="utf-8")
    if file.suffix in (".png", ".gif", ".svg"):
        return file.read_bytes()
    language = {".py": "python", ".yaml": "yaml", ".cpp": "cpp", ".xml": "xml"}.get(file.suffix, "text")
    return f"{NOT_FOUND}# {path}\n\n````{language}\n{file.read_text(encoding='utf-8')}\n````\n"


def on_files(files, config):
    """Add the files outside `docs` that are linked to, and those that these link to."""
    pages = {f"docs/{file.src_uri}": Path(file.abs_src_path).read_text("utf-8") for file in files.documentation_pages()}
    waiting, known = set(ALWAYS).union(*(linked(path, text) for path, text in pages.items())), set()
    while waiting := {path for path in waiting - known if not path.startswith("docs/")}:
        path = waiting.pop()
        known.add(path)
        text = content(path)
        files.append(File.generated(config, place(path), content=text))
        if isinstance(text, str) and (path.endswith(".md") or (ROOT / path).is_dir()):
            waiting |= linked(path, text)
    return files


def on_page_markdown(markdown, page, config, files):
    """Point links to files of the repository at their copies."""
    uri = page.file.src_uri
    inside = uri.startswith("tree/")
    source = uri.removeprefix("tree/") if inside else f"docs/{uri}"
    if inside and not (ROOT / source).exists():
        source = source.removesuffix(".md")

    def moved(match):
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), match[2]))
        if path.startswith("..") or not (ROOT / path).exists():
            return match[0]
        return match[1] + posixpath.relpath(place(path), posixpath.dirname(uri) or ".") + match[3]

    return LINK.sub(moved, markdown)


def maths(match):
    """MathML of a formula; one in a line of its own can be scrolled where it is wide."""
    if match[1] == "div":
        return f'<div class="maths">{convert(unescape(match[2]), "block")}</div>'
    return convert(unescape(match[2]), "inline")


def on_page_content(html, page, config, files):
    """Write maths as MathML, and indices in prose as such."""
    html = MATHS.sub(maths, html)
    parts = APART.split(html)  # in turns: prose, a part that is none, the name of its tag
    parts[::3] = [INDEXED.sub(r"<i>\1</i><sub>\2</sub>", part) for part in parts[::3]]
    del parts[2::3]
    return "".join(parts)
