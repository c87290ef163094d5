"""What failed when it was last tried, by key, so that `plan` says it before it fails again.

A memory below the store's folder, `failures/<key>.json`; disposable, and garbage to `cache gc`.
"""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.engine.checked_json import is_checked, with_digest
from orthoflow.engine.durability import read_whole, write_whole
from orthoflow.errors import StoreError
from orthoflow.foreign_text import parse_json
from orthoflow.sdk.lines import one_line

# A reason stands in one column of a table; the record of the run has the whole sentence.
_LONGEST_SENTENCE: Final = 400
_LARGEST_FILE: Final = 16 << 10


@dataclass(frozen=True)
class Failures:
    """The sentences with which cells failed.

    Attributes:
        folder: where they lie; made when something fails.
    """

    folder: Path

    @classmethod
    def of_store(cls, store_folder: Path) -> Failures:
        """Give those that a store keeps."""
        return cls(store_folder / "failures")

    def remember(self, key: str, sentence: str) -> None:
        """Keep the sentence of a cell that failed, if the disk lets us."""
        text = with_digest(json.dumps({"error": one_line(sentence, _LONGEST_SENTENCE)}))
        with contextlib.suppress(OSError, StoreError):
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(self._file(key), text.encode())

    def forget(self, key: str) -> None:
        """Take back what was remembered: the cell has a result now."""
        with contextlib.suppress(OSError):
            self._file(key).unlink()

    def sentence(self, key: str) -> str:
        """Say how the cell failed; empty when it did not, or when nobody knows any more."""
        try:
            text = read_whole(self._file(key), _LARGEST_FILE)
            content = parse_json(text) if is_checked(text) else None
        except (OSError, ValueError):
            return ""
        found = content.get("error") if isinstance(content, dict) else None
        return one_line(found, 2 * _LONGEST_SENTENCE) if isinstance(found, str) else ""

    def _file(self, key: str) -> Path:
        return self.folder / f"{key}.json"
