"""A table of runs: which lie below a folder, in what they differ, and which can be read."""

from __future__ import annotations

import json
import os
from pathlib import Path

import h5py
import pytest
from orthoflow_provenance.document import RecordedFile, RecordedInput
from orthoflow_provenance.record import write_record
from syrupy.assertion import SnapshotAssertion

from tests.hostile_records import reseal
from tests.report_runs import cell, metrics, record
from tests.studios import asked, said


def write(folder: Path, hour: int, cell_m: float, rmse_u_mm: float, **more: object) -> Path:
    folder.mkdir(parents=True)
    scan = RecordedFile(name="hall.laz", size_bytes=3, sha256="a" * 64)
    cells = [
        cell("plane", metrics=metrics(rms_mm=9.0), params={"cell_m": cell_m, "tries": 3}),
        cell("check", metrics=metrics(rmse_u_mm=rmse_u_mm, rms_mm=2.0)),
    ]
    wanted: dict[str, object] = {
        "name": "hall",
        "started": f"2026-01-02T{hour:02}:04:05Z",
        "inputs": (RecordedInput(name="scan", files=(scan,)),),
    }
    made = record(cells, **{**wanted, **more})
    write_record(folder / "run.h5", made, lambda _digest: None)
    return folder


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three good runs of one workflow in two folders, one of another, and one that goes on."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "runs" / "a", 9, 0.02, 1.5)
    write(tmp_path / "runs" / "b", 8, 0.05, 2.5)
    write(tmp_path / "deep" / "er" / "c", 10, 0.02, 0.5)
    write(tmp_path / "runs" / "other", 7, 0.5, 4.0, name="court")
    going = tmp_path / "runs" / "going"
    going.mkdir()
    began = {"event": "run", "time": "2026-01-02T11:00:00Z", "run_id": "x", "workflow": "hall"}
    (going / "journal.jsonl").write_text(json.dumps(began) + "\n")
    return tmp_path


def folders(*arguments: object) -> list[str]:
    return [row["folder"] for row in json.loads(said("runs", *arguments, "--json"))]


def test_the_table_says_when_how_good_and_in_what_runs_differ(runs: Path) -> None:
    lines = said("runs").splitlines()
    rows = [line.split(maxsplit=8) for line in lines[1:6]]
    shown = ["check.rmse_u_mm", "check.rms_mm", "plane.rms_mm"]
    assert lines[0].split() == ["folder", "started", "workflow", "status", *shown, "differs", "in"]
    assert [row[0] for row in rows] == [
        "runs/other", "runs/b", "runs/a", "deep/er/c", "runs/going",
    ]  # fmt: skip
    assert rows[1] == [
        "runs/b",
        "2026-01-02",
        "08:04",
        "hall",
        "ok",
        "2.5",
        "2",
        "9",
        "plane.cell_m=0.05",
    ]
    # Of the other workflow there is one run: nothing that it differs from.
    assert rows[0] == ["runs/other", "2026-01-02", "07:04", "court", "ok", "4", "2", "9"]
    assert rows[4] == ["runs/going", "2026-01-02", "11:00", "hall", "unfinished"]
    assert lines[6].startswith("runs/going unfinished: resume with the same command and -o ")
    assert lines[-1] == "5 runs"


def test_runs_are_chosen_and_ordered(runs: Path) -> None:
    fine = ("--where", "rmse_u_mm<=2.5", "--where", "plane.cell_m=0.02")
    assert folders(*fine) == ["runs/a", "deep/er/c"]
    assert "2 runs, 3 others omitted" in said("runs", *fine)
    by_size = ["deep/er/c", "runs/a", "runs/b", "runs/other"]
    # Those without the number stand last at either end.
    assert folders("--sort", "rmse_u_mm") == [*by_size, "runs/going"]
    assert folders("--sort", "-check.rmse_u_mm") == [*reversed(by_size), "runs/going"]
    assert folders("--sort", "-status")[0] == "runs/going"
    assert folders("deep", "deep/er") == ["deep/er/c"]
    for condition, found in (
        (" rmse_u_mm <= 1.5 ", ["runs/a", "deep/er/c"]),
        ("check.rmse_u_mm > 25e-1", ["runs/other"]),
        ("plane.cell_m = +.05", ["runs/b"]),
        ("plane.cell_m != 2e-2", ["runs/other", "runs/b"]),
        ("rmse_u_mm = -1.5", []),
    ):
        assert folders("--where", condition) == found


def test_json_has_every_number(runs: Path) -> None:
    (row,) = json.loads(said("runs", "deep", "--json"))
    # A later step has the plain name.
    assert row["metrics"]["rms_mm"] == row["metrics"]["check.rms_mm"] == 2.0
    assert row["metrics"]["plane.rms_mm"] == 9.0
    assert row["facts"]["plane.tries"] == 3
    assert row["facts"]["input scan"] == ["hall.laz aaaaaaaa"]
    assert (row["status"], row["started"]) == ("ok", "2026-01-02T10:04:05Z")
    assert row["differs"] == {}


def test_a_folder_of_runs_is_shown_as_their_table(runs: Path) -> None:
    assert said("show", "runs") == said("runs", "runs")
    assert json.loads(said("show", "runs", "--json")) == json.loads(said("runs", "runs", "--json"))
    assert said("show", "runs/a").startswith("hall, run r1: 2 steps")
    assert asked("show", "runs/going").exit_code == 2


def test_what_cannot_be_read_is_a_row_with_its_reason(runs: Path) -> None:
    (runs / "torn").mkdir()
    (runs / "torn" / "run.h5").write_bytes((runs / "runs/a/run.h5").read_bytes()[:2000])
    hostile = write(runs / "hostile", 12, 0.02, 1.0)
    reseal(hostile / "run.h5", lambda record: record.document.update(name="\x1b[2Jred"))
    linked = write(runs / "linked", 13, 0.02, 1.0)
    with h5py.File(linked / "run.h5", "r+") as file:
        file["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
    for name, file in (("pipe", "run.h5"), ("waiting", "journal.jsonl")):
        (runs / name).mkdir()
        os.mkfifo(runs / name / file)
    (runs / "deep" / "loop").symlink_to(runs)  # links are not followed
    rows = {row["folder"]: row for row in json.loads(said("runs", "--json"))}
    assert {name for name, row in rows.items() if row["status"] == "damaged"} == {
        "torn", "linked", "pipe", "waiting",
    }  # fmt: skip
    assert rows["torn"]["reason"].startswith(
        "torn/run.h5 cannot be read because the file is damaged"
    )
    assert all(rows[name]["reason"] for name in ("linked", "pipe"))
    assert "its journal cannot be read: " in rows["waiting"]["reason"]
    assert not [name for name in rows if "loop" in name]
    shown = asked("show", "torn")
    assert shown.exit_code == 3
    assert shown.output.startswith(
        "error: torn/run.h5 cannot be read because the file is damaged: "
    )
    assert shown.output.endswith("; use another copy, and check it with `orthoflow verify`\n")
    assert shown.output.count("\n") == 1
    assert rows["hostile"]["workflow"] == "\x1b[2Jred"
    assert "\x1b" not in said("runs")
    assert "torn damaged: torn/run.h5 cannot be read" in said("runs")


@pytest.mark.parametrize(
    "words",
    [
        ["nowhere"],
        ["--where", "rmse_u_mm < 2 mm"],
        ["--where", "rmse_u < 2"],
        ["--where", "cell_m = 1"],
        ["--sort", "zzz"],
    ],
    ids=" ".join,
)
def test_mistakes_get_a_sentence(runs: Path, words: list[str], snapshot: SnapshotAssertion) -> None:
    result = asked("runs", *words)
    assert result.exit_code == 2
    assert result.output == snapshot


def test_a_comparison_groups_equal_differences_and_counts_rounding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, snapshot: SnapshotAssertion
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, tiny_mm, rms_mm, angle_deg in (("a", 1e-13, 1.5, 10), ("b", 3e-13, 1.25, 14)):
        cells = [
            cell(
                address,
                metrics=metrics(tiny_mm=tiny_mm, rms_mm=rms_mm),
                params={"angle_deg": angle_deg},
            )
            for address in ("plane@data=a", "plane@data=a#1", "plane@data=b")
        ]
        (tmp_path / name).mkdir()
        write_record(tmp_path / name / "run.h5", record(cells, run_id=name), lambda _digest: None)
    assert said("compare", "a", "b") == snapshot
