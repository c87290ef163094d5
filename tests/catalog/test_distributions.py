"""Where the code of a module lies, without importing it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from orthoflow.catalog.distributions import package_path


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the import path with a package, a module and a namespace package."""
    for name in ("regular", "regular/inner", "spaced/part"):
        (tmp_path / name).mkdir(parents=True)
    trap = "raise AssertionError('imported')\n"
    for name in ("regular/__init__", "regular/inner/__init__", "alone", "spaced/part/__init__"):
        (tmp_path / f"{name}.py").write_text(trap)
    (tmp_path / "spaced" / "single.py").write_text(trap)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path.resolve()


@pytest.mark.parametrize(
    ("module", "place"),
    [
        ("regular", "regular"),
        ("regular.inner.hooks", "regular"),
        ("alone", "alone.py"),
        ("spaced.part", "spaced/part"),
        ("spaced.part.hooks", "spaced/part"),
        ("spaced.single", "spaced/single.py"),
    ],
)
def test_the_outermost_regular_package_is_found_and_not_imported(
    folder: Path, module: str, place: str
) -> None:
    assert package_path(module) == folder / place
    assert not {"regular", "alone", "spaced.part", "spaced.single"} & sys.modules.keys()


@pytest.mark.parametrize("module", ["nowhere_to_be_found", "spaced", "spaced.missing", "", ".x"])
def test_what_has_no_code_has_no_place(folder: Path, module: str) -> None:
    assert package_path(module) is None


def test_modules_built_into_python_have_no_place() -> None:
    assert package_path("sys") is None
