"""The task of one cell as a JSON file: everything its process needs, nothing left to decide."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from orthoflow.engine.durability import write_whole
from orthoflow.engine.results import ProductRef
from orthoflow.products.product import JsonValue


@dataclass(frozen=True, kw_only=True)
class TaskFile:
    """An input file of a task; size and time tell whether it changed meanwhile."""

    path: str
    size_bytes: int
    mtime_ns: int


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
    """What an output port must carry: type, class and publisher by import string."""

    type_name: str
    target: str
    publisher: str = ""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One method call.

    Attributes:
        address: of the cell.
        run_id: of the run.
        method: method id.
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
        numba_folder: where compiled kernels are kept.
        publisher_tag: version of what writes published files.
        environment: as `engine.environment` gives it.
        distribution: name of the distribution that brought the method.
        distribution_version: its version.
        result_version: the method's own counter.
        determinism: exact, seeded or loose.
        citations: where the method comes from.
    """

    address: str
    run_id: str
    method: str
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
    numba_folder: str
    publisher_tag: str = ""
    environment: Mapping[str, JsonValue] = field(default_factory=dict)
    distribution: str = ""
    distribution_version: str = ""
    result_version: int = 0
    determinism: str = "exact"
    citations: tuple[str, ...] = ()

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
    write_whole(task.task_file, json.dumps(dataclasses.asdict(task), allow_nan=False).encode())


def read_task(path: Path) -> Task:
    """Read a task back."""
    content = json.loads(path.read_text(encoding="utf-8"))
    content["inputs"] = {
        port: TaskInput(
            ref=ProductRef(**given["ref"]),
            target=given["target"],
            input_name=given["input_name"],
            files=tuple(TaskFile(**file) for file in given["files"]),
        )
        for port, given in content["inputs"].items()
    }
    content["outputs"] = {
        port: TaskOutput(**expected) for port, expected in content["outputs"].items()
    }
    content["citations"] = tuple(content["citations"])
    return Task(**content)
