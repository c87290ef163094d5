"""What exports of results say of what they wrote, and what of it was left out."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.cli.exports import results as module
from orthoflow.cli.exports.choices import Choices
from tests.report_runs import compared_run


class Cells(SimpleNamespace):
    """A run of three cells."""

    cells: Any = ("a", "b", "c")
    files_folder: Any = None

    def cell(self, address: str) -> Any:
        return SimpleNamespace(address=address)


def test_figures_are_written_in_the_format_that_is_asked_for(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    n_figures = sum(len(cell.figures) for cell in run.cells.values())
    for suffix in ("svg", "pdf", "png"):
        folder = tmp_path / suffix
        message = module.export_figures(run, folder, Choices(figure_format=suffix))
        assert message == f"{n_figures} figures, 1 chart and the graph"
        assert (folder / f"photos_and_walls.{suffix}").stat().st_size > 1000
    pages = list((tmp_path / "pdf").glob("*/*.pdf"))
    assert pages
    assert all(page.read_bytes().startswith(b"%PDF") for page in pages)
    # The same figures are pictures otherwise.
    assert len(list((tmp_path / "svg").glob("*/*.png"))) == len(pages)


@pytest.mark.parametrize(
    ("choices", "lacking"),
    [
        ({"license_text": "CC0-1.0", "author": "  "}, "; license or author unknown"),
        ({"license_text": "CC0-1.0", "author": " A. Nobody ", "embed": True}, ""),
    ],
)
def test_a_crate_says_what_it_does_not_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, choices: dict[str, Any], lacking: str
) -> None:
    asked: dict[str, Any] = {}

    def write_crate(run: object, folder: Path, **known: object) -> list[Path]:
        asked.update(known, run=run)
        return [folder / "ro-crate-metadata.json", folder / "run.h5"]

    monkeypatch.setattr("orthoflow.records.archive.write_crate", write_crate)
    monkeypatch.setattr(module, "embedded", lambda *_args: "the record")
    said = module.export_crate(Cells(), tmp_path / "out", Choices(**choices))  # type: ignore[arg-type]
    assert said == f"2 files, described in ro-crate-metadata.json{lacking}"
    assert (asked["run"] == "the record") is bool(choices.get("embed"))
    assert asked["author"] == choices.get("author", "").strip()
    # A crate without a license says that it has none.
    assert asked["license_text"] == choices.get("license_text", asked["license_text"])
    assert asked["license_text"]
