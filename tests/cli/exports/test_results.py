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
        told = module.export_figures(run, folder, Choices(figure_format=suffix))
        assert told == f"{n_figures} figures, the plan of photos and the graph"
        assert (folder / f"photos_and_walls.{suffix}").stat().st_size > 1000
    pages = list((tmp_path / "pdf").glob("*/*.pdf"))
    assert pages
    assert all(page.read_bytes().startswith(b"%PDF") for page in pages)
    # The same figures are pictures otherwise.
    assert len(list((tmp_path / "svg").glob("*/*.png"))) == len(pages)


@pytest.mark.parametrize(
    ("choices", "lacking"),
    [
        ({}, "; it does not state what --license and --author would"),
        ({"author": "A. Nobody"}, "; it does not state what --license would"),
        ({"license_text": "CC0-1.0", "author": "  "}, "; it does not state what --author would"),
        ({"license_text": "CC0-1.0", "author": " A. Nobody "}, ""),
    ],
)
@pytest.mark.parametrize("embed", [False, True])
def test_a_crate_says_what_it_does_not_say(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    choices: dict[str, str],
    lacking: str,
    embed: bool,
) -> None:
    asked = {}

    def write_crate(_run: object, folder: Path, **known: object) -> list[Path]:
        asked.update(known)
        return [folder / "ro-crate-metadata.json", folder / "run.h5"]

    monkeypatch.setattr("orthoflow.records.archive.write_crate", write_crate)
    monkeypatch.setattr(module, "embedded", lambda *_args: "the record")
    chosen = Choices(embed=embed, **choices)  # type: ignore[arg-type]
    said = module.export_crate(Cells(), tmp_path / "out", chosen)  # type: ignore[arg-type]
    assert said == f"2 files, described in ro-crate-metadata.json{lacking}"
    assert asked["record"] == ("the record" if embed else None)
    assert asked["author"] == choices.get("author", "").strip()
    # A crate without a license says that it has none.
    assert asked["license_text"] == choices.get("license_text", asked["license_text"])
    assert asked["license_text"]


def test_items_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("orthoflow.records.stac.write_stac", lambda _run, _folder: 2)
    said = module.export_stac(Cells(), tmp_path / "out", Choices())  # type: ignore[arg-type]
    assert said == "collection.json and 2 items beside the orthoimages"
    assert (tmp_path / "out").is_dir()


def test_a_model_of_cameras_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = SimpleNamespace(n_images=3, n_cameras=1, n_points=20)
    monkeypatch.setattr(module, "output_of", lambda *_args: ("orient", "cameras"))
    monkeypatch.setattr("orthoflow.products.Cameras.from_payload", lambda payload: payload)
    given = []
    monkeypatch.setattr(
        "orthoflow.files.colmap.write_colmap_model",
        lambda folder, cameras: given.append((folder, cameras)) or model,
    )
    run: Any = SimpleNamespace(payload=lambda address, port: f"{address}.{port}")
    said = module.export_colmap(run, tmp_path / "out", Choices())
    assert said == "3 photos, 1 camera, 20 points of orient"
    assert given == [(tmp_path / "out", "orient.cameras")]
