"""What each target of `export` takes from a run, which options it has, and what it reports."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest
import trimesh

from orthoflow.cli.export import format_options
from orthoflow.cli.exports import results as module
from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.drawings import export_dxf, export_geojson
from orthoflow.cli.exports.formats import FORMATS, FormatOption, check_choices
from orthoflow.cli.exports.products import (
    last_product,
    make_empty,
    output_of,
    product_of,
)
from orthoflow.errors import ArgumentError
from orthoflow.products import PointLabels
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run
from tests.drawing_runs import WALL, box_image, write_drawing_run
from tests.drawing_runs import export as export_run
from tests.report_runs import HeldRun, cell, compared_run, given, run_of

OPTIONS: Final = format_options()


def refused(chosen: Choices, target: str | None) -> str:
    """What is said of options that do not go together; nothing where they do."""
    try:
        check_choices(chosen, target, OPTIONS)
    except ArgumentError as error:
        return str(error).partition(";")[0]
    return ""


def test_every_option_is_one_of_the_choices_and_every_format_has_its_writer() -> None:
    assert {str(option.name) for option in OPTIONS} <= {field.name for field in fields(Choices)}
    assert all({*option.formats} <= FORMATS.keys() for option in OPTIONS)
    assert all(callable(entry.load()) for entry in FORMATS.values())


@pytest.mark.parametrize("option", OPTIONS, ids=lambda option: option.name)
def test_an_option_goes_with_the_formats_that_it_belongs_to(option: FormatOption) -> None:
    # 0 is the first wall, and a grid of none.
    value = 0 if option.name in ("wall", "grid") else ("x",)
    chosen = Choices(**{str(option.name): value})  # type: ignore[arg-type]
    for target in FORMATS:
        said = f"{option.opts[0]} cannot be combined with --to {target}"
        assert refused(chosen, target) == ("" if target in option.formats else said)
        assert refused(Choices(), target) == ""


@pytest.mark.parametrize(
    ("chosen", "target", "said"),
    [
        (Choices(embed=True), "ro-crate", ""),
        (Choices(embed=True, inputs=("scan=a.laz",)), None, ""),
        (Choices(split=True), None, ""),
        (Choices(), None, "choose a format: --to "),
        (Choices(split=True), "csv", "--split cannot be combined with --to csv"),
        (Choices(split=True, embed=True), None, "--embed cannot be combined with --split"),
        (Choices(embed=True), "csv", "--embed cannot be combined with --to csv"),
        (Choices(inputs=("a=b",)), "csv", "--input cannot be combined with --to csv"),
        (Choices(wall=1, embed=True), None, "--wall cannot be combined with --embed"),
    ],
)
def test_what_contradicts_itself_is_refused(chosen: Choices, target: str | None, said: str) -> None:
    assert refused(chosen, target).startswith(said)
    assert bool(refused(chosen, target)) == bool(said)


def giving(*addresses: str) -> HeldRun:
    """Cells that give a product each, whose digests are the letters of the alphabet."""
    cells = [
        cell(address, outputs={"out": given("", chr(97 + place), "labels")})
        for place, address in enumerate(addresses)
    ]
    return run_of(cell("scan"), *cells)


def test_the_last_cell_is_taken_and_the_first_five_others_are_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert output_of(giving("plane"), "labels", None) == ("plane", "out")
    seven = [f"plane@plane=v{k}" for k in range(7)]
    assert output_of(giving(*seven), "labels", seven[2]) == (seven[2], "out")
    assert capsys.readouterr().err == ""
    assert output_of(giving(*seven), "labels", None) == (seven[-1], "out")
    said = capsys.readouterr().err
    assert f"note: using the labels of points of {seven[-1]}; --step selects others: " in said
    assert f"{', '.join(seven[:5])} and 1 more" in said


def test_a_cell_that_gives_nothing_of_the_kind_is_refused() -> None:
    run = giving("a", "b")
    with pytest.raises(ArgumentError) as caught:
        output_of(run, "labels", "scan")
    assert str(caught.value) == (
        "the step scan has no labels of points; steps with labels of points: a, b"
    )
    with pytest.raises(ArgumentError, match=r"^the run r1 contains no cloud$"):
        output_of(run, "cloud", None)
    with pytest.raises(ArgumentError, match="steps with clouds: none"):
        output_of(run, "cloud", "a")


def test_the_last_of_some_cells_gives_a_product(tmp_path: Path) -> None:
    run = giving("a", "b")
    first, second = (PointLabels(plane_index=np.full(3, k, np.int16)) for k in (1, 2))
    held = replace(run, products={("a", "out"): first, ("b", "out"): second})
    found = last_product(held, run.cells, PointLabels, tmp_path)
    assert found is not None
    assert found.plane_index.tolist() == [2, 2, 2]
    only = {"a": run.cells["a"]}
    assert last_product(held, only, PointLabels, tmp_path).plane_index.tolist() == [1, 1, 1]  # type: ignore[union-attr]
    assert last_product(held, {"scan": run.cells["scan"]}, PointLabels, tmp_path) is None
    with pytest.raises(
        ArgumentError, match="pass the store of the run with --store, or run the workflow"
    ):
        product_of(held, "sha256:" + "f" * 64, PointLabels, tmp_path / "store")


def test_a_folder_is_made_with_those_above_it(tmp_path: Path) -> None:
    make_empty(tmp_path / "a" / "b")
    make_empty(tmp_path / "a" / "b")
    (tmp_path / "a" / "b" / "file").touch()
    with pytest.raises(ArgumentError, match=r"cannot create .*file/c: Not a directory"):
        make_empty(tmp_path / "a" / "b" / "file" / "c")


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


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A wall whose left half one photo paints, and its right half another."""
    image = box_image()
    source = image.source.copy()
    source[:, image.frame.width // 2 :][image.source[:, image.frame.width // 2 :] == 0] = 1
    image = replace(image, source=source, sources=("a.jpg", "b.jpg"))
    return open_run(write_drawing_run(tmp_path_factory.mktemp("drawings") / "run", image=image))


@pytest.mark.parametrize("has_planes", [False, True])
@pytest.mark.parametrize(
    ("export", "suffix", "beside"),
    [
        (export_dxf, "dxf", f"wall_{WALL}_ortho.png"),
        (export_geojson, "geojson", f"wall_{WALL}_seams.geojson"),
    ],
)
def test_files_are_of_each_wall_and_of_the_room_where_it_is_known(
    run: Run,
    tmp_path: Path,
    *,
    export: Callable[[Run, Path, Choices], str],
    suffix: str,
    beside: str,
    has_planes: bool,
) -> None:
    if not has_planes:
        cells = tuple(cell for cell in run.record.cells if cell.step != "plane")
        run = Run(path=run.path, record=replace(run.record, cells=cells))
    export(run, tmp_path / "out", Choices())
    room = {f"room.{suffix}"} if has_planes else set()
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {f"wall_{WALL}.{suffix}", beside} | room
    with pytest.raises(ArgumentError, match=f"it shows {WALL}"):
        export(run, tmp_path / "none", Choices(wall=WALL + 1))
    assert not (tmp_path / "none").exists()


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return write_drawing_run(tmp_path / "run")


@pytest.mark.parametrize("more", [(), ("--relief",)])
def test_a_model_has_the_depths_of_the_wall_only_on_request(model: Path, more: tuple[str]) -> None:
    export_run(model, "gltf", model.parent / "model", *more, code=0)
    (mesh,) = trimesh.load(model.parent / "model" / "room.glb").geometry.values()
    span_m = np.ptp(mesh.vertices[:, 2])
    assert len(mesh.faces) > 2 if more else len(mesh.faces) == 2
    assert span_m == pytest.approx(0.04 if more else 0.0)


def test_a_run_without_depths_says_so(model: Path) -> None:
    shutil.rmtree(model / "products" / "wall")
    done = export_run(model, "gltf", model.parent / "model", "--relief", code=2)
    assert f"--relief: the run has no depth raster of wall {WALL}" in " ".join(done.output.split())
    assert not (model.parent / "model").exists()
