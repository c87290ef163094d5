"""Datasets from the user's side: one command, many rooms, one record."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path

import pytest
from click.testing import Result

from orthoflow.records.open import open_run
from orthoflow.records.verify import verify_run
from tests.studios import asked, open_studio

ROOMS = """\
orthoflow: 1
name: rooms
seed: 7
inputs:
  number: {optional: true}
steps:
  survey: {use: survey.offset, in: {files: inputs.number}}
  other: {use: survey.offset}
  paint: {use: paint.plain, in: {planes: survey.planes}}
  side: {use: paint.plain, in: {planes: other.planes}}
"""
TABLE = "name,number\nhall,data/hall.txt\nattic,data/attic.txt\nstairs,data/stairs.txt\n"
# No test here asks for the processes of steps.
INLINE = ("--executor", "inline")
NUMBERS = {"hall": "1.5", "attic": "", "stairs": "2.5"}


def orthoflow(folder: Path, *arguments: str, code: int | None = None) -> Result:
    with chdir(folder):
        return asked(*arguments, code=code)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder in which three rooms were run, one of them with an empty file."""
    folder = tmp_path_factory.mktemp("rooms")
    patch = pytest.MonkeyPatch()
    open_studio(folder, patch)
    (folder / "rooms.yaml").write_text(ROOMS)
    (folder / "rooms.csv").write_text(TABLE)
    (folder / "data").mkdir()
    for name, text in NUMBERS.items():
        (folder / "data" / f"{name}.txt").write_text(text)
    # Every root failure is that of an input.
    orthoflow(
        folder, "run", "rooms.yaml", "--datasets", "rooms.csv", "-o", "first", *INLINE, code=2
    )
    yield folder
    patch.undo()


def test_a_dataset_that_fails_keeps_its_place_and_the_others_go_on(folder: Path) -> None:
    cells = open_run(folder / "first").cells
    assert {address: cell.status for address, cell in cells.items()} == {
        "survey@data=hall": "ok",
        "survey@data=attic": "failed",
        "survey@data=stairs": "ok",
        "other": "ok",
        "paint@data=hall": "ok",
        "paint@data=attic": "skipped",
        "paint@data=stairs": "ok",
        "side": "ok",
    }
    assert cells["survey@data=attic"].error_message == "attic.txt is empty, expected one number"
    assert cells["paint@data=attic"].error_message == "needs survey@data=attic, which failed"


def test_the_record_of_all_datasets_verifies_and_replays(folder: Path) -> None:
    found = {path.parent.name for path in (folder / "first" / "products").glob("*/*_ortho.tif")}
    assert found == {"paint@data=hall", "paint@data=stairs", "side"}
    record = open_run(folder / "first").record
    assert {entry.name: [file.name for file in entry.files] for entry in record.inputs} == {
        f"number@{name}": [f"{name}.txt"] for name in NUMBERS
    }
    assert orthoflow(folder, "verify", "first").exit_code == 0
    done = orthoflow(folder, "replay", "first", "-o", "again", "--json", *INLINE, code=0)
    products = json.loads(done.stdout)["products"]
    assert [product["verdict"] for product in products] == ["identical"] * 6


@pytest.mark.parametrize("given", ["number=moved", "number@hall=moved/hall.txt"])
def test_a_replay_takes_the_files_of_a_dataset_from_elsewhere(
    given: str, folder: Path, tmp_path: Path
) -> None:
    moved = tmp_path / "moved"
    moved.mkdir()
    for name, text in NUMBERS.items():
        (moved / f"{name}.txt").write_text(text)
    (tmp_path / "run.h5").write_bytes((folder / "first" / "run.h5").read_bytes())
    done = orthoflow(tmp_path, "replay", "run.h5", "-o", "again", code=2)
    assert "input number@hall: no file with the content of the recorded hall.txt" in done.stderr
    done = orthoflow(tmp_path, "replay", "run.h5", "-o", "again", "--input", given, *INLINE)
    if given == "number=moved":
        assert done.exit_code == 0, done.stderr
    else:
        assert "input number@hall" not in done.stderr
        assert "pass --input number@stairs=PATH" in done.stderr


def test_later_rows_compute_nothing_again(folder: Path) -> None:
    (folder / "more.csv").write_text(f"{TABLE}cellar,data/cellar.txt\n")
    (folder / "data" / "cellar.txt").write_text("3.5")
    done = orthoflow(folder, "plan", "rooms.yaml", "--datasets", "more.csv", "--json")
    states = {item["cell"]: item["status"] for item in json.loads(done.stdout)}
    assert {address for address, state in states.items() if state != "cached"} == {
        "survey@data=attic",
        "paint@data=attic",
        "survey@data=cellar",
        "paint@data=cellar",
    }


def test_check_counts_the_datasets_and_names_every_missing_file(folder: Path) -> None:
    done = orthoflow(folder, "check", "rooms.yaml", "--datasets", "rooms.csv")
    assert done.stdout == "rooms is valid: 4 steps, 3 datasets, 8 step runs in total\n"
    graph = orthoflow(folder, "graph", "rooms.yaml", "--datasets", "rooms.csv").stdout
    assert 'input0[/"number<br/>of 3 datasets"/]' in graph
    (folder / "gone.csv").write_text("name,number\nhall,data/hall.txt\na,a.txt\nb,b.txt\n")
    done = orthoflow(folder, "check", "rooms.yaml", "--datasets", "gone.csv", code=2)
    said = done.stderr
    assert "input number@a: there is no file a.txt next to the table gone.csv:3 (" in said
    at = "\ngone.csv:4:3: b.number: input number@b: "
    assert f"{at}there is no file b.txt next to the table gone.csv:4 (" in said


def test_each_dataset_becomes_a_run_folder_that_stands_alone(folder: Path, tmp_path: Path) -> None:
    done = orthoflow(folder, "export", "first", "--split", "-o", str(tmp_path / "split"), code=0)
    assert done.stdout.endswith("3 run folders: hall, attic, stairs\n")
    assert {path.name for path in (tmp_path / "split").iterdir()} == {"hall", "attic", "stairs"}
    hall = open_run(tmp_path / "split" / "hall")
    assert list(hall.cells) == ["survey@data=hall", "other", "paint@data=hall", "side"]
    assert [entry.name for entry in hall.record.inputs] == ["number@hall"]
    assert hall.record.status == "ok"
    assert len(hall.orthoimages) == 2
    assert (hall.folder / "report.html").is_file()
    whole = open_run(folder / "first")
    for address, cell in hall.cells.items():
        assert cell == whole.cells[address]
    assert open_run(tmp_path / "split" / "attic").record.status == "failed"
    for name in ("hall", "attic"):
        found = verify_run(tmp_path / "split" / name)
        assert found.findings == ()
        assert found.notes == ()
    given = ("--input", f"number={folder}/data", *INLINE)
    orthoflow(tmp_path, "replay", "split/hall", "-o", "again", *given, code=0)


def test_what_ran_on_no_datasets_is_not_split(folder: Path) -> None:
    assert orthoflow(folder, "run", "rooms.yaml", "-o", "plain", *INLINE).exit_code == 0
    done = orthoflow(folder, "export", "plain", "--split", code=2)
    assert "has no datasets, so it cannot be split" in done.stderr
    assert not (folder / "plain" / "datasets").exists()
