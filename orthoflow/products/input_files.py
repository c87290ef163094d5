"""Input files of a workflow, as read by its steps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar


@dataclass(frozen=True, kw_only=True)
class InputFiles:
    """Files of one input of a workflow, sorted by name; they are identified by their content.

    Attributes:
        name: name of the input in the workflow.
        paths: existing files; methods must not change them.
    """

    type_name: ClassVar[str] = "files"

    name: str
    paths: tuple[Path, ...]
