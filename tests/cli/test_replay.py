"""`orthoflow replay`: a run made again from its record; what is not as it was is named first."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from orthoflow_provenance.document import RecordedCell, canonical_json, sha256_text
from orthoflow_provenance.record import read_record, write_record

from orthoflow.engine.store import Store
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
    done = studio("replay", "first", "-o", "again", *arguments)
    assert done.exit_code == code, done.output
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
    done = studio("replay", "first", "-o", "again", "--input", "number=elsewhere")
    assert done.exit_code == 0, done.output
    # The step saw it under its recorded name, which is part of what it was computed from.
    assert "2 products: 2 identical" in done.stdout.splitlines()
    assert not list(studio.folder.glob(".inputs-*"))
    done = studio("export", "first", "--embed", "-o", "whole", "--input", f"number={renamed}")
    assert done.exit_code == 0, done.output


def test_an_input_is_found_where_a_run_found_it(studio: Studio) -> None:
    (studio.folder / "mydata" / "deep").mkdir(parents=True)
    (studio.folder / "n.txt").rename(studio.folder / "mydata" / "deep" / "m.txt")
    done = studio("export", "first", "--embed", "-o", "whole")
    assert done.exit_code == 2
    assert [*done.stderr.splitlines()[-2:-1], "error: 1 problem"] == done.stderr.splitlines()
    studio.run("second", "--input", "number=mydata/deep")
    done = studio("export", "second", "--embed", "-o", "whole")
    assert done.exit_code == 0, done.output


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
    done = studio("replay", "first", "-o", "again")
    assert done.exit_code == 3, done.output
    lines = done.stdout.splitlines()
    assert lines[-6] == "2 products: 2 identical"
    assert lines[-4].split()[:5] == ["survey.offset_m", "7.0", "m", "1.5", "m"]
    assert lines[-4].endswith("unknown: the products of its step are identical")
    assert lines[-3] == "2 metrics (times not counted): 1 differ"
