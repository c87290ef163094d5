"""Keeping folders, and with them user names, out of texts that are recorded."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

_LETTER: Final = r"""[^\s/'"<>|,;:()\[\]{}\\]"""
# An absolute path of at least two parts that does not continue a word, a relative path or a URL.
_PATH: Final = re.compile(
    rf"(?<![\w.:/~*?\\-]) (?:file://)? / (?:{_LETTER}+/)+ (?P<last>{_LETTER}*)", re.VERBOSE
)


def without_folders(text: str, folders: Sequence[Path] = ()) -> str:
    """Reduce absolute paths in a text to their last part.

    Args:
        text: a log, a message, an option as it was typed.
        folders: folders to take out literally first, for names with spaces, which no pattern
            finds the end of; the home and the working directory are always among them.

    >>> without_folders("cannot read /home/jane/scans/hall.e57: 1/2 of it is missing")
    'cannot read hall.e57: 1/2 of it is missing'
    """
    for folder in sorted({*map(str, folders), *_own_folders()}, key=len, reverse=True):
        if len(folder) > 1:
            text = text.replace(f"{folder}/", "")
    return _PATH.sub(lambda match: match["last"], text)


def _own_folders() -> set[str]:
    folders = {str(Path.cwd())}
    try:
        folders.add(str(Path.home()))
    except RuntimeError:
        # No home directory is known, so no text can name it.
        return folders
    return folders
