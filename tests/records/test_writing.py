"""Writing a run: the record's name comes last, and nothing half written counts as finished."""

from __future__ import annotations

import dataclasses
import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from orthoflow.catalog import discover_catalog
from orthoflow.engine import RunOptions, RunOutcome, RunPlan, Store, execute, plan_run
from orthoflow.engine.results import FigureRef
from orthoflow.errors import StoreError
from orthoflow.records import Run, open_run, verify_run, write_run
from orthoflow.workflow import Workflow, expand_cells, load_workflow
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


def test_a_run_keeps_the_id_it_was_given(executed: Executed) -> None:
    assert executed.outcome.run_id == "20260102-abc"
    assert executed.write().record.run_id == "20260102-abc"


def test_what_is_returned_is_what_is_read_again(executed: Executed) -> None:
    assert executed.write() == open_run(executed.folder)
    assert verify_run(executed.folder).findings == ()


def test_skipped_and_wired_inputs_are_told_apart(executed: Executed) -> None:
    run = executed.write()
    assert run.record.inputs[0].files == ()
    assert run.cells["survey"].inputs == {}
    assert run.cells["paint"].inputs["planes"].source == "survey.planes"


def test_the_record_has_no_name_while_the_report_is_written(executed: Executed) -> None:
    seen: list[tuple[bool, int]] = []

    def look(run: Run) -> None:
        image = run.product("paint", "orthoimages")
        seen.append(((run.folder / "run.h5").exists(), len(image.images)))  # type: ignore[attr-defined]
        assert run.orthoimages[0].is_file()

    executed.write(before_finish=look)
    assert seen == [(False, 1)]
    assert (executed.folder / "run.h5").is_file()


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
    names = {path.name for path in executed.folder.iterdir()}
    assert names == {"journal.jsonl", "logs", "products", "run.h5"}
    assert not (executed.folder / "products" / "left-over").exists()


def test_copies_do_not_share_their_bytes_with_the_store(executed: Executed) -> None:
    run = executed.write()
    [planes] = [path for path in run.files["survey"] if path.name == "planes.json"]
    digest = run.cells["survey"].outputs["planes"].digest
    before = executed.store.published_files(digest)[0].read_bytes()
    planes.write_text("edited", encoding="utf-8")
    assert executed.store.published_files(digest)[0].read_bytes() == before


def test_a_product_that_the_store_lost_is_named(executed: Executed) -> None:
    shutil.rmtree(executed.store.objects)
    with pytest.raises(StoreError, match="the record cannot be assembled from the store"):
        executed.write()
    assert not (executed.folder / "run.h5").exists()


def test_a_figure_that_the_store_lost_is_named(executed: Executed) -> None:
    figure = FigureRef(name="plan", caption="", media_type="image/png", sha256="0" * 64)
    results = dict(executed.outcome.results)
    results["paint"] = dataclasses.replace(results["paint"], figures=(figure,))
    outcome = dataclasses.replace(executed.outcome, results=results)
    broken = dataclasses.replace(executed, outcome=outcome)
    with pytest.raises(StoreError, match="lost the figure plan; run again and it is drawn anew"):
        broken.write()
