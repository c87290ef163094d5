"""The task of one cell as a JSON file: everything its process needs, nothing left to decide."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from pydantic import JsonValue, TypeAdapter, ValidationError

from orthoflow.engine.durability import write_whole
from orthoflow.engine.results import MethodIdentity, ProductRef, RecordedEnvironment
from orthoflow.errors import StoreError

# The output port of a part.
PART: Final = "part"


@dataclass(frozen=True, kw_only=True)
class TaskFile:
    """An input file of a task.

    Attributes:
        path: where it lies.
        identity: what the file system says of it as long as it stays as it is.
        sha256: digest of its content, hexadecimal.
    """

    path: str
    identity: str
    sha256: str


@dataclass(frozen=True, kw_only=True)
class TaskInput:
    """A product on an input port.

    Attributes:
        ref: which product.
        target: import string of its class; empty for files.
        input_name: name of the workflow input; empty for products.
        files: of a workflow input.
    """

    ref: ProductRef
    target: str = ""
    input_name: str = ""
    files: tuple[TaskFile, ...] = ()


@dataclass(frozen=True, kw_only=True)
class TaskOutput:
    """What an output port must carry: type, class and publisher by import string.

    Attributes:
        type_name: product type.
        target: of its class.
        publisher: of what writes its published files; empty when nothing does.
        publisher_tag: version of the publisher.
    """

    type_name: str
    target: str
    publisher: str = ""
    publisher_tag: str = ""


@dataclass(frozen=True, kw_only=True)
class TaskPart:
    """Some of the items that a method maps over.

    Attributes:
        first: index of the first one.
        end: index behind the last one.
        ref: what the part came to; None before it ran.
    """

    first: int
    end: int
    ref: ProductRef | None = None


@dataclass(frozen=True, kw_only=True)
class Task(MethodIdentity):
    """One method call: of a whole step, of a part of one, or the one that joins parts.

    Attributes:
        address: of the cell.
        run_id: of the run.
        target: import string of the class.
        key: cache key.
        key_preimage: text it is the digest of.
        params: resolved, JSON.
        seed: of the generator.
        inputs: port -> product.
        outputs: port -> what is expected.
        cores: threads it may use.
        timeout_s: seconds, None for no limit.
        store: folder of the store.
        folder: folder of the task, on the store's file system: scratch and unfinished objects.
        log: file that takes stdout and stderr.
        kernels: names the folder for compiled kernels.
        environment: where it will run.
        is_compared: whether its times stand beside those of others.
        part: the part to compute; None for a whole step.
        parts: the parts to join, in order; empty where there are none.
        parts_store: folder of the store that has them.
    """

    address: str
    run_id: str
    target: str
    key: str
    key_preimage: str
    params: Mapping[str, JsonValue]
    seed: int
    inputs: Mapping[str, TaskInput]
    outputs: Mapping[str, TaskOutput]
    cores: int
    timeout_s: float | None
    store: str
    folder: str
    log: str
    kernels: str
    environment: RecordedEnvironment | None = None
    is_compared: bool = False
    part: TaskPart | None = None
    parts: tuple[TaskPart, ...] = ()
    parts_store: str = ""

    @property
    def who(self) -> str:
        """Method and distribution, as sentences about it begin."""
        brought = (
            f" of {self.distribution} {self.distribution_version}" if self.distribution else ""
        )
        return f"method {self.method}{brought}"

    @property
    def task_file(self) -> Path:
        """Where the task itself is written."""
        return Path(self.folder) / "task.json"

    @property
    def result_file(self) -> Path:
        """Where the process leaves its result."""
        return Path(self.folder) / "result.json"

    @property
    def scratch(self) -> Path:
        """The folder a method may write to."""
        return Path(self.folder) / "scratch"


def write_task(task: Task) -> None:
    """Write a task into its folder.

    Raises:
        StoreError: the disk refuses.
    """
    content = _codec().dump_python(task, mode="json")
    write_whole(task.task_file, json.dumps(content, allow_nan=False).encode())


def read_task(path: Path) -> Task:
    """Read a task back.

    Raises:
        StoreError: the file cannot be read, or is damaged.
    """
    try:
        return _codec().validate_json(path.read_bytes(), strict=True)
    except OSError as error:
        raise StoreError(f"cannot read the task {path}: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise StoreError(
            f"the task {path} is damaged: {place or 'the text'}: {first['msg']}; run again"
        ) from error


@cache
def _codec() -> TypeAdapter[Task]:
    return TypeAdapter(Task)
