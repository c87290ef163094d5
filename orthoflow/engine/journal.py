"""The journal of a run folder: one synced line per event, the truth while a run goes on."""

from __future__ import annotations

import fcntl
import json
import os
import uuid
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from orthoflow.engine.durability import sync_folder, writing_to
from orthoflow.errors import ArgumentError, StoreError
from orthoflow.products.product import JsonValue

JOURNAL: Final = "journal.jsonl"
RECORD: Final = "run.h5"
_FORMAT: Final = "orthoflow/journal/1"


class Journal:
    """An open run folder, locked for this process.

    Attributes:
        run_id: of the run; kept when it is resumed.
        is_resumed: the folder held an unfinished run.
        started: ISO 8601 UTC, of the first attempt.
        finished_keys: keys of the cells that this run has computed before it was interrupted.
    """

    def __init__(self, folder: Path, name: str, *, run_id: str = "") -> None:
        """Open or make a run folder.

        Args:
            folder: the run folder.
            name: name of the workflow.
            run_id: id of a new run, made up when empty; a resumed run keeps its own.

        Raises:
            ArgumentError: the folder holds a finished run, another workflow's run, or other files.
            StoreError: it is in use by another run, or the disk refuses.
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._descriptor)

    def write(self, event: str, **fields: JsonValue) -> None:
        """Add an event and bring it to the disk.

        Raises:
            StoreError: the disk refuses.
        """
        content: dict[str, JsonValue] = {"event": event, "time": _now(), **fields}
        line = json.dumps(content, ensure_ascii=False, allow_nan=False).encode() + b"\n"
        with writing_to(self._folder):
            while line:
                line = line[os.write(self._descriptor, line) :]
            os.fsync(self._descriptor)

    def _begin(self, name: str, run_id: str) -> None:
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StoreError(
                f"the run folder {self._folder} is in use by another run; wait for its end, or "
                f"choose another folder with -o"
            ) from error
        events = self._read_events()
        first = events[0] if events else {}
        self.is_resumed = bool(events)
        self.run_id = str(first.get("run_id") or run_id or new_run_id())
        self.started = str(first.get("time") or _now())
        self.finished_keys = frozenset(
            str(event["key"])
            for event in events
            if event.get("event") == "finished"
            and event.get("status") == "ok"
            and not event.get("cached")
        )
        if not events:
            # One reading of the clock: who resumes takes the run's start from this line.
            self.write("run", time=self.started, format=_FORMAT, run_id=self.run_id, workflow=name)
            with writing_to(self._folder):
                sync_folder(self._folder)
        elif first.get("workflow") != name:
            raise ArgumentError(
                f"{self._folder} holds an unfinished run of {first.get('workflow')}, not of "
                f"{name}; choose another folder with -o"
            )
        else:
            self.write("resumed")

    def _read_events(self) -> list[dict[str, JsonValue]]:
        """Read whole lines; a last one that was cut off by a kill is removed."""
        content = self._path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        with writing_to(self._folder):
            os.ftruncate(self._descriptor, len(whole))
            os.lseek(self._descriptor, 0, os.SEEK_END)
        try:
            return [json.loads(line) for line in whole.splitlines()]
        except ValueError as error:
            raise StoreError(
                f"{self._path} is damaged; remove {self._folder} or choose another folder with -o"
            ) from error


def _check_folder(folder: Path) -> None:
    if (folder / RECORD).exists():
        raise ArgumentError(
            f"{folder} holds a finished run ({RECORD}); choose another folder with -o"
        )
    if folder.is_dir() and not (folder / JOURNAL).exists() and any(folder.iterdir()):
        raise ArgumentError(
            f"{folder} is not empty and holds no unfinished run; choose another folder with -o"
        )


def new_run_id() -> str:
    """Make up the id of a run: its time in UTC, and something random."""
    return f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{uuid.uuid4().hex[:6]}"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
