"""Records that need nothing beside them, and files beside a record that were changed."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import pytest

from orthoflow.cli.commands import DEFAULT_STORE
from orthoflow.cli.exports.products import store_of
from orthoflow.engine.store import Store
from orthoflow.errors import ArgumentError, RecordError
from orthoflow.records.open import open_run
from orthoflow.records.write import write_embedded
from tests.studios import Studio, open_copy, open_finished_studio


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A folder with a run `first` whose plane a file says."""
    with pytest.MonkeyPatch.context() as patch:
        yield open_finished_studio(tmp_path_factory.mktemp("finished"), patch)


@pytest.fixture
def studio(finished: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Studio:
    """A folder of its own with the run, its input and its store."""
    return open_copy(finished, tmp_path, monkeypatch)


def assert_record_alone_is_enough(studio: Studio, record: Path) -> None:
    """Replay a record from a folder in which there is nothing else, without any store."""
    alone = studio.folder / "alone"
    alone.mkdir()
    shutil.copyfile(record, alone / "run.h5")
    for path in studio.folder.iterdir():
        if path != alone:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    verified = studio("verify", "alone")
    assert verified.exit_code == 0
    assert "2 products (0 more by digest only), 1 input file, " in verified.stdout
    assert "published files are not in products/" in verified.stdout
    said = studio.json("replay", "alone/run.h5", "-o", "again")
    assert [row["verdict"] for row in said["products"]] == ["identical", "identical"]
    assert sorted(path.name for path in studio.folder.iterdir()) == ["again", "alone"]


def test_an_embedded_run_replays_from_its_record_alone(studio: Studio) -> None:
    run = studio.run("whole", "--input", "number=n.txt", "--embed")
    assert_record_alone_is_enough(studio, run.path)


def test_a_run_is_embedded_afterwards(studio: Studio) -> None:
    done = studio("export", "first", "--embed", "-o", "whole")
    assert done.exit_code == 0, done.output
    assert "run.h5 with 2 products and 1 input file, seal sha256:" in done.stdout
    assert "input number: n.txt, 3 B, sha256 " in studio("show", "first").stdout
    assert ", in the record" not in studio("show", "first").stdout
    assert ", in the record" in studio("show", "whole").stdout
    assert [path.name for path in (studio.folder / "whole").iterdir()] == ["run.h5"]
    # What is embedded once can be embedded again, with neither store nor files.
    shutil.rmtree(studio.folder / ".orthoflow")
    (studio.folder / "n.txt").unlink()
    again = studio("export", "whole", "--embed", "-o", "twice")
    assert again.exit_code == 0
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
        refused = studio("export", "first", *words, "-o", "whole")
        assert refused.exit_code == 3, refused.output
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
        refused = studio(*command)
        assert refused.exit_code == 2
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
    refused = studio("export", "first", "--embed", "-o", "whole")
    assert refused.exit_code == 3
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
    refused = studio("verify", "first")
    assert refused.exit_code == 3
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
