"""The run folder: the names of its files, the journal, and the events of a run."""

from __future__ import annotations

import hashlib
import json
import os
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, Self, TypeAlias

from orthoflow_provenance.document import UnsafeFileError
from orthoflow_provenance.paths import path_below
from pydantic import TypeAdapter

from orthoflow.engine.durability import is_locked, lock_file, sync, writing_to
from orthoflow.engine.environment import now, time_in_a_name
from orthoflow.engine.results import CellResult, CellStatus
from orthoflow.errors import ArgumentError, RecordError, StoreError

if TYPE_CHECKING:
    from orthoflow.sdk.context import StepEvent


@dataclass(frozen=True, kw_only=True)
class RunStarted:
    """A run starts, or continues after an interruption.

    Attributes:
        run_id: id of the run.
        n_cells: number of cells in the plan.
        is_resumed: whether the run folder contained an unfinished run.
    """

    run_id: str
    n_cells: int
    is_resumed: bool


@dataclass(frozen=True, kw_only=True)
class CellStarted:
    """A cell starts to run."""

    address: str


@dataclass(frozen=True, kw_only=True)
class CellReported:
    """A running cell reports its progress, a log line or a diagnostic."""

    address: str
    event: StepEvent


@dataclass(frozen=True, kw_only=True)
class CellFinished:
    """A cell is finished.

    Attributes:
        address: address of the cell.
        result: its result, with status ok, failed or skipped.
        cached: whether the result was in the store; also true if this run stored it before an
            interruption.
    """

    address: str
    result: CellResult
    cached: bool


RunEvent: TypeAlias = RunStarted | CellStarted | CellReported | CellFinished
RunListener: TypeAlias = Callable[[RunEvent], None]


def ignore(event: RunEvent) -> None:
    """Accept an event and do nothing."""


JOURNAL: Final = "journal.jsonl"
RECORD_FILE: Final = "run.h5"
LOGS: Final = "logs"
_ANOTHER: Final = "choose another folder with -o (in Python: output=)"
_FORMAT: Final = "orthoflow/journal/1"
_LONGEST_FILE_NAME: Final = 200  # bytes; leaves room for a suffix, since file systems allow 255


LineEvent: TypeAlias = Literal["run", "resumed", "interrupted", "ended", "started", "finished"]


@dataclass(frozen=True, kw_only=True)
class JournalLine:
    """One line of a journal: an event of the run or of a cell.

    Attributes:
        event: `run` in the first line; `resumed`, `interrupted` or `ended` for the run; `started`
            or `finished` for a cell.
        time: ISO 8601, UTC.
        format: name and version of the file format; like `run_id` and `workflow`, only in the
            first line.
        run_id: id of the run.
        workflow: name of the workflow.
        address: address of the cell; in lines about the run, this and all following fields are
            empty.
        key: cache key of the cell.
        status: ok, failed or skipped.
        cached: whether the result was in the store.
        error: message of a failure.
        error_type: error class of a failure.
    """

    event: LineEvent
    time: str
    format: str = ""
    run_id: str = ""
    workflow: str = ""
    address: str = ""
    key: str = ""
    status: CellStatus | Literal[""] = ""
    cached: bool = False
    error: str = ""
    error_type: str = ""


class Journal:
    """An open run folder, locked for this process.

    Attributes:
        run_id: id of the run, kept when the run is resumed.
        is_resumed: whether the folder contained an unfinished run.
        started: start of the first attempt, ISO 8601, UTC.
        finished_keys: keys of the cells that this run computed before it was interrupted.
    """

    def __init__(self, folder: Path, name: str, *, run_id: str = "") -> None:
        """Open a run folder, or create it.

        Args:
            folder: the run folder.
            name: name of the workflow.
            run_id: id of a new run, generated if empty; a resumed run keeps its id.

        Raises:
            ArgumentError: the folder is in use by another run, or contains a finished run, a run of
                another workflow, or other files.
            StoreError: the disk cannot be written to.
        """
        self._folder = folder
        self._path = folder / JOURNAL
        _check_folder(folder)
        with writing_to(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            self._begin(name, run_id)
        except BaseException:
            os.close(self._descriptor)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)

    def write(self, event: LineEvent, **facts: str | bool) -> None:
        """Append a line and sync it to the disk.

        Args:
            event: event to write.
            facts: other fields of `JournalLine`; `time` is the current time unless given.

        Raises:
            StoreError: the disk cannot be written to.
        """
        line = {"event": event, "time": now(), **facts}
        text = json.dumps(line, ensure_ascii=False).encode() + b"\n"
        with writing_to(self._folder):
            while text:
                text = text[os.write(self._descriptor, text) :]
            os.fsync(self._descriptor)

    def _begin(self, name: str, run_id: str) -> None:
        if not lock_file(self._path, self._descriptor):
            raise _is_in_use(self._folder)
        lines = self._read_lines()
        # The run may have been finished by another process since the folder was checked.
        if (self._folder / RECORD_FILE).exists():
            raise _is_finished(self._folder)
        self.is_resumed = bool(lines)
        first = next((line for line in lines if line.event == "run"), None)
        if lines and first is None:
            raise self._damage()
        self.run_id = first.run_id if first else run_id or new_run_id()
        self.started = first.time if first else now()
        self.finished_keys = frozenset(
            line.key
            for line in lines
            if line.event == "finished" and line.status == "ok" and not line.cached
        )
        if first:
            _check_workflow(self._folder, first, name)
            self.write("resumed")
            return
        self.write("run", time=self.started, format=_FORMAT, run_id=self.run_id, workflow=name)
        with writing_to(self._folder):
            sync(self._folder)

    def _read_lines(self) -> list[JournalLine]:
        """Read all complete lines; truncate the file if the last line is incomplete."""
        content = self._path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        with writing_to(self._folder):
            os.ftruncate(self._descriptor, len(whole))
            os.lseek(self._descriptor, 0, os.SEEK_END)
        try:
            return _parsed(whole)
        except ValueError as error:
            raise self._damage() from error

    def _damage(self) -> StoreError:
        return StoreError(f"{self._path} is damaged; remove {self._folder} or {_ANOTHER}")


@cache
def _codec() -> TypeAdapter[JournalLine]:
    return TypeAdapter(JournalLine)


def _parsed(lines: bytes) -> list[JournalLine]:
    return [_codec().validate_json(line, strict=True) for line in lines.splitlines()]


def require_run_folder(folder: Path, name: str) -> None:
    """Check a run folder as `Journal` does, without creating or opening it.

    Args:
        folder: the run folder; it may be missing.
        name: name of the workflow.

    Raises:
        ArgumentError: see `Journal`.
    """
    _check_folder(folder)
    if is_running(folder):
        raise _is_in_use(folder)
    for line in readable_lines(folder):
        if line.event == "run":
            _check_workflow(folder, line, name)


@contextmanager
def kept_from_others(folder: Path) -> Iterator[None]:
    """Prevent other runs from using a run folder while the block writes results to it.

    Raises:
        ArgumentError: the folder is in use by another run.
    """
    path = folder / JOURNAL
    if not path.exists():
        yield
        return
    with path.open("r+b") as journal:
        if not lock_file(path, journal.fileno()):
            raise _is_in_use(folder)
        yield


def _is_in_use(folder: Path) -> ArgumentError:
    return ArgumentError(
        f"the run folder {folder} is in use by another run; wait until it has ended, or {_ANOTHER}"
    )


def _check_workflow(folder: Path, first: JournalLine, name: str) -> None:
    if first.workflow != name:
        raise ArgumentError(
            f"{folder} contains an unfinished run of {first.workflow}, not of {name}; {_ANOTHER}"
        )


def readable_lines(folder: Path) -> list[JournalLine]:
    """Return the lines of a journal, even during a run; empty if the journal is unreadable."""
    with suppress(OSError, ValueError):
        return _parsed((folder / JOURNAL).read_bytes())
    return []


def _is_finished(folder: Path) -> ArgumentError:
    return ArgumentError(
        f"{folder} contains a finished run ({RECORD_FILE}); {_ANOTHER}, or view this one "
        "(orthoflow show, orthoflow.open_run)"
    )


def _check_folder(folder: Path) -> None:
    if files := [place for place in (folder, *folder.parents) if place.is_file()]:
        raise ArgumentError(f"{folder} cannot be created, because {files[0]} is a file; {_ANOTHER}")
    if (folder / JOURNAL).is_symlink() or (folder / JOURNAL).is_fifo():
        raise ArgumentError(f"{folder / JOURNAL} is a link or a pipe; {_ANOTHER}")
    if (folder / RECORD_FILE).exists():
        raise _is_finished(folder)
    if not folder.is_dir():
        return
    if not (folder / JOURNAL).exists() and any(folder.iterdir()):
        raise ArgumentError(f"{folder} is not empty and contains no unfinished run; {_ANOTHER}")


def is_running(folder: Path) -> bool:
    """Whether a running process is executing the run in a folder."""
    return is_locked(folder / JOURNAL)


def new_run_id() -> str:
    """Generate the id of a run from the time in UTC and a random part."""
    return f"{time_in_a_name()}-{uuid.uuid4().hex[:6]}"


def new_run_folder(name: str, run_id: str) -> Path:
    """Return the default folder of a run: `runs/<name>-<run id>`.

    Raises:
        RecordError: the workflow name, which may come from a record, is not allowed as a folder
            name.
    """
    try:
        return path_below(Path("runs"), f"{name}-{run_id}")
    except UnsafeFileError as error:
        raise RecordError(
            f"cannot create a folder in runs/: {error}; choose a folder with -o"
        ) from error


def cell_file_name(address: str) -> str:
    """Return the base name of a cell's files: its address, shortened if too long.

    >>> cell_file_name("ortho@plane=ransac,orient=pnp")
    'ortho@plane=ransac,orient=pnp'
    """
    if len(address.encode()) <= _LONGEST_FILE_NAME:
        return address
    digest = hashlib.sha256(address.encode()).hexdigest()[:12]
    return f"{address.encode()[: _LONGEST_FILE_NAME - 13].decode(errors='ignore')}-{digest}"
