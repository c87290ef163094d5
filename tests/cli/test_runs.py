"""A table of runs: which lie below a folder, in what they differ, and which can be read."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from orthoflow_provenance.document import RecordedFile, RecordedInput
from orthoflow_provenance.record import write_record
from syrupy.assertion import SnapshotAssertion

from orthoflow.cli.browsing import (
    RunSummary,
    differing_facts,
    run_folders,
    summaries,
)
from orthoflow.diagnostics import DiagnosticSpec
from orthoflow.errors import ArgumentError
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


@pytest.mark.usefixtures("runs")
def test_the_table_says_when_how_good_and_in_what_runs_differ(snapshot: SnapshotAssertion) -> None:
    assert said("runs") == snapshot
    assert json.loads(said("runs", "deep", "--json")) == snapshot(name="of one, as JSON")


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
    shown = asked("show", "torn", code=3)
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
    result = asked("runs", *words, code=2)
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


# Which runs there are, and what sums one up -------------------------------------------------------


UPSIDE_DOWN = DiagnosticSpec(code="upside-down", severity="error", text="{subject} is upside down")


def a_run(folder: Path, name: str = "journal.jsonl") -> Path:
    folder.mkdir(parents=True)
    (folder / name).touch()
    return folder


def test_runs_are_found_down_to_six_folders_and_not_in_each_other(tmp_path: Path) -> None:
    for place in ("b", "a/x", "1/2/3/4/5/6", "a/x/deep", "1/2/3/4/5/6b/7"):
        a_run(tmp_path / place, "run.h5" if place == "b" else "journal.jsonl")
    for place in (".hidden/c", "products/d", "logs/e", "node_modules/f", "pages/g"):
        a_run(tmp_path / place)
    found = [path.relative_to(tmp_path).as_posix() for path in run_folders([tmp_path])]
    assert found == ["1/2/3/4/5/6", "a/x", "b"]
    # Each once, in the order of the folders that are given; a run may be one of them.
    twice = run_folders([tmp_path / "b", tmp_path / "a", tmp_path])
    assert [path.relative_to(tmp_path).as_posix() for path in twice] == ["b", "a/x", "1/2/3/4/5/6"]
    # A run that is itself the folder may have others beside its record, but for parts of it.
    for place in ("b/again", "b/datasets/one", "b/export/ro-crate"):
        a_run(tmp_path / place)
    assert run_folders([tmp_path / "b"]) == [tmp_path / "b", tmp_path / "b/again"]
    (tmp_path / "elsewhere").symlink_to(tmp_path / "a", target_is_directory=True)
    assert run_folders([tmp_path]) == [tmp_path / name for name in found]
    with pytest.raises(
        ArgumentError, match=r"b/run\.h5 is not a folder: pass folders that contain runs"
    ):
        run_folders([tmp_path, tmp_path / "b" / "run.h5"])


def written(folder: Path, *cells: object, **more: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_record(folder / "run.h5", record(cells, **more), lambda _digest: None)  # type: ignore[arg-type]
    return folder


def test_a_run_is_summed_up_by_its_baseline(tmp_path: Path) -> None:
    scan = RecordedFile(name="hall.laz", size_bytes=3, sha256="0123456789" + "a" * 54)
    folder = written(
        tmp_path / "run",
        cell(
            "plane",
            params={"cell_m": 0.1},
            metrics=metrics(rms_mm=3.0, omega_deg=4.0),
            diagnostics=(UPSIDE_DOWN.of("", {}), UPSIDE_DOWN.of("photo 2", {})),
        ),
        cell("check", params={"tries": 2}, metrics=metrics(rms_mm=1.0)),
        cell("lost", status="skipped", params={"none": 1}),
        cell("bad", status="failed", error_message="no plane"),
        cell("worse", status="failed", error_message="no wall"),
        cell("plane#1", params={"cell_m": 7.0}, metrics=metrics(rms_mm=9.0)),
        name="hall",
        status="failed",
        inputs=(RecordedInput(name="scan", files=(scan, replace(scan, name="b.laz"))),),
    )
    (recorded,) = summaries([folder])
    assert (recorded.folder, recorded.status) == (folder, "failed")
    assert (recorded.reason, recorded.n_errors) == ("bad: no plane", 1)
    assert (recorded.workflow, recorded.run_id, recorded.started) == (
        "hall",
        "r1",
        "2026-01-02T03:04:05Z",
    )
    # Repeats are averaged, and a later step has the plain name.
    wanted = {"plane.rms_mm": 6.0, "check.rms_mm": 1.0, "rms_mm": 1.0, "omega_deg": 4.0}
    assert {name: recorded.metrics[name] for name in wanted} == wanted
    assert recorded.n_datasets == 0
    assert recorded.all_facts == {
        "seed": 1,
        "orthoflow": "orthoflow 0.1.0",
        "input scan": ["hall.laz 01234567", "b.laz 01234567"],
        "plane.cell_m": 0.1,
        "plane.use": "plane.toy",
        "check.tries": 2,
        "check.use": "inspect.toy",
        "bad.use": "bad.toy",
        "worse.use": "worse.toy",
    }


def test_of_several_datasets_the_median_counts(tmp_path: Path) -> None:
    cells = [
        cell(
            f"check@data={name}",
            metrics=metrics(rms_mm=value, plane_offset_mm=(-1) ** k * value, omega_deg=-value),
            params={"tries": k},
        )
        for k, (name, value) in enumerate({"hall": 1.0, "stairs": 2.0, "court": 5.0}.items())
    ]
    rooms = {name: {"inputs": {}, "set": {}} for name in ("hall", "stairs", "court")}
    recorded = record(cells, workflow_resolved=json.dumps({"datasets": rooms}))
    write_record(tmp_path / "run.h5", recorded, lambda _digest: None)
    (summary,) = summaries([tmp_path])
    assert (summary.metrics["rms_mm"], summary.metrics["check.rms_mm"]) == (2.0, 2.0)
    # Of errors with signs their sizes, of angles themselves; of one dataset as it was measured.
    assert (summary.metrics["plane_offset_mm"], summary.metrics["omega_deg"]) == (2.0, -2.0)
    alone = record(cells[1:2], workflow_resolved=json.dumps({"datasets": {"stairs": {}}}))
    write_record(tmp_path / "run.h5", alone, lambda _digest: None)
    (of_one,) = summaries([tmp_path])
    assert of_one.metrics["plane_offset_mm"] == -2.0
    assert summary.n_datasets == 3
    assert summary.all_facts["check.tries"] == "0|1|2"


def test_runs_differ_in_the_values_of_parameters_each_of_which_is_stated_once(
    tmp_path: Path,
) -> None:
    def swept(name: str, *tries: tuple[int, ...]) -> RunSummary:
        cells = [
            cell(f"check@check=tries-{value},data=room{room}", params={"tries": value})
            for room, values in enumerate(tries)
            for value in values
        ]
        folder = written(
            tmp_path / name,
            *cells,
            workflow_resolved=json.dumps({"datasets": {f"room{k}": {} for k in range(len(tries))}}),
        )
        (found,) = summaries([folder])
        return found

    several, one = swept("a", (1, 2, 3), (1, 2, 3)), swept("b", (4,), (4,))
    assert list(differing_facts([several, one]).values()) == [
        {"check.tries": "1|2|3"},
        {"check.tries": 4},
    ]
    # `--where` takes all values.
    assert several.values("check.tries") == (1, 2, 3)
    assert (one.values("seed"), one.values("rms_mm")) == ((1,), ())
    # A fact that some lack differs only where two others disagree on it.
    more = swept("c", (4,), (4,), (4,))
    assert differing_facts([one, more])[more.folder] == {"datasets": 3}
    bare = replace(one, folder=tmp_path / "d", parameters={})
    assert differing_facts([one, bare])[one.folder] == {}


def test_a_run_without_a_record_says_what_its_journal_begins_with(tmp_path: Path) -> None:
    folder = a_run(tmp_path / "going")
    began = {"event": "run", "time": "2026-01-02T11:00:00Z", "run_id": "x", "workflow": "hall"}
    (folder / "journal.jsonl").write_text(json.dumps(began) + "\n" + "broken")
    (recorded,) = summaries([folder])
    assert recorded == RunSummary(
        folder=folder,
        status="unfinished",
        reason=f"resume with the same command and -o {folder}",
        workflow="hall",
        run_id="x",
        started="2026-01-02T11:00:00Z",
    )
    (folder / "journal.jsonl").write_text("[1]\n")
    (odd,) = summaries([folder])
    assert (odd.status, odd.workflow) == ("unfinished", "")
