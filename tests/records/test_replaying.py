"""A replay takes seeds, repeats and parameters as recorded; a lone record has its rasters again."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from orthoflow.engine.plan import RunOptions, RunPlan, plan_run
from orthoflow.engine.scheduler import RunOutcome, execute
from orthoflow.engine.store import Store
from orthoflow.errors import RecordError
from orthoflow.files.geotiff import RasterParts
from orthoflow.products import Orthoimages
from orthoflow.records.open import open_run
from orthoflow.records.replay import plan_replay
from orthoflow.records.runs import Run, published_state
from orthoflow.records.write import with_files, write_run
from orthoflow.workflow import expand as cells
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import expand_cells
from orthoflow.workflow.model import Workflow
from tests.drawing_runs import WALL, write_drawing_run
from tests.engine_world import World
from tests.report_runs import without_products

WORKFLOW = """
orthoflow: 1
name: toy
seed: 7
steps:
  first: {use: make.range, params: {count: 200}}
  draw:
    in: {numbers: first.numbers}
    variants:
      once: {use: work.noise}
      often: {use: work.noise, repeat: 3}
  last: {use: work.add, in: {numbers: draw.numbers}}
compare: {design: product, baseline: {draw: once}}
"""
INLINE = RunOptions(executor="inline")


def executed(world: World) -> tuple[RunOutcome, RunPlan, Workflow]:
    path = world.folder / "toy.yaml"
    path.write_text(WORKFLOW)
    catalog = world.catalog()
    workflow = load_workflow(path, catalog)
    plan = plan_run(expand_cells(workflow, catalog), workflow, catalog, world.store, INLINE)
    return execute(plan, world.folder / "run", world.store), plan, workflow


def recorded(world: World) -> Run:
    return write_run(*executed(world), world.folder / "run", world.store)


def digests(outcome: RunOutcome) -> dict[str, str]:
    return {
        address: result.outputs["numbers"].digest for address, result in outcome.results.items()
    }


def test_seeds_of_repeats_are_those_of_the_record(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = recorded(world)
    assert len({cell.seed for cell in run.record.cells if cell.step == "draw"}) == 3
    # A later version that derives seeds in another way would draw other numbers.
    monkeypatch.setattr(cells, "derive_seed", lambda *_: 0)
    store = Store(world.folder / "fresh")
    replay = plan_replay(run, world.catalog(), store, INLINE)
    outcome = execute(replay.plan, world.folder / "again", store)
    assert digests(outcome) == {
        address: cell.outputs["numbers"].digest for address, cell in run.cells.items()
    }
    assert not outcome.cached
    made = write_run(outcome, replay.plan, replay.workflow, world.folder / "again", store)
    assert made.record.workflow_resolved == run.record.workflow_resolved
    assert [cell.repeat for cell in made.record.cells] == [cell.repeat for cell in run.record.cells]
    assert replay.notes == ()


def test_another_code_of_a_method_is_noted_and_not_refused(world: World) -> None:
    (world.site / "toy_plugin-1.0.dist-info" / "direct_url.json").write_text("{}")
    run = recorded(world)
    works = world.site / "toy_plugin" / "works.py"
    works.write_text(works.read_text() + "\nCHANGED = True\n")
    replay = plan_replay(run, world.catalog(), Store(world.folder / "fresh"), INLINE)
    assert "work.noise: its code differs from the record, although both have result version 1" in (
        replay.notes
    )


@pytest.mark.filterwarnings("ignore:Pydantic serializer warnings")  # of what is hostile
def test_a_record_whose_workflow_asks_for_the_impossible_is_refused(
    world: World,
) -> None:
    outcome, plan, workflow = executed(world)
    last = workflow.steps["last"]
    asking = dataclasses.replace(last.variants[0], cores=-5)
    steps = {**workflow.steps, "last": dataclasses.replace(last, variants=(asking,))}
    hostile = dataclasses.replace(workflow, steps=steps)
    run = write_run(outcome, plan, hostile, world.folder / "run", world.store)
    said = r"the resolved workflow cannot be read: steps\.last\.variants\.0\.cores: .*or equal to 1"
    with pytest.raises(RecordError, match=said):
        plan_replay(run, world.catalog(), Store(world.folder / "fresh"), INLINE)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drawing_run(tmp_path_factory.mktemp("whole") / "run")


@pytest.fixture
def alone(run: Path, tmp_path: Path) -> Run:
    (tmp_path / "court.h5").write_bytes((run / "run.h5").read_bytes())
    return open_run(tmp_path / "court.h5")


def test_rasters_are_made_of_the_products_and_go_away_again(alone: Run) -> None:
    said: list[str] = []
    with with_files(alone, said.append) as found:
        assert found.path == alone.path
        assert found.folder != alone.folder
        (ortho,) = found.orthoimages
        assert ortho.name == f"wall_{WALL}_ortho.tif"
        product = alone.product("mosaic", "orthoimages")
        assert isinstance(product, Orthoimages)
        with RasterParts(ortho) as raster:
            assert raster.shape == product.images[0].frame.shape
        # What was made is what the run now calls its own.
        states = {published_state(found.folder, file) for file in found.record.published}
        assert states == {"same"}
    left_out = "and other published files are omitted"
    made_anew = "its rasters are recreated from its products"
    assert said == [f"{alone.path} has no files next to it: {made_anew}, {left_out}"]
    assert not ortho.exists()


def test_products_that_are_not_in_the_record_make_no_files(alone: Run) -> None:
    bare = without_products(alone)
    with with_files(bare) as found:
        assert found is bare
