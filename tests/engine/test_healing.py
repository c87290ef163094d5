"""What is damaged is computed again, as little of it as is needed, whenever the damage happens."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from orthoflow.engine.cleaning import check_store
from orthoflow.engine.journal import CellReported, CellStarted, RunEvent
from orthoflow.engine.scheduler import RunOutcome
from orthoflow.errors import StoreError
from tests.engine_world import World, digests

STEPS = """
steps:
  scan: {use: make.scan}
  means: {use: thin.means, in: {scan: scan.scan}}
  noise: {use: work.noise, in: {numbers: means.numbers}}
"""
MORE = """\
  more: {use: work.draws, in: {numbers: noise.numbers}}
  other: {use: thin.means, in: {scan: scan.scan}}
"""


def run(world: World, steps: str, **options: Any) -> RunOutcome:
    return world.run(steps, **{"executor": "inline", **options})


def product_file(world: World, outcome: RunOutcome, address: str) -> Path:
    (ref,) = outcome.results[address].outputs.values()
    return world.store.objects / ref.digest.removeprefix("sha256:") / "product.h5"


def flip(path: Path) -> None:
    """Damage a byte among the last ones, where arrays are, without a trace in time and size."""
    before = path.stat()
    content = bytearray(path.read_bytes())
    content[-8] ^= 0x10
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def computed(outcome: RunOutcome) -> set[str]:
    return set(outcome.results) - set(outcome.cached)


def damaged(world: World) -> set[str]:
    """Cells whose stored results were reported as damaged in the last run."""
    return {
        event.address
        for event in world.events
        if isinstance(event, CellReported)
        and event.event.diagnostic
        and event.event.diagnostic.code == "stored-result-damaged"
    }


def test_a_damaged_mapped_scan_is_computed_again_before_a_step_reads_it(world: World) -> None:
    first = run(world, STEPS)
    flip(product_file(world, first, "scan"))
    again = run(world, STEPS + MORE, into="again", force=("means",))
    assert again.status == "ok"
    assert {**digests(again), **digests(first)} == digests(again)
    assert computed(again) == {"scan", "means", "more"}
    assert damaged(world) == {"scan"}
    assert (computed(run(world, STEPS + MORE, into="third")), damaged(world)) == (set(), set())


def test_a_damaged_scan_that_no_step_needs_is_left_alone(world: World) -> None:
    first = run(world, STEPS)
    flip(product_file(world, first, "scan"))
    more = "  more: {use: work.draws, in: {numbers: noise.numbers}}\n"
    again = run(world, STEPS + more, into="b")
    assert (computed(again), damaged(world)) == ({"more"}, set())
    found = check_store(world.store)
    digest = digests(first)["scan.scan"]
    assert (found.n_results, found.n_objects) == (len(again.results) - 1, len(again.results) - 1)
    what = ["product.h5", f"objects/{digest[7:19]}/object.json"]
    assert [item.what for item in found.damaged] == what
    assert not product_file(world, first, "scan").exists()
    assert check_store(world.store).damaged == ()


@pytest.mark.parametrize(
    ("executor", "harm"),
    [("inline", Path.unlink), ("local", lambda path: os.truncate(path, 3000))],
    ids=["removed", "truncated"],
)
def test_damage_between_plan_and_use_is_noticed(
    world: World, executor: str, harm: Callable[[Path], object]
) -> None:
    first = run(world, STEPS)
    plan = world.plan(STEPS + MORE, force=("means",), executor=executor)
    harm(product_file(world, first, "scan"))
    again = world.execute(plan, "again")
    assert again.status == "ok"
    assert {**digests(again), **digests(first)} == digests(again)
    assert damaged(world) == {"scan"}


def test_a_step_that_fails_over_damage_is_repeated_and_its_method_not_blamed(world: World) -> None:
    first = run(world, STEPS)
    path = product_file(world, first, "scan")
    plan = world.plan(STEPS, force=("means",), executor="inline")
    harmed = []

    def harm_behind_the_check(event: RunEvent) -> None:
        # The check is over when a step starts; it has not read anything yet.
        if isinstance(event, CellStarted) and event.address == "means" and not harmed:
            harmed.append(event)
            os.truncate(path, 3000)

    again = world.execute(plan, "again", listen=harm_behind_the_check)
    assert again.status == "ok"
    assert digests(again) == digests(first)
    assert computed(again) == {"scan", "means"}


def test_what_is_computed_again_and_differs_takes_what_follows_along(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with a method that never gives the same bits twice."""
    first = run(world, STEPS)
    flip(product_file(world, first, "means"))
    plan = world.plan(STEPS + MORE, executor="inline")
    from toy_plugin import works

    same = works.Means.run

    def other(self: object, inputs: object, params: object, ctx: object) -> object:
        numbers = same(self, inputs, params, ctx).numbers
        return works.Means.Out(numbers=dataclasses.replace(numbers, values=numbers.values + 1.0))

    monkeypatch.setattr(works.Means, "run", other)
    flip(product_file(world, first, "noise"))
    again = world.execute(plan, "again")
    assert again.status == "ok"
    assert digests(again)["means.numbers"] != digests(first)["means.numbers"]
    (given,) = again.results["noise"].inputs.values()
    assert given.digest == digests(again)["means.numbers"]


def test_a_result_file_that_is_damaged_is_made_again(world: World) -> None:
    first = run(world, STEPS)
    path = world.store.results / f"{first.results['noise'].key}.json"
    text = path.read_text()
    # Still JSON, still of the right shape, and wrong.
    path.write_text(text.replace('"wall_s":0', '"wall_s":9'))
    assert path.read_text() != text
    again = run(world, STEPS, into="again")
    assert (computed(again), damaged(world)) == ({"noise"}, {"noise"})


# Reading without a run ----------------------------------------------------------------------------


def test_a_store_that_cannot_be_written_still_tells_good_from_damaged(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    from toy_plugin.products import Numbers, Scan

    first = run(world, STEPS)
    flip(product_file(world, first, "scan"))

    def refuse(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("pathlib.Path.rename", refuse)
    store = world.store
    assert store.get_product(digests(first)["means.numbers"], Numbers).values.size == 8
    with pytest.raises(
        StoreError, match=r"objects/.* is damaged, but cannot be removed: .*Read-only"
    ):
        store.get_product(digests(first)["scan.scan"], Scan)
