"""`orthoflow run` and what reads its results, with real processes and real files."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest

from orthoflow.records.open import open_run
from tests.long_loops import long_only
from tests.workshop_runs import command, orthoflow, workshop_environment, write_studio

# Where no test asks for the processes of steps.
INLINE = ("--executor", "inline")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A folder with a finished run `good`; what the run wrote to stdout and stderr."""
    folder = tmp_path_factory.mktemp("finished")
    write_studio(folder)
    done = orthoflow(
        folder, "run", "studio.yaml", "-o", "good", "--set", "survey.offset_m=-3", code=0
    )
    return folder, done.stdout, done.stderr


def test_a_run_shows_every_cell_every_warning_and_its_files(
    finished: tuple[Path, str, str],
) -> None:
    folder, stdout, stderr = finished
    lines = stdout.splitlines()
    assert ["survey", "survey.offset", "ok"] in [line.split()[:3] for line in lines]
    assert "warning, survey: the plane lies behind the viewer" in lines
    assert "0 of 2 steps cached" in lines
    assert lines[-3:] == [
        "report: good/report.html",
        "record: good/run.h5",
        "orthoimage: good/products/paint/wall_0_ortho.tif",
    ]
    assert all((folder / line.partition(": ")[2]).is_file() for line in lines[-3:])
    # Without the lines on time of a machine that is busy.
    reported = [line for line in stderr.splitlines() if " so far" not in line]
    assert reported[1:3] == [
        "survey: started",
        "survey: warning: the plane lies behind the viewer",
    ]
    assert re.fullmatch(r"paint: ok in .*\(2 of 2\)", reported[-1])


def test_the_record_says_what_happened_and_names_no_folder(
    finished: tuple[Path, str, str],
) -> None:
    run = open_run(finished[0] / "good")
    assert (run.record.status, run.record.overrides) == ("ok", ("--set survey.offset_m=-3",))
    survey, paint = run.cells["survey"], run.cells["paint"]
    assert survey.params == {"offset_m": -3.0}
    assert survey.warnings == ("the plane lies behind the viewer",)
    assert survey.citations == ("https://doi.org/10.1000/workshop",)
    assert (survey.distribution, survey.distribution_version) == ("workshop", "1.0")
    assert paint.inputs["planes"].digest == survey.outputs["planes"].digest
    assert paint.inputs["planes"].source == "survey.planes"
    assert {cell.environment for cell in run.record.cells} == {
        environment.id for environment in run.record.environments
    }
    rows = {(row.cell, row.metric): row.value for row in run.metric_rows()}
    assert rows["survey", "offset_m"] == -3.0
    assert rows["paint", "wall_s"] >= 0.0
    assert str(finished[0]).encode() not in (finished[0] / "good" / "run.h5").read_bytes()


def test_a_second_run_is_cached_and_a_forced_step_runs_again(
    finished: tuple[Path, str, str],
) -> None:
    folder = finished[0]
    arguments = ("run", "studio.yaml", "--set", "survey.offset_m=-3", *INLINE)
    again = orthoflow(folder, *arguments, code=0)
    assert "2 of 2 steps cached" in again.stdout.splitlines()
    [named] = (folder / "runs").glob("studio-*")
    run, original = open_run(named), open_run(folder / "good")
    assert named.name == f"studio-{run.record.run_id}"
    assert {cell.cached_from for cell in run.record.cells} == {original.record.run_id}
    assert run.cells["survey"].outputs == original.cells["survey"].outputs
    # Early cut-off: the forced step gives equal planes, so the paint is not done again.
    forced = orthoflow(folder, *arguments, "--force", "survey", "-o", "forced")
    assert "1 of 2 steps cached" in forced.stdout.splitlines()


@pytest.mark.parametrize(
    ("method", "code", "sentence"),
    [
        ("paint.fail", 1, "no colour sticks to this plane"),
        ("paint.lacking", 4, "method paint.lacking of workshop 1.0 needs no_such_library"),
        # The root failure is that of an input.
        ("paint.plain", 2, "empty.txt is empty, expected one number"),
    ],
)
def test_a_failed_cell_leaves_a_record_a_report_and_its_exit_code(
    tmp_path: Path, method: str, code: int, sentence: str
) -> None:
    write_studio(tmp_path, method)
    (tmp_path / "empty.txt").touch()
    given = ("--input", "number=empty.txt") if code == 2 else ()
    done = orthoflow(tmp_path, "run", "studio.yaml", *given, "-o", "r", *INLINE, code=code)
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    run = open_run(tmp_path / "r")
    assert run.record.status == "failed"
    assert (tmp_path / "r" / "report.html").is_file()
    assert orthoflow(tmp_path, "verify", "r").returncode == 0
    if code == 2:
        assert run.cells["paint"].error_message == "needs survey, which failed"
        return
    assert [cell.status for cell in run.record.cells] == ["ok", "failed"]
    # An error of the method itself is reported here and in the record.
    has_trace = method == "paint.lacking"
    log = (tmp_path / "r" / "logs" / "paint.log").read_text()
    assert ("traceback: r/logs/paint.log" in done.stderr) == has_trace
    assert ("Traceback" in log) == ("Traceback" in run.cells["paint"].log) == has_trace


@pytest.mark.parametrize("number", [signal.SIGINT, *long_only(signal.SIGTERM)])
def test_an_interrupted_run_ends_with_130_and_goes_on_with_the_same_folder(
    tmp_path: Path, number: signal.Signals
) -> None:
    write_studio(tmp_path, "paint.slow")
    arguments = ("run", "studio.yaml", "--set", "survey.offset_m=2", "-o", "r")
    with subprocess.Popen(
        command(*arguments),
        cwd=tmp_path,
        env=workshop_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as running:
        assert running.stderr is not None
        seen = [next(running.stderr)]
        while not seen[-1].startswith("paint: started"):
            seen.append(next(running.stderr))
        time.sleep(1.0)
        running.send_signal(number)
        _, rest = running.communicate(timeout=30)
    assert running.returncode == 130
    assert rest.splitlines()[-2:] == [
        "report of the finished steps: r/report.html",
        "interrupted; finished steps are kept; to resume, repeat the command with -o r",
    ]
    assert "Traceback" not in rest
    assert {path.name for path in (tmp_path / "r").iterdir()} == {
        ".outline.json",
        *("figures", "journal.jsonl", "logs", "products", "report.html"),
    }
    shown = orthoflow(tmp_path, "show", "r", "--json", code=0)
    assert "skipped" in {cell["status"] for cell in json.loads(shown.stdout)["cells"]}
    page = (tmp_path / "r" / "report.html").read_text()
    assert "<li>Finished: survey</li>" in page
    assert "<li>Not reached: paint</li>" in page
    assert "<pre>orthoflow run studio.yaml --set survey.offset_m=2 -o r</pre>" in page
    assert "not finished" in page
    write_studio(tmp_path, "paint.plain")
    again = orthoflow(tmp_path, *arguments, code=0)
    assert any(line.startswith("resuming run ") for line in again.stderr.splitlines())
    assert "0 of 2 steps cached, 1 from before the interruption" in again.stdout.splitlines()
    assert ["survey", "survey.offset", "kept"] in [
        line.split()[:3] for line in again.stdout.splitlines()
    ]
    assert open_run(tmp_path / "r").cells["survey"].cached_from == ""
    assert "not finished" not in (tmp_path / "r" / "report.html").read_text()


def test_a_terminal_gets_a_live_table_and_a_reader_that_leaves_stops_nothing(
    tmp_path: Path,
) -> None:
    write_studio(tmp_path)
    controlling, terminal = pty.openpty()
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(terminal, "wb") as error, os.fdopen(writing, "wb") as closed:
        done = subprocess.Popen(
            command("run", "studio.yaml", "-o", "r", *INLINE),
            cwd=tmp_path,
            env={**workshop_environment(), "TERM": "xterm", "COLUMNS": "100", "LINES": "30"},
            stdout=closed,
            stderr=error,
        )
    shown = b""
    with os.fdopen(controlling, "rb", buffering=0) as screen, contextlib.suppress(OSError):
        while block := screen.read(65536):
            shown += block
    assert done.wait(timeout=60) == 0
    assert b"survey" in shown
    assert b"\x1b[?25h" in shown  # the cursor is visible again
    assert b"Traceback" not in shown
    assert open_run(tmp_path / "r").record.status == "ok"
