"""A replay takes seeds, repeats and parameters as recorded, whatever today's code would derive."""

from __future__ import annotations

import dataclasses

import pytest

from orthoflow.engine.plan import RunOptions, RunPlan, plan_run
from orthoflow.engine.scheduler import RunOutcome, execute
from orthoflow.engine.store import Store
from orthoflow.errors import RecordError
from orthoflow.records.replay import plan_replay
from orthoflow.records.runs import Run
from orthoflow.records.write import write_run
from orthoflow.workflow import expand as cells
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import expand_cells
from orthoflow.workflow.model import Workflow
from tests.engine_world import World

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
