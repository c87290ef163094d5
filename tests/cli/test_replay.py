"""`orthoflow replay` and `export --embed`: runs made again, from their records alone too."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from orthoflow_provenance.document import RecordedCell, canonical_json, sha256_text
from orthoflow_provenance.record import read_record, write_record

from orthoflow.cli.commands import DEFAULT_STORE
from orthoflow.cli.exports.products import store_of
from orthoflow.engine.store import Store
from orthoflow.errors import ArgumentError, RecordError
from orthoflow.records.open import open_run
from orthoflow.records.write import write_embedded
from tests.studios import Studio, open_copy, open_finished_studio, open_studio


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A folder with a run `first` whose plane a file says, kept as it was."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("finished")
        yield open_finished_studio(folder, patch, "--set", "paint.grey=131")


@pytest.fixture
def studio(finished: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Studio:
    """A folder of its own with the run, its input and its store."""
    return open_copy(finished, tmp_path, monkeypatch)


def write_changed(studio: Studio, change: Callable[[RecordedCell], RecordedCell]) -> None:
    """Write the record again with one cell changed, sealed as if it had always been so."""
    path = studio.folder / "first" / "run.h5"
    record = read_record(path)
    cells = (change(record.cells[0]), *record.cells[1:])
    store = Store(studio.folder / ".orthoflow")
    write_record(path, dataclasses.replace(record, cells=cells), store.product_file)


def with_preimage(cell: RecordedCell, **changes: object) -> RecordedCell:
    preimage = canonical_json({**json.loads(cell.key_preimage), **changes})  # type: ignore[dict-item]
    return dataclasses.replace(cell, key_preimage=preimage, key=sha256_text(preimage))


def refused(studio: Studio, *arguments: str, code: int = 3) -> str:
    done = studio("replay", "first", "-o", "again", *arguments, code=code)
    assert not (studio.folder / "again").exists()
    assert not (studio.folder / "again.store").exists()
    return done.stderr


def test_a_replay_computes_everything_anew_with_the_same_bits(studio: Studio) -> None:
    said = studio.json("replay", "first", "-o", "again")
    assert said["ok"] is True
    assert said["notes"] == []
    assert [(row["cell"], row["verdict"]) for row in said["products"]] == [
        ("survey", "identical"),
        ("paint", "identical"),
    ]
    assert [(row["metric"], row["verdict"]) for row in said["metrics"]] == [
        ("offset_m", "same"),
        ("painted_share", "same"),
    ]
    made = read_record(studio.folder / "again" / "run.h5")
    first = read_record(studio.folder / "first" / "run.h5")
    assert [cell.cached_from for cell in made.cells] == ["", ""]
    assert made.run_id != first.run_id
    for name in ("workflow_source", "workflow_resolved", "overrides", "inputs", "seed"):
        assert getattr(made, name) == getattr(first, name)
    assert not (studio.folder / "again.store").exists()
    # A replay can be replayed, and its store be kept.
    done = studio("replay", "again/run.h5", "-o", "third", "--store", "kept")
    assert "2 products: 2 identical" in done.stdout.splitlines()
    assert (studio.folder / "kept" / "results").is_dir()
    assert studio("verify", "third").exit_code == 0


def test_inputs_are_found_by_content_where_a_user_says(studio: Studio) -> None:
    (studio.folder / "elsewhere").mkdir()
    renamed = studio.folder / "elsewhere" / "m.txt"
    (studio.folder / "n.txt").rename(renamed)
    missing = refused(studio, code=2)
    assert "no file with the content of the recorded n.txt (3 bytes, SHA-256 " in missing
    assert "was found; pass --input number=PATH" in missing
    (studio.folder / "o.txt").write_text("1.6")
    assert refused(studio, "--input", "number=o.txt", code=2) == missing
    done = studio("replay", "first", "-o", "again", "--input", "number=elsewhere", code=0)
    # The step saw it under its recorded name, which is part of what it was computed from.
    assert "2 products: 2 identical" in done.stdout.splitlines()
    assert not list(studio.folder.glob(".inputs-*"))
    studio("export", "first", "--embed", "-o", "whole", "--input", f"number={renamed}", code=0)


def test_an_input_is_found_where_a_run_found_it(studio: Studio) -> None:
    (studio.folder / "mydata" / "deep").mkdir(parents=True)
    (studio.folder / "n.txt").rename(studio.folder / "mydata" / "deep" / "m.txt")
    done = studio("export", "first", "--embed", "-o", "whole", code=2)
    assert [*done.stderr.splitlines()[-2:-1], "error: 1 problem"] == done.stderr.splitlines()
    studio.run("second", "--input", "number=mydata/deep")
    studio("export", "second", "--embed", "-o", "whole", code=0)


@pytest.mark.parametrize(
    ("name", "changed", "code", "sentence"),
    [
        (
            "result_version",
            2,
            3,
            "survey.offset: the installed version has result version 1, but",
        ),
        ("method", "survey.laser", 4, "survey.laser of workshop 1.0: unknown method survey.laser"),
    ],
)
def test_a_method_that_is_not_as_it_was_is_named(
    studio: Studio, name: str, changed: object, code: int, sentence: str
) -> None:
    def change(cell: RecordedCell) -> RecordedCell:
        return dataclasses.replace(with_preimage(cell, **{name: changed}), **{name: changed})

    write_changed(studio, change)
    assert f"method {sentence}" in refused(studio, code=code)


@pytest.mark.parametrize(
    ("offset_m", "code", "verdict"),
    [(1.500004, 0, "within tolerance"), (1.51, 3, "different")],
)
def test_other_products_are_measured(
    studio: Studio, offset_m: float, code: int, verdict: str
) -> None:
    # The record claims the products of another run: what a method with hidden state would do.
    (studio.folder / "n.txt").write_text(str(offset_m))
    other = studio.run("other", "--input", "number=n.txt", "--set", "paint.grey=131")
    (studio.folder / "n.txt").write_text("1.5")
    path = studio.folder / "first" / "run.h5"
    record = read_record(path)
    survey, paint = record.cells
    planes = other.cells["survey"].outputs
    inputs = {"planes": dataclasses.replace(paint.inputs["planes"], digest=planes["planes"].digest)}
    ref = planes["planes"]
    paint = with_preimage(
        dataclasses.replace(paint, inputs=inputs, outputs=other.cells["paint"].outputs),
        inputs={"planes": f"{ref.type_name}@{ref.encoding_version}:{ref.digest}"},
    )
    cells = (dataclasses.replace(survey, outputs=planes), paint)
    store = Store(studio.folder / ".orthoflow")
    write_record(path, dataclasses.replace(record, cells=cells), store.product_file)
    said = studio.json("replay", "first", "-o", "again", code=code)
    assert said["ok"] is (code == 0)
    assert [row["verdict"] for row in said["products"]] == [verdict, verdict]
    [distance] = said["products"][0]["distances"][-1:]
    assert distance["unit"] == "m"
    assert distance["largest"] == pytest.approx(offset_m - 1.5, abs=1e-12)


def test_a_failed_cell_fails_again_and_the_rest_is_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studio = open_studio(tmp_path, monkeypatch)
    path = tmp_path / "studio.yaml"
    path.write_text(path.read_text().replace("paint.plain", "paint.fail"))
    assert studio("run", "studio.yaml", "-o", "first").exit_code == 1
    said = studio.json("replay", "first", "-o", "again")
    assert [(row["cell"], row["verdict"]) for row in said["products"]] == [("survey", "identical")]
    assert read_record(tmp_path / "again" / "run.h5").cells[1].status == "failed"


def test_a_metric_that_the_replay_does_not_confirm_is_named(studio: Studio) -> None:
    def change(cell: RecordedCell) -> RecordedCell:
        [metric] = cell.metrics
        return dataclasses.replace(cell, metrics=(dataclasses.replace(metric, value=7.0),))

    write_changed(studio, change)
    assert studio("verify", "first").exit_code == 0
    done = studio("replay", "first", "-o", "again", code=3)
    lines = done.stdout.splitlines()
    assert lines[-6] == "2 products: 2 identical"
    assert lines[-4].split()[:5] == ["survey.offset_m", "7.0", "m", "1.5", "m"]
    assert lines[-4].endswith("unknown: the products of its step are identical")
    assert lines[-3] == "2 metrics (times not counted): 1 differ"


# Records that need nothing beside them ------------------------------------------------------------


def assert_record_alone_is_enough(studio: Studio, record: Path) -> None:
    """Replay a record from a folder in which there is nothing else, without any store."""
    alone = studio.folder / "alone"
    alone.mkdir()
    shutil.copyfile(record, alone / "run.h5")
    for path in studio.folder.iterdir():
        if path != alone:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    verified = studio("verify", "alone", code=0)
    assert "2 products (0 more by digest only), 1 input file, " in verified.stdout
    assert "published files are not in products/" in verified.stdout
    said = studio.json("replay", "alone/run.h5", "-o", "again")
    assert [row["verdict"] for row in said["products"]] == ["identical", "identical"]
    assert sorted(path.name for path in studio.folder.iterdir()) == ["again", "alone"]


def test_an_embedded_run_replays_from_its_record_alone(studio: Studio) -> None:
    run = studio.run("whole", "--input", "number=n.txt", "--embed")
    assert_record_alone_is_enough(studio, run.path)


def test_a_run_is_embedded_afterwards(studio: Studio) -> None:
    done = studio("export", "first", "--embed", "-o", "whole", code=0)
    assert "run.h5 with 2 products and 1 input file, seal sha256:" in done.stdout
    assert "input number: n.txt, 3 B, sha256 " in studio("show", "first").stdout
    assert ", in the record" not in studio("show", "first").stdout
    assert ", in the record" in studio("show", "whole").stdout
    assert [path.name for path in (studio.folder / "whole").iterdir()] == ["run.h5"]
    # What is embedded once can be embedded again, with neither store nor files.
    shutil.rmtree(studio.folder / ".orthoflow")
    (studio.folder / "n.txt").unlink()
    again = studio("export", "whole", "--embed", "-o", "twice", code=0)
    seal = done.output.rpartition("sha256:")[2]
    assert again.output.endswith(seal)
    first, second = (studio.folder / name / "run.h5" for name in ("whole", "twice"))
    assert first.read_bytes() == second.read_bytes()
    assert_record_alone_is_enough(studio, second)


def test_of_a_record_with_changed_arrays_neither_it_nor_its_seal_is_handed_on(
    studio: Studio,
) -> None:
    digest = open_run("first").cells["survey"].outputs["planes"].digest
    with h5py.File(studio.folder / "first" / "run.h5", "r+") as file:
        file["products"][digest.removeprefix("sha256:")]["arrays/normal"][...] = 0
    ways = (("--embed",), ("--to", "ro-crate", "--embed"), ("--to", "ro-crate"), ("--to", "sheet"))
    for words in ways:
        refused = studio("export", "first", *words, "-o", "whole", code=3)
        assert "its seal does not match /products/" in refused.stderr
        assert "; changed records are not exported: use an unchanged copy" in refused.stderr
        assert not (studio.folder / "whole").exists()
    with pytest.raises(
        RecordError, match=r"has the digest .*, but the record states .* another copy"
    ):
        open_run("first").product("survey", "planes")


def test_a_refused_export_of_a_record_alone_leaves_nothing(
    studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = studio.folder / "alone"
    alone.mkdir()
    shutil.copyfile(studio.folder / "first" / "run.h5", alone / "run.h5")
    monkeypatch.chdir(alone)
    (studio.folder / "n.txt").unlink()
    for command in (("export", "run.h5", "--embed"), ("replay", "run.h5")):
        refused = studio(*command, code=2)
        assert "was found; pass --input number=PATH" in refused.stderr
    assert [path.name for path in alone.rglob("*") if path.is_file()] == ["run.h5"]


def test_products_that_nobody_has_are_named_and_no_store_is_made(
    studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = open_run(studio.folder / "first")
    survey, paint = run.record.cells
    (port,) = paint.outputs
    by_digest = replace(paint.outputs[port], embedded=False)
    cells = (survey, replace(paint, outputs={port: by_digest}))
    named = replace(run, record=replace(run.record, cells=cells))
    store = Store(studio.folder / "none")
    with pytest.raises(ArgumentError) as caught:
        write_embedded(named, studio.folder / "whole.h5", store)
    assert str(caught.value) == (
        f"neither the record {run.path} nor the store {store.folder} contains paint.{port}: "
        "give the store of the run with --store, or replay the run"
    )
    assert not store.folder.exists()
    assert not (studio.folder / "whole.h5").exists()
    # The default store is found from other folders, too; another one is used as given.
    (elsewhere := studio.folder / "elsewhere").mkdir()
    monkeypatch.chdir(elsewhere)
    assert store_of(named, DEFAULT_STORE) == studio.folder / DEFAULT_STORE
    assert store_of(named, elsewhere) == elsewhere
    assert store_of(run, DEFAULT_STORE) == DEFAULT_STORE


def test_what_cannot_be_embedded_is_named(studio: Studio) -> None:
    (studio.folder / "n.txt").write_text("1.6")
    refused = studio("export", "first", "--embed", "-o", "whole", code=3)
    assert "was found; n.txt has been changed" in refused.stderr


def test_what_is_noted_fails_a_strict_check_alone(studio: Studio) -> None:
    verdict = studio.json("verify", "first", "--strict")
    assert (verdict["ok"], verdict["notes"], verdict["pages"]) == (True, [], 1)
    report = studio.folder / "first" / "report.html"
    page, products = report.read_text(), studio.folder / "first" / "products"
    table = products / "metrics.csv"
    assert verdict["published"] == sum(path.is_file() for path in products.rglob("*"))
    written = table.read_text()
    table.write_text(written.replace("cell", "sell"))
    refused = studio("verify", "first", code=3)
    assert "products/metrics.csv: changed since it was published" in refused.stdout
    assert "is intact, but files next to it have" in refused.stderr
    table.write_text(written)
    for path, text in (
        (products / "mine.tif", ""),
        (report, "<html></html>"),
        (report, page.replace("</html>", " </html>")),
        (table, None),
    ):
        before = path.read_bytes() if path.exists() else None
        path.unlink(missing_ok=True)
        if text is not None:
            path.write_text(text)
        assert (studio("verify", "first").exit_code, path.name) == (0, path.name)
        assert studio("verify", "first", "--strict").exit_code == 3
        path.unlink(missing_ok=True)
        if before is not None:
            path.write_bytes(before)
    assert studio("verify", "first", "--strict").exit_code == 0
