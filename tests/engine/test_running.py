"""What becomes of whatever a method raises: one sentence, told by the right one of our errors."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.engine import worker
from orthoflow.engine.file_digests import file_identity, file_sha256
from orthoflow.engine.results import ProductRef
from orthoflow.engine.store import digest_of
from orthoflow.engine.worker import Task, TaskFile, TaskInput, TaskOutput
from orthoflow.errors import (
    DiskSpaceError,
    InputError,
    MethodError,
    PluginError,
    StepFailedError,
    StoreError,
)
from orthoflow.products.product import Product
from orthoflow.sdk.context import StepEvent
from tests.engine_tasks import bare_task
from tests.engine_world import World
from tests.report_runs import environment

REF = ProductRef(type_name="numbers", encoding_version=1, digest="sha256:1")
STORE = Path("/somewhere/store")


def a_task(**more: Any) -> Task:
    plain: dict[str, Any] = {
        "distribution": "toys", "distribution_version": "1.0", "determinism": "seeded", "seed": 7,
        "inputs": {"numbers": TaskInput(ref=REF)}, "store": str(STORE),
        "environment": environment(),
    }  # fmt: skip
    return bare_task(**(plain | more))


def test_a_result_begins_with_what_is_known_of_its_task() -> None:
    blank = worker.blank_result(a_task())
    assert (blank.status, blank.key, blank.key_preimage, blank.run_id) == ("ok", "k", "{}", "r1")
    assert (blank.method, blank.distribution, blank.seed) == ("work.add", "toys", 7)
    assert (blank.inputs, blank.environment) == ({"numbers": REF}, environment())
    # What draws nothing has no seed.
    assert worker.blank_result(a_task(determinism="exact")).seed is None
    assert worker.blank_result(a_task(determinism="loose")).seed == 7


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MethodError("no plane"), "no plane"),
        (InputError("a: wrong\nb: wrong"), "a: wrong; b: wrong"),
        (MethodError("one\ntwo"), "one two"),
        (MethodError(""), "method work.add of toys 1.0 failed without a message"),
        (MethodError("x" * 4000), "x" * 4000),
        (MethodError("y" * 4001), f"{'y' * 4000}... (4001 characters)"),
    ],
    ids=["plain", "problems", "lines", "mute", "long", "longer"],
)
def test_a_failure_is_told_in_one_line(error: MethodError | InputError, said: str) -> None:
    failed = worker.failed_result(a_task(), error, "the trace")
    assert (failed.status, failed.error_type) == ("failed", type(error).__name__)
    assert (failed.error_message, failed.traceback) == (said, "the trace")
    assert (failed.exit_code, failed.key) == (type(error).exit_code, "k")


def read_only_error() -> ValueError:
    array = np.zeros(2)
    array.flags.writeable = False
    try:
        array[0] = 1.0
    except ValueError as error:
        return error
    raise AssertionError


WHO = "method work.add of toys 1.0"


@pytest.mark.parametrize(
    ("error", "kind", "said"),
    [
        (MemoryError(), StepFailedError, f"{WHO} needed more memory than it could get: an alloc"),
        (MemoryError("8 GiB"), StepFailedError, f"{WHO} needed more memory than it could get: 8"),
        (ModuleNotFoundError("No module named 'x'", name="x"), PluginError, f"{WHO} needs x, whi"),
        (ImportError("bad wheel"), PluginError, f"{WHO} needs a library, which is missing or f"),
        (read_only_error(), MethodError, f"{WHO} writes to an array that is read-only, as all"),
        (ValueError("no number"), MethodError, f"{WHO} failed unexpectedly: ValueError: no number"),
        (ValueError(), MethodError, f"{WHO} failed unexpectedly: ValueError"),
        (SystemExit(3), MethodError, f"{WHO} tried to end the program (3)"),
        (OSError(errno.ENOENT, "No such file"), MethodError, f"{WHO} failed unexpectedly: FileN"),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_whatever_a_method_raises_is_told_by_one_of_our_errors(
    error: BaseException, kind: type[Exception], said: str
) -> None:
    told = worker.explain_failure(a_task(), error)
    assert type(told) is kind
    assert str(told).startswith(said)
    assert not str(told).endswith(": ")
    ours = StoreError("full")
    assert worker.explain_failure(a_task(), ours) is ours


@pytest.mark.parametrize(
    ("number", "name", "kind"),
    [
        # The method wanted more than there is.
        (errno.ENOSPC, None, DiskSpaceError),
        (errno.EDQUOT, None, DiskSpaceError),
        (errno.EFBIG, None, StepFailedError),
        # The disk of the store fails, which is nobody's fault; another one is the method's.
        (errno.EIO, None, StoreError),
        (errno.EIO, str(STORE / "objects" / "x"), StoreError),
        (errno.EIO, "/elsewhere/x", None),
        (errno.EROFS, str(STORE / "x"), StoreError),
        (errno.EACCES, str(STORE / "x"), None),
    ],
)
def test_what_the_disk_refuses_is_told_by_whose_fault_it_is(
    number: int, name: str | None, kind: type[Exception] | None
) -> None:
    told = worker._disk_failure(OSError(number, "why", name), STORE)
    assert (None if told is None else type(told)) is kind
    if told is not None:
        assert str(STORE) in str(told)


def test_between_what_is_compiled_a_step_says_what_it_said_before() -> None:
    heard: list[StepEvent] = []
    news = worker._News(heard.append)
    news.compiling("compiling peel")
    half = StepEvent(kind="progress", text="peeling", fraction=0.5)
    news.listen(half)
    news.listen(StepEvent(kind="log", text="dark"))
    news.compiling("compiling grow")
    news.compiling("")
    assert [(event.kind, event.text, event.fraction) for event in heard] == [
        ("progress", "compiling peel", 0.0),
        ("progress", "peeling", 0.5),
        ("log", "dark", 0.0),
        ("progress", "compiling grow", 0.5),
        ("progress", "peeling", 0.5),
    ]


def a_call(task: Task, **more: Any) -> Any:
    call: Any = object.__new__(worker._Call)
    call.task = task
    for name, value in more.items():
        setattr(call, name, value)
    return call


def test_processor_time_is_without_loading_and_looking(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker.time, "process_time", lambda: 10.0)
    monkeypatch.setattr(worker, "children_processor_s", lambda: 4.0)
    call = a_call(
        a_task(),
        _meter=SimpleNamespace(processor_s=3.0),
        _sampler=SimpleNamespace(processor_s=0.5),
    )
    assert call._cpu_s() == 10.5


def test_a_class_is_loaded_by_its_import_string_or_named_as_missing() -> None:
    assert worker.load_target("json:loads") is json.loads
    for target in ("no_such_module:Thing", "json:nothing"):
        with pytest.raises(PluginError, match=rf"^{target} cannot be loaded: [A-Z]\w+Error: "):
            worker.load_target(target)


def test_an_input_file_may_be_touched_and_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "scan.txt"
    path.write_text("points")
    file = TaskFile(path=str(path), identity=file_identity(path), sha256=file_sha256(path))
    worker._check_file(file)
    os.utime(path, ns=(1, 1))
    worker._check_file(file)
    path.write_text("POINTS")
    with pytest.raises(InputError, match=r"scan\.txt changed while it was read; run again"):
        worker._check_file(file)
    path.unlink()
    with pytest.raises(InputError, match=r"scan\.txt cannot be read any more: No such file"):
        worker._check_file(file)


@dataclass(frozen=True, kw_only=True)
class Numbers(Product):
    type_name: ClassVar[str] = "numbers"
    values: NDArray[np.float64]


def test_a_method_gives_what_its_ports_promise() -> None:
    class Out(SimpleNamespace):
        pass

    cls: Any = SimpleNamespace(Out=Out)
    numbers = Numbers(values=np.zeros(3))
    call = a_call(a_task(outputs={"out": TaskOutput(type_name="numbers", target="x:Y")}))
    assert call._products(cls, Out(out=numbers, more=1), {}) == {"out": numbers}
    with pytest.raises(MethodError, match=f"^{WHO} must return its Out, got dict$"):
        call._products(cls, {"out": numbers}, {})
    with pytest.raises(MethodError, match="must give a numbers on its port out, got int"):
        call._products(cls, Out(out=3), {})
    other = a_call(a_task(outputs={"out": TaskOutput(type_name="heights", target="x:Y")}))
    with pytest.raises(MethodError, match="must give a heights on its port out, got Numbers"):
        other._products(cls, Out(out=numbers), {})


def test_an_input_or_output_that_a_method_changed_is_told() -> None:
    numbers = Numbers(values=np.zeros(3))
    ref = replace(REF, digest=digest_of(numbers))
    call = a_call(a_task(inputs={"in": TaskInput(ref=ref)}))
    call._check_inputs({"in": numbers})
    call._check_output("out", numbers, ref)
    numbers.values[1] = 1.0
    with pytest.raises(MethodError, match="changed its input in, which is read-only; it must work"):
        call._check_inputs({"in": numbers})
    with pytest.raises(MethodError, match="changed its output out after it had returned it; it"):
        call._check_output("out", numbers, ref)


def test_of_a_long_trace_the_end_is_kept() -> None:
    class MuteError(Exception):
        def __str__(self) -> str:
            raise RuntimeError("not a word")

    kept = worker._trace(ValueError("x" * 1_000_000 + "the end"))
    assert kept.rstrip().endswith("the end")
    assert 1_000 < len(kept) < 1_000_000
    assert "\\ud800" in worker._trace(ValueError("\ud800"))
    assert isinstance(worker._trace(MuteError()), str)


def test_a_product_that_contradicts_its_inputs_fails_its_step_and_names_the_method(
    world: World,
) -> None:
    source = world.site / "toy_plugin" / "products.py"
    source.write_text(
        f"{source.read_text()}\n\n"
        "def _check(self, others):\n"
        "    from orthoflow.errors import ProductError\n"
        "    if any(len(one.values) == len(self.values) for one in others.values()):\n"
        "        raise ProductError('numbers.values must be as many as expected')\n\n\n"
        "Numbers.check_against = _check\n"
    )
    outcome = world.run(
        "steps:\n"
        "  first: {use: make.range}\n"
        "  second: {use: work.add, in: {numbers: first.numbers}}\n",
        executor="inline",
    )
    assert outcome.results["first"].status == "ok"
    failure = outcome.results["second"]
    assert failure.status == "failed"
    assert "method work.add" in failure.error_message
    assert "numbers.values must be as many as expected" in failure.error_message
