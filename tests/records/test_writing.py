"""Writing a run: the record's name comes last, and nothing half written counts as finished."""

from __future__ import annotations

import dataclasses
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import h5py
import numpy as np
import pytest
from orthoflow_provenance.verify import verify_record

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine.journal import Journal, is_running
from orthoflow.engine.plan import RunOptions, RunPlan, plan_run
from orthoflow.engine.results import FigureRef
from orthoflow.engine.scheduler import RunOutcome, execute
from orthoflow.engine.store import Store
from orthoflow.errors import DamageError, StoreError
from orthoflow.records.open import open_run, open_unfinished
from orthoflow.records.runs import Run
from orthoflow.records.write import (
    NOT_YET,
    begin_run,
    executed_and_written,
    publish_products,
    write_run,
)
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import expand_cells
from orthoflow.workflow.model import Workflow
from tests import photo_files
from tests.studios import open_studio
from tests.workshop_runs import WORKSHOP, write_studio


@dataclass(frozen=True)
class Executed:
    """A run that the engine has finished and nobody has recorded yet."""

    outcome: RunOutcome
    plan: RunPlan
    workflow: Workflow
    folder: Path
    store: Store

    def write(self, **options: object) -> Run:
        return write_run(
            self.outcome,
            self.plan,
            self.workflow,
            self.folder,
            self.store,
            **options,  # type: ignore[arg-type]
        )


@pytest.fixture
def executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Executed:
    monkeypatch.syspath_prepend(str(WORKSHOP))
    catalog = discover_catalog()
    workflow = load_workflow(write_studio(tmp_path), catalog)
    store = Store(tmp_path / "store")
    options = RunOptions(executor="inline")
    plan = plan_run(expand_cells(workflow, catalog), workflow, catalog, store, options)
    outcome = execute(plan, tmp_path / "run", store, run_id="20260102-abc")
    return Executed(outcome, plan, workflow, tmp_path / "run", store)


@pytest.mark.parametrize("n_lost", [0, 1, 3, 4])
@pytest.mark.parametrize("at", ["execute", "write"])
def test_what_the_store_lost_is_computed_again_three_times(n_lost: int, at: str) -> None:
    steps = {"execute": Mock(return_value="outcome"), "write": Mock(return_value="run")}
    steps[at].side_effect = [*[DamageError("the store lost it")] * n_lost, DEFAULT]
    if n_lost == 4:
        with pytest.raises(DamageError):
            executed_and_written(**steps)
    else:
        assert executed_and_written(**steps) == ("outcome", "run")
    assert steps["execute"].call_count == min(n_lost + 1, 4)


def test_the_record_has_no_name_while_the_report_is_written(executed: Executed) -> None:
    seen: list[tuple[bool, int]] = []

    def look(run: Run) -> None:
        image = run.product("paint", "orthoimages")
        seen.append(((run.folder / "run.h5").exists(), len(image.images)))  # type: ignore[attr-defined]
        assert run.orthoimages[0].is_file()
        # Nor does anybody else go on with the run meanwhile.
        assert is_running(run.folder)

    run = executed.write(before_finish=look)
    assert seen == [(False, 1)]
    assert (executed.folder / "run.h5").is_file()
    # Copies do not share their bytes with the store.
    [planes] = [path for path in run.files["survey"] if path.name == "planes.json"]
    [stored, *_] = executed.store.published_files(run.cells["survey"].outputs["planes"].digest)
    before = stored.read_bytes()
    planes.write_text("edited", encoding="utf-8")
    assert stored.read_bytes() == before


def test_a_failing_report_leaves_the_run_unfinished_and_the_next_attempt_cleans_up(
    executed: Executed,
) -> None:
    def fail(_run: Run) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(StoreError, match=r"(?i)cannot write to .*: no space"):
        executed.write(before_finish=fail)
    assert not (executed.folder / "run.h5").exists()
    (executed.folder / "products" / "left-over").mkdir()
    (executed.folder / ".run.h5.unfinished.1234.part").touch()
    executed.write()
    # Systems other than Linux lock by empty files beside.
    names = {path.name for path in executed.folder.iterdir() if path.suffix != ".lock"}
    assert names == {"journal.jsonl", "logs", "products", "run.h5"}
    assert not (executed.folder / "products" / "left-over").exists()


def test_a_run_that_is_not_finished_opens_as_far_as_it_is(executed: Executed) -> None:
    begin_run(executed.plan, executed.workflow, executed.folder, executed.store, "later")
    journal = executed.folder / "journal.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    [end] = [
        index
        for index, line in enumerate(lines)
        if json.loads(line).get("address") == "survey" and json.loads(line)["event"] == "finished"
    ]
    # As at the moment at which the first step had ended.
    journal.write_text("".join(lines[: end + 1]))
    run = open_run(executed.folder)
    assert run.record.run_id == executed.outcome.run_id
    assert {address: cell.status for address, cell in run.cells.items()} == {
        "survey": "ok",
        "paint": "skipped",
    }
    assert run.cells["paint"].error_message == "not computed yet"
    assert run.product("survey", "planes") is not None
    assert not run.is_finished
    assert [path.name for path in run.files["survey"]]
    assert verify_record(run.path) == ()
    assert run.home_folder == executed.folder
    # It may be going on.
    assert not (executed.folder / "products").exists()
    shown = open_unfinished(executed.folder, publish=True)
    assert shown.folder == executed.folder
    assert (executed.folder / "products" / "survey" / "planes.json").is_file()
    assert not list(executed.folder.glob("*run.h5*"))
    journal.write_text("".join(lines))
    finished = executed.write()
    assert open_run(executed.folder).record == finished.record
    assert open_run(executed.folder).is_finished
    assert not list(executed.folder.glob(".outline*"))


@pytest.mark.parametrize(
    ("error_type", "expected"),
    [
        ("MethodError", ("failed", "MethodError", "failed")),
        ("CancelledStepError", ("skipped", NOT_YET, "ok")),
    ],
)
def test_an_unfinished_run_names_what_failed_and_not_what_was_interrupted(
    executed: Executed, error_type: str, expected: tuple[str, str, str]
) -> None:
    begin_run(executed.plan, executed.workflow, executed.folder, executed.store, "later")
    with Journal(executed.folder, executed.plan.name) as journal:
        facts = {"key": "0" * 64, "status": "failed", "error": "no paint"}
        journal.write("finished", address="paint", error_type=error_type, **facts)
    run = open_run(executed.folder)
    paint = run.cells["paint"]
    assert (paint.status, paint.error_type, run.record.status) == expected


def test_what_cannot_be_recorded_leaves_the_run_unfinished(executed: Executed) -> None:
    def with_paint(**facts: object) -> Executed:
        results = dict(executed.outcome.results)
        results["paint"] = dataclasses.replace(results["paint"], **facts)
        outcome = dataclasses.replace(executed.outcome, results=results)
        return dataclasses.replace(executed, outcome=outcome)

    figure = FigureRef(name="plan", caption="", media_type="image/png", sha256="0" * 64)
    with pytest.raises(StoreError, match=r"needs \(the figure plan is damaged\)"):
        with_paint(figures=(figure,)).write()
    # The disk refused a step.
    refused = with_paint(status="failed", error_type="StoreError", error_message="I/O error")
    with pytest.raises(StoreError, match=r"paint failed: I/O.* repeat the command with -o "):
        refused.write()
    shutil.rmtree(executed.store.objects)
    with pytest.raises(StoreError, match="has no intact product sha256:"):
        executed.write()
    assert not (executed.folder / "run.h5").exists()


def test_what_a_photo_says_of_people_and_places_stays_in_the_photo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studio = open_studio(tmp_path, monkeypatch)
    secrets = {0x013B: "Jane Doe", 0x8298: "Doe Studios", 0x010E: "at 50.0412N 21.9991E"}
    serial = {0xA431: "SN-4711-0815", 0xA430: "Owner Doe", 0xA435: "LENS-0042"}
    maker = {photo_files.MAKE: "Maker", photo_files.MODEL: "Model"}
    block = photo_files.exif_block({**maker, **secrets}, {photo_files.FOCAL_35MM: 36, **serial})
    photo_files.write(tmp_path, {"a.jpg": photo_files.jpeg(photo_files.picture(), block)})
    steps = "orthoflow: 1\ninputs: {photos: {files: a.jpg}}\nsteps:\n"
    (tmp_path / "p.yaml").write_text(
        steps + "  shots: {use: read.photos, in: {files: inputs.photos}}\n"
    )
    assert studio("run", "p.yaml", "-o", "run").exit_code == 0
    assert studio("export", "run", "--to", "ro-crate", "-o", "crate").exit_code == 0
    said = {"run.h5": _everything_in(tmp_path / "run" / "run.h5")}
    for path in (*(tmp_path / "run").rglob("*"), *(tmp_path / "crate").rglob("*")):
        if path.is_file():
            said[str(path)] = path.read_bytes()
    for text in (*secrets.values(), *serial.values()):
        assert not [name for name, content in said.items() if text.encode() in content], text
    # Who asks for everything gets everything.
    assert studio("run", "p.yaml", "-o", "whole", "--embed").exit_code == 0
    assert b"SN-4711-0815" in _everything_in(tmp_path / "whole" / "run.h5")


def _everything_in(path: Path) -> bytes:
    """All values of a record, unpacked."""
    found: list[bytes] = []

    def add(name: str, item: h5py.Group | h5py.Dataset) -> None:
        found.extend(str(value).encode() for value in item.attrs.values())
        if isinstance(item, h5py.Dataset):
            found.append(np.asarray(item[()]).tobytes())

    with h5py.File(path) as file:
        file.visititems(add)
    return b"\n".join(found)


def test_what_an_earlier_run_left_is_never_published(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = tmp_path / "products" / "old" / "walls.csv"
    old.parent.mkdir(parents=True)
    old.write_text("of a run that was broken off")
    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", Mock(side_effect=OSError(5, "Input/output error")))
        with pytest.raises(StoreError, match="Input/output error"):
            publish_products(tmp_path, (), {}, "r")
    published = [file.path for file in publish_products(tmp_path, (), {}, "r")]
    assert published == ["products/metrics.csv"]
