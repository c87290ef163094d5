"""Workflows that come with orthoflow, and finding the one that a user names."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from orthoflow.catalog.wording import did_you_mean
from orthoflow.errors import WorkflowError

_INSTALLED: Final = Path(__file__).parent / "shipped"
_CHECKOUT: Final = Path(__file__).parents[2] / "workflows"


def shipped_workflows() -> dict[str, Path]:
    """Give all shipped recipes by name, e.g. `direct` -> .../direct.yaml."""
    folder = _INSTALLED if _INSTALLED.is_dir() else _CHECKOUT
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def shipped_workflow(name: str) -> Path:
    """Give the shipped recipe of a name: `direct`, `direct.yaml` or `workflows/direct.yaml`.

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
    """Give an existing file, else the shipped recipe of that name.

    Raises:
        WorkflowError: there is neither.
    """
    path = Path(name_or_path)
    if path.is_file():
        return path
    return shipped_workflow(str(name_or_path))
