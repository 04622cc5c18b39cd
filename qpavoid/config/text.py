"""The text of a file that may be anything: a folder, a pipe, a device, an image of a disk."""

from __future__ import annotations

from pathlib import Path

from qpavoid.errors import ConfigError


def read_text(path: Path, largest: int, where: str = "") -> str:
    """Read a UTF-8 file, with or without a byte order mark.

    Args:
        path: the file.
        largest: size up to which it is read [bytes]; what comes after would hang or fill the memory.
        where: file and field to name in errors; the file if left out.

    Raises:
        ConfigError: no ordinary file, too large, or not text.
    """
    try:
        size = path.stat().st_size
        if path.is_dir():
            reason = "is a folder; give a file"
        elif not path.is_file():  # reading a pipe or a device may never end
            reason = "not an ordinary file; give one"
        elif size > largest:
            reason = f"{size} bytes; at most {largest} are read, make it smaller"
        else:
            text = path.read_text(encoding="utf-8-sig")
            if "\0" not in text:
                return text
            reason = "it holds NUL characters; give a text file"
    except OSError as error:
        reason = f"{error.strerror or error}; give another file"
    except ValueError as error:  # bytes that are no UTF-8, or a name that no file can have
        reason = f"{error}; give a UTF-8 text file"
    raise ConfigError(f"{where or path}: cannot be read: {reason}")
