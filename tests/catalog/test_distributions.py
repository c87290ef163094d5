"""Where the code of a module lies, without importing it."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from orthoflow.catalog.distributions import (
    DistributionInfo,
    describe_distribution,
    package_path,
    required_distributions,
)


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
        *((nothing, None) for nothing in ("nowhere_to_be_found", "spaced", "spaced.missing", "")),
    ],
)
def test_the_outermost_regular_package_is_found_and_not_imported(
    folder: Path, module: str, place: str | None
) -> None:
    assert package_path(module) == (place if place is None else folder / place)
    assert not {"regular", "alone", "spaced.part", "spaced.single"} & sys.modules.keys()


@pytest.mark.parametrize(("module", "source"), [("regular.hooks", "regular"), ("alone", None)])
def test_an_entry_point_of_no_distribution_is_known_by_its_own_name(
    folder: Path, module: str, source: str | None
) -> None:
    assert describe_distribution(EntryPoint(name="mine", value=module, group="any")) == (
        DistributionInfo(
            name="mine",
            version="0",
            source_folder=None if source is None else folder / source,
        )
    )


def test_what_a_distribution_requires_is_followed(folder: Path) -> None:
    """Extras are left out; what is not installed has no requirements."""
    required = {
        "My.Plugin": ["one[Fast, x] >=2 ; python_version > '3'", 'docs; extra == "docs"'],
        "one": ["speed>=1 ; extra == 'fast'", "two"],
        "two": ["one", "gone"],
    }
    for name, texts in required.items():
        info = folder / f"{name}-1.dist-info"
        info.mkdir()
        lines = [f"Name: {name}", "Version: 1", *(f"Requires-Dist: {text}" for text in texts)]
        (info / "METADATA").write_text("\n".join(["Metadata-Version: 2.1", *lines]))
    found = required_distributions(frozenset({"my-plugin"}))
    assert found == {"my-plugin", "one", "two", "gone"}
    for unknown in ("gone", " ", "../x"):
        assert required_distributions(frozenset({"my-plugin", unknown})) is None
