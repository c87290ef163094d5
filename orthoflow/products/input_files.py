"""The files that a source reads: a workflow's inputs as its steps see them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar


@dataclass(frozen=True, kw_only=True)
class InputFiles:
    """Files of one workflow input, sorted by name; not stored, identified by name and content.

    Attributes:
        name: name of the input in the workflow.
        paths: existing files, read-only for methods.
    """

    type_name: ClassVar[str] = "files"

    name: str
    paths: tuple[Path, ...]
