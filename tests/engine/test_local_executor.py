"""What is said of a step's process that ended without a result, and of one that was stopped."""

from __future__ import annotations

import signal
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.engine import local_executor as module
from orthoflow.engine import splitting
from orthoflow.errors import StepFailedError, StoreError

GIB = 1 << 30
WHO = "work.add of toys 1"


@pytest.fixture(autouse=True)
def _no_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "address_space", lambda: None)


@pytest.mark.parametrize(
    ("code", "tail", "said"),
    [
        (0, "", "ended its process without a result (exit status 0)"),
        (3, "", "ended its process without a result (exit status 3)"),
        (3, "no room", "a result (exit status 3); its log ends with: no room"),
        (-9, "no room", "was killed from outside (SIGKILL) while it held 1.5 GiB of memory"),
        (-15, "", "was killed from outside (SIGTERM) while it held 1.5 GiB of memory"),
        (-62, "", "was killed from outside (signal 62) while it held 1.5 GiB of memory"),
    ],
)
def test_how_a_process_ended_is_said(code: int, tail: str, said: str) -> None:
    text = module.describe_exit(WHO, code, 3 * GIB // 2, tail)
    assert text.startswith(f"{WHO} ")
    assert text.endswith(said)


@pytest.mark.parametrize("number", sorted(module._CRASHES))
def test_a_crash_is_named_with_the_memory_that_a_process_may_take(
    monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    plain = f"{WHO} crashed ({module._CRASHES[number]}, {number.name})"
    assert module.describe_exit(WHO, -number, GIB, "tail") == plain
    monkeypatch.setattr(module, "address_space", lambda: 3 << 20)
    limited = f"{plain}; a process may take 3 MiB of memory here"
    assert module.describe_exit(WHO, -number, GIB, "tail") == limited


def test_a_step_that_was_stopped_says_why() -> None:
    assert str(module.describe_memory(WHO, GIB // 4)) == (
        f"{WHO} needed more memory than the machine has (0.2 GiB when stopped); give it less data "
        "or coarser parameters"
    )
    said = str(module.describe_timeout(WHO, 90.0))
    assert said == f"{WHO} ran past its timeout of 90 s and was stopped"


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (59.0, "59 s"),
        (60.0, "1 min"),
        (61.0, "61 s"),
        (3540.0, "59 min"),
        (3600.0, "1 h"),
        (5400.0, "90 min"),
        (3601.0, "3601 s"),
        (0.25, "0.25 s"),
    ],
)
def test_a_timeout_is_said_in_the_largest_unit_that_it_fills(seconds: float, said: str) -> None:
    assert module.duration(seconds) == said


def silent(code: int | None, log: str = "", *, last_words: str = "", oom_kills: int = 7) -> Any:
    return SimpleNamespace(
        last_words=last_words,
        process=SimpleNamespace(returncode=code),
        oom_kills=oom_kills,
        task=SimpleNamespace(who=WHO),
        peak_bytes=2 * GIB,
        log=SimpleNamespace(text=lambda: log),
    )


def test_who_is_silent_had_last_words_or_no_memory_or_a_log(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "oom_kills", lambda: 7)
    told = module._reason_of_silence(silent(1, "log", last_words="the disk\nis full"))
    assert isinstance(told, StoreError)
    assert "the disk" in str(told)
    told = module._reason_of_silence(silent(1, "first\nlast line\n\n"))
    assert isinstance(told, StepFailedError)
    assert str(told).endswith("(exit status 1); its log ends with: last line")
    assert str(module._reason_of_silence(silent(None))).endswith("(exit status 0)")
    # As many kills as when it began: another one's.
    assert "killed from outside (SIGKILL)" in str(module._reason_of_silence(silent(-9)))
    assert "needed more memory" in str(module._reason_of_silence(silent(-9, oom_kills=6)))
    # Three hundred letters of a long line.
    said = str(module._reason_of_silence(silent(1, "x" * 300)))
    assert said.endswith("x" * 300)
    said = str(module._reason_of_silence(silent(1, "x" * 301)))
    assert said.endswith(f"{'x' * 300}... (301 characters)")
    assert said.count("x" * 300) == 1


def test_parts_are_named_by_their_items_in_sixty_letters() -> None:
    items = [
        {"name": "a"},
        {"name": ""},
        {"other": "b"},
        "c",
        {"name": "x" * 60},
        {"name": "x" * 61},
    ]
    store: Any = SimpleNamespace(product_metadata=lambda _: {"walls": items, "none": 3})
    task: Any = SimpleNamespace(inputs={"walls": SimpleNamespace(ref=SimpleNamespace(digest="d"))})
    mapped: Any = SimpleNamespace(port="walls", field="walls", item_name="name")
    found = splitting._item_names(store, task, mapped)
    assert found[:5] == ("a", "2", "3", "4", "x" * 60)
    assert found[5].startswith("x" * 60 + "...")
    mapped.field = "none"
    assert splitting._item_names(store, task, mapped) == ()
    mapped.field = "gone"
    assert splitting._item_names(store, task, mapped) == ()
