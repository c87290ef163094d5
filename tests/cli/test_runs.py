"""A table of runs: which lie below a folder, in what they differ, and which can be read."""

from __future__ import annotations

import csv
import io
import json
import os
import re
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from orthoflow_provenance.document import Metric, RecordedFile, RecordedInput
from orthoflow_provenance.record import write_record

from orthoflow.cli import runs as module
from orthoflow.report.browsing import RunSummary
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
    rows = [line.split(maxsplit=7) for line in lines[1:6]]
    assert lines[0].split() == (
        ["folder", "started", "workflow", "status", "rmse_u_mm", "rms_mm", "differs", "in"]
    )
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
        "plane.cell_m=0.05",
    ]
    # Of the other workflow there is one run: nothing that it differs from.
    assert rows[0] == ["runs/other", "2026-01-02", "07:04", "court", "ok", "4", "2"]
    assert rows[4] == ["runs/going", "2026-01-02", "11:00", "hall", "unfinished"]
    assert lines[6].startswith("runs/going unfinished: continues with the same command and -o ")
    assert lines[-1] == "5 runs"


def test_runs_are_chosen_and_ordered(runs: Path) -> None:
    assert folders("--workflow", "court") == ["runs/other"]
    assert folders("--status", "unfinished", "--status", "failed") == ["runs/going"]
    assert folders("--where", "rmse_u_mm<=2.5", "--where", "plane.cell_m=0.02") == [
        "runs/a", "deep/er/c",
    ]  # fmt: skip
    assert folders("--sort", "rmse_u_mm")[:4] == ["deep/er/c", "runs/a", "runs/b", "runs/other"]
    # Those without the number stand last at either end.
    assert folders("--sort", "-check.rmse_u_mm") == [
        "runs/other", "runs/b", "runs/a", "deep/er/c", "runs/going",
    ]  # fmt: skip
    assert folders("deep", "deep/er") == ["deep/er/c"]
    assert "1 run, 4 others left out" in said("runs", "--workflow", "court")


def test_a_sweep_differs_from_a_single_run_in_all_its_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder, variants, method in [
        ("alone", {"fine": 0.05}, "plane.toy"),
        ("swept", {"fine-cell_m-0_02": 0.02, "fine-cell_m-0_05": 0.05}, "plane.other"),
    ]:
        (tmp_path / folder).mkdir()
        cells = [
            cell(f"plane@plane={variant}", params={"cell_m": cell_m}, method=method)
            for variant, cell_m in variants.items()
        ]
        made = record(cells, name="hall")
        write_record(tmp_path / folder / "run.h5", made, lambda _digest: None)
    rows = {row["folder"]: row["differs"] for row in json.loads(said("runs", "--json"))}
    assert rows == {
        "alone": {"plane.cell_m": 0.05, "plane.use": "plane.toy"},
        "swept": {"plane.cell_m": "0.02|0.05", "plane.use": "plane.other"},
    }
    # And so do all facts, as JSON and as CSV.
    told = {
        row["folder"]: row["facts"]["plane.cell_m"] for row in json.loads(said("runs", "--json"))
    }
    assert told == {"alone": 0.05, "swept": "0.02|0.05"}
    table = list(csv.DictReader(io.StringIO(said("runs", "--csv"))))
    assert {row["folder"]: row["plane.cell_m"] for row in table} == {
        "alone": "0.05",
        "swept": "0.02|0.05",
    }
    assert folders("--where", "plane.cell_m = 0.02") == ["swept"]
    # Against all that were found, not only those that a filter leaves.
    (row,) = json.loads(said("runs", "--json", "--where", "plane.cell_m = 0.02"))
    assert row["differs"] == rows["swept"]
    assert "plane.cell_m=0.02|0.05" in said(
        "runs", "--where", "plane.cell_m = 0.02", "--html", "r.html"
    )
    assert "plane.cell_m=&#34;0.02|0.05&#34;" in (tmp_path / "r.html").read_text()
    assert folders("--where", "plane.cell_m = 0.05") == ["alone", "swept"]
    # By the names that --set takes for a variant, whether a sweep made several of it or not.
    assert folders("--where", "plane.fine.cell_m = 0.02") == ["swept"]
    assert folders("--where", "plane.fine.cell_m = 0.05") == ["alone", "swept"]
    assert folders("--where", "plane.fine-cell_m-0_05.cell_m = 0.05") == ["swept"]


def test_json_and_csv_have_every_number(runs: Path) -> None:
    (row,) = json.loads(said("runs", "deep", "--json"))
    # A later step has the plain name.
    assert row["metrics"]["rms_mm"] == row["metrics"]["check.rms_mm"] == 2.0
    assert row["metrics"]["plane.rms_mm"] == 9.0
    assert row["facts"]["plane.tries"] == 3
    assert row["facts"]["input scan"] == ["hall.laz aaaaaaaa"]
    assert (row["status"], row["started"]) == ("ok", "2026-01-02T10:04:05Z")
    assert row["differs"] == {}
    table = list(csv.DictReader(io.StringIO(said("runs", "--csv"))))
    by_folder = {line["folder"]: line for line in table}
    assert float(by_folder["runs/b"]["plane.cell_m"]) == 0.05
    assert float(by_folder["runs/b"]["check.rmse_u_mm"]) == 2.5
    assert by_folder["runs/going"]["check.rmse_u_mm"] == ""


def test_a_folder_of_runs_is_shown_as_their_table(runs: Path) -> None:
    assert said("show", "runs") == said("runs", "runs")
    assert json.loads(said("show", "runs", "--json")) == json.loads(said("runs", "runs", "--json"))
    assert said("show", "runs/a").startswith("hall, run r1: 2 steps")
    assert asked("show", "runs/going").exit_code == 2


def test_a_page_leads_to_the_report_of_each_run(runs: Path) -> None:
    (runs / "runs" / "a" / "report.html").write_text("the report")
    (runs / "runs" / "<b>").mkdir()
    (runs / "runs" / "<b>" / "journal.jsonl").write_text("spoilt")
    (runs / "out").mkdir()
    assert said("runs", "runs", "deep", "--html", "out/all.html").endswith("page: out/all.html\n")
    page = (runs / "out" / "all.html").read_text()
    assert page.count('href="../runs/a/report.html"') == 1
    assert "../runs/b/report.html" not in page
    assert "error along u" in page
    assert 'data-value="1.5"' in page
    assert "plane.cell_m=0.05" in page
    assert "&lt;b&gt;" in page
    assert "<b>/" not in page
    assert "cannot be written" in asked("runs", "runs", "--html", "no/folder.html").output


def test_a_name_that_means_two_things_has_a_column_for_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, method in (("plane", "plane.toy"), ("points", "inspect.checkpoints")):
        (tmp_path / name).mkdir()
        label = "points to the plane" if name == "plane" else "check points"
        number = Metric(name="rms_mm", value=7.0, unit="mm", label=label, headline=True)
        made = record([cell(name, method=method, metrics=(number,))], name=name)
        write_record(tmp_path / name / "run.h5", made, lambda _digest: None)
    said("runs", "--html", "runs.html")
    page = (tmp_path / "runs.html").read_text()
    heading = r'data-name="(\w+\.rms_mm|rms_mm)" data-key data-sort="number"><span>([^/]*)</span>'
    assert re.findall(heading, page.replace("<wbr>", "")) == [
        ("plane.rms_mm", "points to the plane"),
        ("points.rms_mm", "check points"),
    ]
    header = said("runs").splitlines()[0]
    assert "plane.rms_mm" in header
    assert "points.rms_mm" in header
    assert " rms_mm " not in header


def test_what_cannot_be_read_is_a_row_with_its_reason(runs: Path) -> None:
    (runs / "torn").mkdir()
    (runs / "torn" / "run.h5").write_bytes((runs / "runs/a/run.h5").read_bytes()[:2000])
    hostile = write(runs / "hostile", 12, 0.02, 1.0)
    reseal(hostile / "run.h5", lambda record: record.document.update(name="\x1b[2Jred"))
    linked = write(runs / "linked", 13, 0.02, 1.0)
    with h5py.File(linked / "run.h5", "r+") as file:
        file["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
    (runs / "pipe").mkdir()
    os.mkfifo(runs / "pipe" / "run.h5")
    rows = {row["folder"]: row for row in json.loads(said("runs", "--json"))}
    assert {name for name, row in rows.items() if row["status"] == "damaged"} == {
        "torn", "linked", "pipe",
    }  # fmt: skip
    assert rows["torn"]["reason"].startswith("torn/run.h5 cannot be read, the file is damaged")
    assert all(rows[name]["reason"] for name in ("linked", "pipe"))
    shown = asked("show", "torn")
    assert shown.exit_code == 3
    assert shown.output.startswith("error: torn/run.h5 cannot be read, the file is damaged: ")
    assert shown.output.endswith("; use another copy, and check it with `orthoflow verify`\n")
    assert shown.output.count("\n") == 1
    assert rows["hostile"]["workflow"] == "\x1b[2Jred"
    assert "\x1b" not in said("runs")
    assert "torn damaged: torn/run.h5 cannot be read" in said("runs")


def test_a_pipe_in_the_place_of_a_journal_is_not_waited_for(runs: Path) -> None:
    folder = runs / "runs" / "pipe"
    folder.mkdir()
    os.mkfifo(folder / "journal.jsonl")
    reason = "runs/pipe damaged: it has no run.h5, and its journal cannot be read: "
    for command in ("runs", "show"):
        table = said(command, "runs")
        assert reason in table
        assert "it is a folder, a pipe or a device" in table


@pytest.mark.parametrize("end", ["\u2028", "\u2029", "\x85", "\x0b", "\x0c", "\x1c", "\r", "\n"])
def test_no_letter_in_a_name_begins_a_row_of_its_own(runs: Path, end: str) -> None:
    set_name = f"court{end}=HYPERLINK(1)"
    reseal(
        runs / "runs" / "other" / "run.h5",
        lambda record: record.document.update(name=set_name),
    )
    rows = list(csv.reader(io.StringIO(said("runs", "--csv", "runs"), newline="")))
    assert [row[0] for row in rows] == [
        "folder",
        *(f"runs/{name}" for name in ("other", *"ba", "going")),
    ]
    assert rows[1][2].endswith("=HYPERLINK(1)")


def test_links_are_not_followed(runs: Path) -> None:
    (runs / "deep" / "loop").symlink_to(runs)
    assert folders("deep") == ["deep/er/c"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("nowhere",), "nowhere is not a folder: give folders that contain runs"),
        (("--where", "rmse_u_mm"), "is not a condition: expected a name, one of < <= > >= = !="),
        (("--where", "rmse_u_mm < 2 mm"), "is not a condition"),
        (("--where", "rmse_u < 2"), "no run has a metric or parameter 'rmse_u'; did you mean"),
        (("--where", "cell_m = 1"), "parameter 'cell_m'; did you mean 'plane.cell_m'?"),
        (("--sort", "zzz"), "no run has a metric or parameter 'zzz'; --json has the names"),
        (("--metric", "zzz"), "no run has a metric or parameter 'zzz'"),
        (("--csv", "r.csv"), "--csv prints its table: write it into a file by > r.csv"),
        (("--csv", "--json"), "--csv and --json exclude each other"),
    ],
)
def test_mistakes_get_a_sentence(runs: Path, arguments: tuple[str, ...], sentence: str) -> None:
    result = asked("runs", *arguments)
    assert result.exit_code == 2
    assert sentence in result.output


def test_without_runs_it_says_so(tmp_path: Path) -> None:
    assert said("runs", tmp_path) == "0 runs\n"


# --- parts of a row ---


def test_in_what_a_run_differs_is_said_as_far_as_a_line_bears_it() -> None:
    assert module._facts_text({}) == ""
    facts = {
        "plane.use": "plane.toy",
        "wall.near": [[1, 2.5]],
        "input scan": ["a.laz", "b.laz"],
        "input photos": [],
    }
    said = "plane.use=plane.toy, wall.near=[[1, 2.5]], input scan=a.laz, b.laz, "
    assert module._facts_text(facts) == f"{said}input photos=not given"
    assert module._facts_text({**facts, "seed": 8, "a": None}) == (
        f"{said}input photos=not given and 2 more"
    )
    for length, told in ((40, "x" * 40), (41, "x" * 40 + "...")):
        assert module._facts_text({"name": "x" * length}) == f"name={told}"


@pytest.mark.parametrize(
    ("text", "name", "limit", "holding"),
    [
        ("rms_mm<2", "rms_mm", 2.0, [1]),
        (" rms_mm <= 2 ", "rms_mm", 2.0, [1, 2]),
        ("check.rms_mm > 2e0", "check.rms_mm", 2.0, [3]),
        ("plane.a >= 2.", "plane.a", 2.0, [2, 3]),
        ("seed = +2", "seed", 2.0, [2]),
        ("seed != .2e1", "seed", 2.0, [1, 3]),
        ("input scan = -2.5", "input scan", -2.5, []),
    ],
)
def test_a_condition_is_a_name_a_sign_and_a_number(
    text: str, name: str, limit: float, holding: list[int]
) -> None:
    condition = module._Condition.of(text)
    assert (condition.name, condition.limit) == (name, limit)
    for facts in (False, True):
        runs = {
            value: RunSummary(
                folder=Path("a"),
                state="ok",
                metrics={} if facts else {name: value},
                facts={name: value} if facts else {},
            )
            for value in (1, 2, 3)
        }
        assert [value for value, run in runs.items() if condition.is_met_by(run)] == holding


@pytest.mark.parametrize("value", [True, "2", None, [2]])
def test_what_is_no_number_meets_no_condition(value: object) -> None:
    run = RunSummary(folder=Path("a"), state="ok", facts={"seed": value})  # type: ignore[arg-type]
    assert not any(module._Condition.of(f"seed {sign} 2").is_met_by(run) for sign in module._SIGNS)
    assert not module._Condition.of("other = 2").is_met_by(run)


def test_long_names_and_reasons_are_cut(capsys: pytest.CaptureFixture[str]) -> None:
    run = RunSummary(
        folder=Path("a"),
        state="damaged",
        workflow="w" * 61,
        reason="r" * 1001,
        started="2026-01-02T03:04:05Z",
    )
    fine = RunSummary(folder=Path("b"), state="ok", workflow="v" * 60, n_datasets=2)
    one = RunSummary(folder=Path("c"), state="ok", n_datasets=1)
    module.print_runs([run, fine, one], [run, fine, one, replace(one, folder=Path("d"))])
    said = capsys.readouterr().out
    lines = said.splitlines()
    assert lines[1].split() == ["a", "2026-01-02", "03:04", "w" * 60, "damaged"]
    assert lines[2].split() == ["b", "v" * 60, "ok"]
    assert said.count("r" * 1000) == 1
    assert "r" * 1001 not in said
    assert "b: medians of 2 datasets" in lines
    assert "c: medians" not in said
    assert lines[-1] == "3 runs, 1 other left out"
