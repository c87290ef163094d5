"""What a method does to its process and with its words harms neither run, record nor machine."""

from __future__ import annotations

import errno
import re

import pytest

from orthoflow.engine.results import CellResult
from orthoflow.engine.scheduler import RunOutcome
from tests.engine_world import World, has_ended, start_fork_server

WHO = "method work.{} of toy-plugin 1.0"


def all_of(world: World, *names: str, **options: object) -> RunOutcome:
    """Run methods side by side, each on the same numbers; those that never end, for 2 s."""
    limits = dict.fromkeys(("never_silent", "stops"), ", timeout: 2s")
    variants = "".join(f"      {n}: {{use: work.{n}{limits.get(n, '')}}}\n" for n in names)
    steps = (
        "steps:\n  first: {use: make.range}\n  bad:\n    in: {numbers: first.numbers}\n"
        f"    variants:\n{variants}compare: {{design: product}}\n"
    )
    outcome = world.run(steps, **options)  # type: ignore[arg-type]
    assert list(world.store.scratch.iterdir()) == []
    return outcome


def result_of(outcome: RunOutcome, name: str) -> CellResult:
    found = [result for result in outcome.results.values() if result.method == f"work.{name}"]
    assert len(found) == 1
    return found[0]


def test_what_was_started_in_another_session_by_a_process_that_is_gone_ends_too(
    world: World,
) -> None:
    # As in a program that had started the server of steps for purposes of its own.
    start_fork_server()
    log = result_of(all_of(world, "hides"), "hides").log
    found = re.search(r"hidden (\d+)", log)
    assert found, log
    assert has_ended(int(found[1]))


def test_a_step_that_kills_the_server_of_all_steps_fails_and_the_next_run_has_another(
    world: World,
) -> None:
    result = result_of(all_of(world, "kills_server"), "kills_server")
    assert result.error_message.startswith(f"{WHO.format('kills_server')} ended its process")
    again = all_of(world, "closes_streams", into="next")
    assert [result.error_message for result in again.results.values()] == ["", ""]


def test_a_machine_without_room_for_a_process_fails_the_step_alone(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(process: object) -> None:
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.context.ForkServerProcess.start", refused)
    result = result_of(all_of(world, "closes_streams"), "closes_streams")
    assert result.status == "skipped"
    assert "needs first, which failed" in result.error_message


def test_the_process_that_a_method_forked_gives_no_result(world: World) -> None:
    outcome = all_of(world, "forks")
    address = next(a for a, result in outcome.results.items() if result.method == "work.forks")
    assert world.values(outcome, address) == [1.0, 2.0, 3.0, 4.0]
    assert result_of(outcome, "forks").cpu_s >= 0.0


def test_how_much_and_how_long_a_method_reports_is_bounded(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One that never ends shall not go on long.
    monkeypatch.setattr("orthoflow.engine.local._GRACE_S", 0.3)
    outcome = all_of(world, "never_silent", "prints_much", "stops", "raises_interrupt", jobs=2)
    for name in ("never_silent", "stops"):
        endless = result_of(outcome, name)
        assert "exceeded its timeout of 2 s" in endless.error_message
        assert endless.wall_s < 30
    assert result_of(outcome, "raises_interrupt").error_message == (
        f"{WHO.format('raises_interrupt')} failed unexpectedly: KeyboardInterrupt"
    )
    printed = result_of(outcome, "prints_much")
    assert printed.log.startswith("... (")
    assert printed.log.endswith("the end\n")
    assert len(printed.log) < 300_000


FAILED = {
    "raises_base": "failed unexpectedly: BaseException: of no kind",
    "raises_speechless": "failed unexpectedly: Speechless: a Speechless without words",
    "raises_lines": r"failed unexpectedly: ValueError: one two \x1b[31m \udcff \x00",
}


def test_whatever_is_raised_is_one_printable_line(world: World) -> None:
    outcome = all_of(world, *FAILED, "raises_much", executor="inline")
    for name, sentence in FAILED.items():
        assert result_of(outcome, name).error_message == f"{WHO.format(name)} {sentence}"
    much = result_of(outcome, "raises_much")
    assert len(much.error_message) < 2200
    assert much.error_message.endswith("... (10485760 characters)")
    assert len(much.log) < 1 << 17


def test_warnings_are_lines_and_the_first_ones_are_kept(world: World) -> None:
    warnings = result_of(all_of(world, "warns_much", executor="inline"), "warns_much").warnings
    assert len(warnings) == 1000
    assert warnings[7] == r"7 \x1b[31m\udcff"
