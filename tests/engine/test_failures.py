"""Whatever a method does, its cell fails with a reason and the rest of the run is complete."""

from __future__ import annotations

import errno
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from orthoflow.engine import measuring as machine_memory
from orthoflow.engine.measuring import (
    process_memory,
    tree_memory,
)
from orthoflow.engine.results import CellResult
from orthoflow.errors import ArgumentError
from tests.engine_world import World, has_ended, toy_world
from tests.optional import skip

MIB = 1 << 20


def company(bad: str, timeout: str = "") -> str:
    """A bad method beside good ones, with a step behind each."""
    limit = f", timeout: {timeout}" if timeout else ""
    return f"""
steps:
  first: {{use: make.range}}
  second:
    in: {{numbers: first.numbers}}
    variants:
      bad: {{use: work.{bad}{limit}}}
      good: {{use: work.add}}
  third: {{use: work.add, in: {{numbers: second.numbers}}}}
compare: {{design: product}}
"""


def bad_result(world: World, bad: str, timeout: str = "", **options: object) -> CellResult:
    """Run a bad method in good company; the company must come through."""
    outcome = world.run(company(bad, timeout), **options)  # type: ignore[arg-type]
    good = ["first", "second@second=good", "third@second=good"]
    assert [outcome.results[address].status for address in good] == ["ok"] * 3
    behind = outcome.results["third@second=bad"]
    assert behind.status == "skipped"
    assert behind.error_message == "needs second@second=bad, which failed"
    assert not list(world.store.scratch.iterdir())
    result = outcome.results["second@second=bad"]
    assert result.status == "failed"
    assert result.outputs == {}
    assert outcome.exit_code == result.exit_code
    return result


TOYS = "of toy-plugin 1.0"
RAISED = {
    "raises": (
        "MethodError",
        f"method work.raises {TOYS} failed unexpectedly: KeyError: 'missing'",
        1,
    ),
    "refuses": ("MethodError", "no number is large enough", 1),
    "unreadable": ("InputError", "a.csv:2: no number; a.csv:3: two numbers", 2),
    "needs_library": (
        "PluginError",
        (
            f"method work.needs_library {TOYS} needs no_such_library, which is missing or "
            "fails to import: No module named 'no_such_library'"
        ),
        4,
    ),
    "changes_input": (
        "MethodError",
        (
            f"method work.changes_input {TOYS} writes to a read-only array, probably one of "
            "its inputs (output array is read-only); it must work on a copy"
        ),
        1,
    ),
    "wrong_type": (
        "MethodError",
        f"method work.wrong_type {TOYS} must give a numbers on its port numbers, got Strangers",
        1,
    ),
    "wrong_out": (
        "MethodError",
        f"method work.wrong_out {TOYS} must return its Out, got Numbers",
        1,
    ),
    "bad_param": ("ProductError", "metric nan must be finite, got nan: leave it out instead", 1),
    "leave": (
        "MethodError",
        f"method work.leave {TOYS} tried to end the program (bye)",
        1,
    ),
    "unstorable": (
        "ProductError",
        (
            "a numbers cannot be stored: an array of type object cannot be stored, only bool, "
            "integers and floats of 2, 4 or 8 bytes can"
        ),
        1,
    ),
}
BUGS = ("raises", "needs_library", "changes_input", "leave")


@pytest.mark.parametrize("bad", RAISED)
def test_what_a_method_raises_becomes_one_sentence(world: World, bad: str) -> None:
    result = bad_result(world, bad, executor="inline")
    # Where in the method it happened.
    said = re.sub(r" \(works\.py:\d+\)$", "", result.error_message)
    assert (result.error_type, said, result.exit_code) == RAISED[bad]
    assert (said != result.error_message) == (bad == "bad_param")
    assert "Traceback" not in result.error_message
    # What is none of our errors is for the method's author, who finds it in log and record.
    assert ("Traceback" in result.log, result.is_bug) == (bad in BUGS, bad in BUGS)


# What the disk refuses: the kind of error, of what lies in the scratch folder and elsewhere.
REFUSED = {
    errno.ENOSPC: ("StepFailedError", "StepFailedError"),
    errno.EDQUOT: ("StepFailedError", "StepFailedError"),
    errno.EFBIG: ("StepFailedError", "StepFailedError"),
    errno.EIO: ("StoreError", "MethodError"),
    errno.ESTALE: ("StoreError", "MethodError"),
    errno.EROFS: ("StoreError", "MethodError"),
    errno.EACCES: ("MethodError", "MethodError"),
}


def test_what_disk_and_memory_refuse_is_an_error_of_whoever_is_at_fault(world: World) -> None:
    steps = "  none: {use: work.no_memory, in: {numbers: a.numbers}}\n" + "".join(
        f"  e{number}-{is_own}: {{use: work.bad_disk, in: {{numbers: a.numbers}}, "
        f"params: {{amount: {number}, steps: {is_own}}}}}\n"
        for number in REFUSED
        for is_own in (0, 1)
    )
    results = world.run(f"steps:\n  a: {{use: make.range}}\n{steps}", executor="inline").results
    for number, (own, other) in REFUSED.items():
        for address, kind in ((f"e{number}-1", own), (f"e{number}-0", other)):
            assert results[address].error_type == kind, (address, results[address].error_message)
            if kind in ("StoreError", "StepFailedError"):
                expected = f"cannot write to {world.store.folder}: "
                assert results[address].error_message.startswith(expected)
    assert results["none"].error_type == "StepFailedError"
    assert results["none"].error_message.startswith(
        f"method work.no_memory {TOYS} needed more memory than was available: Unable to allocate"
    )


CRASHES = {
    "segfault": f"method work.segfault {TOYS} crashed (segmentation fault) while using ",
    "abort": f"method work.abort {TOYS} crashed (aborted) while using ",
    "quit": (
        f"method work.quit {TOYS} ended its process without a result (exit status 7); its log ends "
        "with: last words"
    ),
    "hang": f"method work.hang {TOYS} exceeded its timeout of 1.5 s and was stopped",
}


def test_crashes_fail_their_cells_alone(world: World) -> None:
    variants = "".join(f"      {bad}: {{use: work.{bad}}}\n" for bad in CRASHES)
    variants = variants.replace("work.hang", "work.hang, timeout: 1.5s")
    outcome = world.run(company("refuses").replace("      good:", f"{variants}      good:"))
    results = outcome.results
    for bad, message in CRASHES.items():
        result = results[f"second@second={bad}"]
        assert (result.status, result.error_type) == ("failed", "StepFailedError")
        assert result.error_message.startswith(message)
        assert result.started < result.ended
        behind = results[f"third@second={bad}"].error_message
        assert behind == f"needs second@second={bad}, which failed"
    assert results["second@second=good"].status == "ok"
    assert results["third@second=good"].status == "ok"
    assert "string_at" in results["second@second=segfault"].log
    assert 1.5 <= results["second@second=hang"].wall_s < 30
    assert outcome.exit_code == 1


def test_a_method_that_ignores_being_asked_is_killed(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orthoflow.engine.local._GRACE_S", 0.5)
    result = bad_result(world, "stubborn", "1.5s")
    assert "exceeded its timeout of 1.5 s" in result.error_message


def test_processes_that_a_method_leaves_behind_are_killed(world: World) -> None:
    outcome = world.run(
        "steps: {a: {use: make.range}, b: {use: work.spawns, in: {numbers: a.numbers}}}"
    )
    (process_id,) = world.values(outcome, "b")
    assert has_ended(int(process_id))


def test_a_method_that_eats_all_memory_is_stopped_and_the_coordinator_lives(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A machine of 8 GiB with 1.5 GiB left, less what the steps take.
    def little_memory() -> SimpleNamespace:
        taken = tree_memory(os.getpid()) - process_memory()
        return SimpleNamespace(available=1536 * MIB - taken, total=8192 * MIB)

    monkeypatch.setattr(machine_memory.psutil, "virtual_memory", little_memory)
    result = bad_result(world, "eat")
    assert result.error_type == "StepFailedError"
    assert result.error_message == (
        f"method work.eat {TOYS} needed more memory than the machine has "
        f"({result.peak_rss_mib / 1024:.1f} GiB when stopped); use less data or coarser "
        "parameters"
    )
    # What other children of this test hold (the server of processes) is missing from it.
    assert 500 < result.peak_rss_mib < 2000


# Full disk ----------------------------------------------------------------------------------------


@pytest.fixture
def tiny_world(tmp_path: Path) -> Iterator[World]:
    """Toys whose store lies on a disk of 2 MiB."""
    disk = tmp_path / "store"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "none", str(disk)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        skip("right", "a file system is mounted by root only")
    with toy_world(tmp_path) as opened:
        yield opened
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize("executor", ["inline", "local"])
def test_an_output_too_large_for_the_disk_fails_its_cell_in_a_sentence(
    tiny_world: World, executor: str
) -> None:
    steps = """
steps:
  large: {use: make.range, params: {count: 1000000}}
  small: {use: make.range}
  behind: {use: work.add, in: {numbers: small.numbers}}
"""
    outcome = tiny_world.run(steps, executor=executor)
    assert [result.status for result in outcome.results.values()] == ["failed", "ok", "ok"]
    failed = outcome.results["large"]
    assert failed.error_type == "StoreError"
    assert failed.error_message.startswith(
        f"cannot write to {tiny_world.store.folder}: No space left on device"
    )


def test_a_run_folder_that_cannot_be_written_is_one_sentence(world: World) -> None:
    plan_first = "steps: {a: {use: make.range}}"
    (world.folder / "file").write_text("no folder")
    with pytest.raises(
        ArgumentError, match=r"file/run cannot be created, because .*/file is a file; "
    ):
        world.run(plan_first, into="file/run")
