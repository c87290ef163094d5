"""Finding and reading a workflow's text."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from orthoflow.errors import WorkflowError, did_you_mean
from orthoflow.untrusted_text import open_file

#: bytes of a workflow file
MOST_BYTES: Final = 400_000
_INSTALLED: Final = Path(__file__).parent / "shipped"
_CHECKOUT: Final = Path(__file__).parents[2] / "workflows"


def shipped_workflows() -> dict[str, Path]:
    """Return all shipped recipes by name, e.g. `direct` -> .../direct.yaml."""
    folder = _INSTALLED if _INSTALLED.is_dir() else _CHECKOUT
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def shipped_workflow(name: str) -> Path:
    """Return the shipped recipe of a name: `direct`, `direct.yaml` or `workflows/direct.yaml`.

    Raises:
        WorkflowError: there is none.
    """
    recipes = shipped_workflows()
    wanted = Path(name)
    stem = wanted.name.removesuffix(".yaml")
    if wanted.parent in (Path(), Path("workflows")) and stem in recipes:
        return recipes[stem]
    raise WorkflowError(
        f"there is no workflow file {name} and no shipped workflow of that name"
        f"{did_you_mean(stem, recipes)}; shipped: {', '.join(recipes)}"
    )


def find_workflow(name_or_path: str | Path) -> Path:
    """Return an existing file, else the shipped recipe of that name.

    Raises:
        WorkflowError: there is neither.
    """
    path = Path(name_or_path)
    if path.is_file():
        return path
    if path.exists() and (path.parent != Path() or path.stem not in shipped_workflows()):
        raise WorkflowError(f"{path} is a folder or a device; give a workflow file")
    return shipped_workflow(str(name_or_path))


def read_text(path: Path, what: str = "a workflow file", most_bytes: int = MOST_BYTES) -> str:
    """Read a text file of bounded size.

    Raises:
        WorkflowError: it cannot be read, is too large, or is not UTF-8.
    """
    try:
        # No more than needed: a file named by mistake may be a scan.
        with open_file(path) as stream:
            content = stream.read(most_bytes + 1)
    except OSError as error:
        raise WorkflowError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) > most_bytes:
        raise WorkflowError(f"{path} is too large: {what} has at most {most_bytes} bytes")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        column = error.start - content.rfind(b"\n", 0, error.start)
        raise WorkflowError(
            f"{path}:{line}:{column}: expected UTF-8 text, got the byte "
            f"0x{content[error.start]:02x}; save the file as UTF-8"
        ) from error
