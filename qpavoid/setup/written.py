"""Files that are written again only if they were not edited.

Each carries the digest of its own content, so that an edit shows.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path

from qpavoid.errors import ConfigError

_DIGITS = 16
BLANK = "sha256 " + _DIGITS * "0"
"""Placeholder of the digest, which a file holds once."""
_SEAL = re.compile(rb"sha256 [0-9a-f]{%d}" % _DIGITS)


def seal(content: bytes) -> bytes:
    """Put the digest of a content in the place of its `BLANK`."""
    return content.replace(BLANK.encode(), b"sha256 " + sha256(content).hexdigest()[:_DIGITS].encode(), 1)


def is_sealed(content: bytes) -> bool:
    """Return True if a content is as `seal` left it."""
    return seal(_SEAL.sub(BLANK.encode(), content, count=1)) == content and _SEAL.search(content) is not None


def write_files(contents: Mapping[Path, bytes], force: bool = False) -> dict[Path, str]:
    """Write all files, or none.

    Args:
        contents: what each is to hold, sealed.
        force: overwrites files that somebody edited.

    Returns:
        For each file `written`, `unchanged` or `updated`.

    Raises:
        ConfigError: a file was edited since it was written, or was not written by it; or it cannot be written.
    """
    outcome = {}
    for path, content in contents.items():
        try:
            before = path.read_bytes()
        except FileNotFoundError:
            outcome[path] = "written"
            continue
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror}; give another folder with --out") from None
        if not (force or before == content or is_sealed(before)):
            raise ConfigError(
                f"{path}: edited since it was written, or written by hand: left as it is; --force overwrites it, "
                "--out DIR writes elsewhere"
            )
        outcome[path] = "unchanged" if before == content else "updated"
    for path, content in contents.items():
        if outcome[path] == "unchanged":
            continue
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror}; give a folder that can be written with --out") from None
    return outcome
