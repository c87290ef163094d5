"""Whatever a method does, its cell fails with a reason and the rest of the run is complete."""

from __future__ import annotations

import errno
import json
import os
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType, SimpleNamespace

import pytest
from syrupy.assertion import SnapshotAssertion

from orthoflow.engine import measuring
from orthoflow.engine.results import CellResult
from orthoflow.errors import ArgumentError
from tests.engine_world import World, has_ended, start_fork_server, toy_world
from tests.optional import skip

MIB = 1 << 20
TOY = "method work.does of toy-plugin 1.0"
TWO = "steps: {a: {use: make.range}, b: {use: work.add, in: {numbers: a.numbers}}}"


def results_of(
    world: World,
    codes: Mapping[str, str],
    timeouts: Mapping[str, str] = MappingProxyType({}),
    **options: object,
) -> dict[str, CellResult]:
    """Run codes beside a good method, with a step behind each; the good ones must come through."""
    limits = {name: f", timeout: {limit}" for name, limit in timeouts.items()}
    variants = "".join(
        f"      {name}: {{use: work.does, params: {{code: {json.dumps(code)}}}"
        f"{limits.get(name, '')}}}\n"
        for name, code in codes.items()
    )
    outcome = world.run(
        "steps:\n  first: {use: make.range}\n  second:\n    in: {numbers: first.numbers}\n"
        f"    variants:\n      good: {{use: work.add}}\n{variants}"
        "  third: {use: work.add, in: {numbers: second.numbers}}\ncompare: {design: product}\n",
        **options,  # type: ignore[arg-type]
    )
    for address in ("first", "second@second=good", "third@second=good"):
        assert outcome.results[address].status == "ok"
    assert list(world.store.scratch.iterdir()) == []
    found = {name: outcome.results[f"second@second={name}"] for name in codes}
    for name, result in found.items():
        behind = outcome.results[f"third@second={name}"]
        if result.status == "ok":
            assert behind.status == "ok"
        else:
            assert (result.outputs, behind.status) == ({}, "skipped")
            assert behind.error_message == f"needs second@second={name}, which failed"
    return found


# The first seven are bugs, with a traceback for the author.
RAISING = (
    "{}['missing']",
    "raise BaseException('of no kind')",
    "class Mute(Exception):\n    __str__ = None\nraise Mute",
    r"raise ValueError('one\ntwo \x1b[31m \udcff \0')",
    "import no_such_library",
    "values += 1.0",
    "sys.exit('bye')",
    "from orthoflow.errors import MethodError\nraise MethodError('no number is large enough')",
    "from orthoflow.errors import InputError\nraise InputError('a.csv:2: no\\na.csv:3: two')",
    "result = inputs.numbers",
    "result = type(inputs)(numbers=products.Scan(values=values))",
    "ctx.metric('nan', float('nan'), '1')",
    "values = np.array([object()])",
)
N_BUGS = 7
EXIT_CODES = {"MethodError": 1, "ProductError": 1, "InputError": 2, "PluginError": 4}


def test_what_a_method_raises_becomes_one_sentence(
    world: World, snapshot: SnapshotAssertion
) -> None:
    much = "raise ValueError('x' * (1 << 20))"
    codes = {f"v{n}": code for n, code in enumerate([*RAISING, much])}
    *found, last = results_of(world, codes, executor="inline").values()
    assert [(result.error_type, result.error_message) for result in found] == snapshot
    for number, result in enumerate(found):
        assert result.exit_code == EXIT_CODES[result.error_type]
        # What is none of our errors is for the method's author, who finds it in log and record.
        is_bug = number < N_BUGS
        assert ("Traceback" in result.log, result.is_bug) == (is_bug, is_bug)
    assert len(last.error_message) < 700
    assert last.error_message.endswith("... (1048576 characters)")
    assert len(last.log) < 1 << 17


def test_warnings_are_lines_and_the_first_ones_are_kept(world: World) -> None:
    code = "for k in range(1001): ctx.warn(f'{k}\\n\\x1b[31m\\udcff')\nctx.warn('w' * (1 << 20))"
    (result,) = results_of(world, {"warns": code}, executor="inline").values()
    assert len(result.warnings) == 1000
    assert result.warnings[7] == r"7 \x1b[31m\udcff"


# What the disk refuses: the kind of error, of what lies in the scratch folder and elsewhere.
REFUSED = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), ("StepFailedError",) * 2),
    **dict.fromkeys((errno.EIO, errno.ESTALE, errno.EROFS), ("StoreError", "MethodError")),
    errno.EACCES: ("MethodError", "MethodError"),
}


def test_what_disk_and_memory_refuse_is_an_error_of_whoever_is_at_fault(world: World) -> None:
    places = ("str(ctx.scratch / 'x')", "'/elsewhere/x'")
    codes = {
        f"e{number}-{n}": f"raise OSError({number}, os.strerror({number}), {place})"
        for number in REFUSED
        for n, place in enumerate(places)
    }
    results = results_of(world, {**codes, "memory": "np.empty(1 << 46)"}, executor="inline")
    for name in codes:
        number, _, place = name.removeprefix("e").partition("-")
        kind = REFUSED[int(number)][int(place)]
        assert results[name].error_type == kind, name
        if kind != "MethodError":
            expected = f"cannot write to {world.store.folder}: "
            assert results[name].error_message.startswith(expected)
    assert results["memory"].error_type == "StepFailedError"
    assert results["memory"].error_message.startswith(
        f"{TOY} needed more memory than was available: Unable to allocate"
    )


# The process that starts the hidden one is gone before the step is.
HIDES = """
import sys
code = "import subprocess, sys; p = subprocess.Popen([sys.executable, '-c', 'import time; " \\
    "time.sleep(600)'], start_new_session=True, stdout=subprocess.DEVNULL); print(p.pid)"
hidden = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=True)
values = np.array([float(hidden.stdout)])
"""
PROCESSES = {
    "segfault": "ctypes.string_at(0)",
    "quits": "print('last words')\nos._exit(7)",
    "hangs": "while not ctx.cancelled(): time.sleep(0.01)\nraise ValueError",
    "ignores": "signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])\ntime.sleep(600)",
    "stops": "os.killpg(0, 19)",
    "logs": "while True: ctx.log('x' * 100)",
    "prints": "for _ in range(40): print('y' * (1 << 20))\nprint('the end')",
    "interrupts": "raise KeyboardInterrupt",
    "forks": "values = values + (1.0 if os.fork() else 2.0)\ntime.sleep(0.2)",
    "closes": "sys.stdout.close()\nsys.stderr = None\nctx.log('unheard')",
    "hides": HIDES,
}


def test_what_a_method_does_to_its_process_harms_nothing_else(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As in a program that had started the server of steps for purposes of its own.
    start_fork_server()
    monkeypatch.setattr("orthoflow.engine.local.GRACE_S", 0.5)
    late = ("hangs", "ignores", "stops", "logs")
    results = results_of(world, PROCESSES, dict.fromkeys(late, "1.5s"), jobs=2)
    messages = {name: result.error_message for name, result in results.items()}
    for name in late:
        assert messages[name] == f"{TOY} exceeded its timeout of 1.5 s and was stopped"
        assert results[name].error_type == "StepFailedError"
        assert 1.5 <= results[name].wall_s < 30
        assert results[name].started < results[name].ended
    assert messages["segfault"].startswith(f"{TOY} crashed (segmentation fault) while using ")
    assert "string_at" in results["segfault"].log
    assert messages["quits"] == (
        f"{TOY} ended without a result (exit status 7); its log ends with: last words"
    )
    assert messages["interrupts"] == f"{TOY} failed unexpectedly: KeyboardInterrupt"
    printed = results["prints"].log
    assert printed.startswith("... (")
    assert printed.endswith("the end\n")
    assert len(printed) < 300_000
    assert messages["closes"] == ""
    from toy_plugin.products import Numbers

    def values(name: str) -> list[float]:
        digest = results[name].outputs["numbers"].digest
        return [float(x) for x in world.store.get_product(digest, Numbers).values]

    # The process that a method forked gives no result; nothing that one has started goes on.
    assert values("forks") == [1.0, 2.0, 3.0, 4.0]
    assert has_ended(int(values("hides")[0]))


def test_a_step_that_kills_the_server_of_all_steps_fails_and_the_next_run_has_another(
    world: World,
) -> None:
    kills = json.dumps("os.kill(os.getppid(), 9)\ntime.sleep(600)")
    steps = TWO.replace("work.add", f"work.does, params: {{code: {kills}}}")
    message = world.run(steps).results["b"].error_message
    assert message.startswith(f"{TOY} ended without a result")
    assert world.run(TWO, into="next").status == "ok"


def test_a_machine_without_room_for_a_process_fails_the_step_alone(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(process: object) -> None:
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.context.ForkServerProcess.start", refused)
    outcome = world.run(
        "steps: {a: {use: make.range}, b: {use: work.add, in: {numbers: a.numbers}}}"
    )
    assert "no process could be started for method make.range" in outcome.results["a"].error_message
    assert outcome.results["b"].error_message == "needs a, which failed"


def test_a_method_that_eats_all_memory_is_stopped_and_the_coordinator_lives(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A machine of 2 GiB with 600 MiB left, less what the steps take.
    def little_memory() -> SimpleNamespace:
        taken = measuring.tree_memory(os.getpid()) - measuring.process_memory()
        return SimpleNamespace(available=600 * MIB - taken, total=2048 * MIB)

    monkeypatch.setattr(measuring.psutil, "virtual_memory", little_memory)
    eats = "hoard = []\nwhile True:\n    hoard.append(np.ones(1 << 20))\n    time.sleep(0.002)"
    (result,) = results_of(world, {"eats": eats}).values()
    assert result.error_type == "StepFailedError"
    assert result.error_message == (
        f"{TOY} needed more memory than the machine has "
        f"({result.peak_rss_mib / 1024:.1f} GiB when stopped); use fewer points or photos, "
        "or a coarser resolution"
    )
    # What other children of this test hold (the server of processes) is missing from it.
    assert 150 < result.peak_rss_mib < 1000


def test_a_product_that_contradicts_its_inputs_fails_its_step_and_names_the_method(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    from toy_plugin.products import Numbers

    from orthoflow.errors import ProductError

    def check(self: Numbers, others: Mapping[str, Numbers]) -> None:
        if any(len(one.values) == len(self.values) for one in others.values()):
            raise ProductError("numbers.values must be as many as expected")

    monkeypatch.setattr(Numbers, "check_against", check)
    results = world.run(TWO, executor="inline").results
    assert results["a"].status == "ok"
    assert results["b"].error_message == (
        "method work.add of toy-plugin 1.0 returns an invalid numbers: numbers.values must be as "
        "many as expected"
    )


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


def test_an_output_too_large_for_the_disk_fails_its_cell_in_a_sentence(tiny_world: World) -> None:
    steps = "large: {use: make.range, params: {count: 1000000}}, small: {use: make.range}"
    outcome = tiny_world.run(f"steps: {{{steps}}}", executor="inline")
    failed = outcome.results["large"]
    assert (failed.error_type, outcome.results["small"].status) == ("StoreError", "ok")
    assert failed.error_message.startswith(
        f"cannot write to {tiny_world.store.folder}: No space left on device"
    )


def test_a_run_folder_that_cannot_be_written_is_one_sentence(world: World) -> None:
    (world.folder / "file").write_text("no folder")
    with pytest.raises(
        ArgumentError, match=r"file/run cannot be created, because .*/file is a file; "
    ):
        world.run("steps: {a: {use: make.range}}", into="file/run")
