"""What becomes of whatever a method raises: one sentence, told by the right one of our errors."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from orthoflow.engine import worker
from orthoflow.engine.file_digests import FileDigests
from orthoflow.engine.results import ProductRef
from orthoflow.engine.worker import Task, TaskInput
from orthoflow.errors import (
    DiskSpaceError,
    InputError,
    StepFailedError,
    StoreError,
)
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


def a_call(task: Task, **more: Any) -> Any:
    call: Any = object.__new__(worker._Call)
    call.task = task
    for name, value in more.items():
        setattr(call, name, value)
    return call


def test_an_input_file_may_be_touched_and_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "scan.txt"
    path.write_text("points")
    file = FileDigests(tmp_path / "memo").digest(path)
    worker._check_file(file)
    os.utime(path, ns=(1, 1))
    worker._check_file(file)
    path.write_text("POINTS")
    with pytest.raises(InputError, match=r"scan\.txt changed while it was read; run again"):
        worker._check_file(file)
    path.unlink()
    with pytest.raises(InputError, match=r"scan\.txt cannot be read any more: No such file"):
        worker._check_file(file)


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
