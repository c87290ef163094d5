"""Records of an older encoding of a product are opened, compared and replayed by a later one."""

from __future__ import annotations

from dataclasses import replace

import pytest

from orthoflow.engine.plan import RunOptions, plan_run
from orthoflow.engine.scheduling import execute
from orthoflow.engine.store import Store
from orthoflow.records.distances import ProductDistance, RunProducts, product_distances
from orthoflow.records.replaying import UnreplayableRunError, plan_replay
from orthoflow.records.runs import Run
from orthoflow.records.writing import write_run
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import expand_cells
from tests.engine_world import World, forget_toys

WORKFLOW = """
orthoflow: 1
name: toy
seed: 7
steps:
  first: {use: make.range, params: {count: 20}}
  noise: {use: work.noise, in: {numbers: first.numbers}}
"""
INLINE = RunOptions(executor="inline")
# What was a note became a typed field, and a field came that the older encoding does not know.
NEWER = """
    encoding_version: ClassVar[int] = 2
    values: NDArray[np.float64]
    remark: str = ""
    origin: str | None = "computed"

    @classmethod
    def upgraded(cls, payload):
        metadata = dict(payload.metadata)
        metadata["remark"] = metadata.pop("note")
        return dataclasses.replace(payload, encoding_version=2, metadata=metadata)
"""


@pytest.fixture
def older(world: World) -> Run:
    """A run recorded before the type moved on; the installed type is of the later encoding."""
    run = _recorded(world, "older")
    assert {output.encoding_version for output in _outputs(run)} == {1}
    products = world.site / "toy_plugin" / "products.py"
    text = products.read_text()
    before = '    values: NDArray[np.float64]\n    note: str = ""\n'
    assert before in text
    products.write_text(
        text.replace(before, NEWER).replace("import numpy", "import dataclasses\nimport numpy")
    )
    forget_toys()
    return run


def _recorded(world: World, into: str, *sets: str) -> Run:
    path = world.folder / "toy.yaml"
    path.write_text(WORKFLOW)
    catalog = world.catalog()
    workflow = load_workflow(path, catalog, sets=sets)
    # Each run with a store of its own: what is in one is not made anew for a later encoding.
    store = Store(world.folder / f"{into}.store")
    plan = plan_run(expand_cells(workflow, catalog), workflow, catalog, store, INLINE)
    outcome = execute(plan, world.folder / into, store)
    return write_run(outcome, plan, workflow, world.folder / into, store)


def _outputs(run: Run):  # type: ignore[no-untyped-def]
    return [output for cell in run.record.cells for output in cell.outputs.values()]


def _distances(world: World, left: Run, right: Run) -> tuple[ProductDistance, ...]:
    stores = tuple(Store(world.folder / f"{name}.store") for name in ("older", "newer"))
    sides = (RunProducts(run=run, stores=stores) for run in (left, right))
    return product_distances(*sides, tuple(left.cells), world.catalog())


def test_a_product_of_an_older_encoding_is_read_as_the_present_one_has_it(
    world: World, older: Run
) -> None:
    cls = world.catalog().product_class("numbers")
    product = cls.from_payload(older.payload("first", "numbers"))
    assert product.to_payload().encoding_version == 2
    assert product.to_payload().metadata["remark"] == ""


def test_a_mere_difference_of_encodings_is_none(world: World, older: Run) -> None:
    newer = _recorded(world, "newer", "first.count=20")
    assert {output.encoding_version for output in _outputs(newer)} == {2}
    for distance in (*_distances(world, older, newer), *_distances(world, newer, older)):
        assert distance.left != distance.right
        assert (distance.verdict, distance.distances) == ("identical", ())


def test_arrays_of_different_encodings_are_compared(world: World, older: Run) -> None:
    newer = _recorded(world, "newer", "first.count=21")
    first, _ = _distances(world, older, newer)
    assert first.verdict == "different"
    assert first.reason.startswith("values: float64 of shape (20,) against float64 of (21,)")


def test_products_of_an_older_encoding_are_found_in_a_store(world: World, older: Run) -> None:
    newer = _recorded(world, "newer", "first.count=20")
    cells = tuple(
        replace(
            cell,
            outputs={port: replace(out, embedded=False) for port, out in cell.outputs.items()},
        )
        for cell in older.record.cells
    )
    bare = replace(older, record=replace(older.record, cells=cells))
    assert {item.verdict for item in _distances(world, bare, newer)} == {"identical"}


def test_a_run_of_an_older_encoding_is_replayed(world: World, older: Run) -> None:
    store = Store(world.folder / "fresh")
    replay = plan_replay(older, world.catalog(), store, INLINE)
    outcome = execute(replay.plan, world.folder / "again", store)
    made = write_run(outcome, replay.plan, replay.workflow, world.folder / "again", store)
    assert {item.verdict for item in _distances(world, older, made)} == {"identical"}


def test_a_run_of_a_newer_encoding_is_not(world: World, older: Run) -> None:
    newer = _recorded(world, "newer", "first.count=20")
    products = world.site / "toy_plugin" / "products.py"
    products.write_text(products.read_text().replace("ClassVar[int] = 2", "ClassVar[int] = 1"))
    forget_toys()
    message = "product type numbers: the installed one has encoding version 1, the record has 2"
    with pytest.raises(UnreplayableRunError, match=message):
        plan_replay(newer, world.catalog(), Store(world.folder / "fresh"), INLINE)
