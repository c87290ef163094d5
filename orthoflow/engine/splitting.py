"""Steps in parts: items of one step that several workers compute at the same time, then joined.

A method that maps over photos or walls (`Method.maps_over`) gives the same bits whichever parts its
items are computed in. So a cluster whose workers have nothing else to do shares the items of a step
among them. Each part is a task with the inputs of the step and a key made of the step's, and the
task with the key of the step itself joins them: store, record and later steps see one step. Parts
lie in a small store of their own until it is there; after an interruption those are taken that are.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

from orthoflow.diagnostics import unique
from orthoflow.engine.durability import remove_tree, write_whole
from orthoflow.engine.keys import MethodFacts, read_preimage
from orthoflow.engine.local import TaskEnd
from orthoflow.engine.results import CellResult
from orthoflow.engine.store import Store, canonical_json
from orthoflow.engine.worker import PART, Task, TaskPart
from orthoflow.errors import CancelledStepError, DamageError
from orthoflow.sdk.lines import one_line
from orthoflow.sdk.methods import MappedPort

_WHAT: Final = "orthoflow/part"
_PARTS: Final = "parts"
_LONGEST_NAME: Final = 60


def parts_folder(store: Store) -> Path:
    """Where the parts of all steps lie that have not ended."""
    return store.folder / _PARTS


@dataclass(kw_only=True)
class _Split:
    """A step in parts.

    Attributes:
        task: of the whole step, as it will join the parts.
        facts: of its method.
        store: has the parts.
        names: of the items.
        parts: the indices of the items of each part, in order.
        found: by part, what it came to.
        waiting: parts that nobody computes yet.
        running: address of a task -> its part, None for the one that joins.
        fractions: address of a task -> how far it is.
        failure: what the first part came to that failed; no other one is begun then.
    """

    task: Task
    facts: MethodFacts
    store: Store
    names: tuple[str, ...]
    parts: tuple[range, ...]
    found: dict[range, CellResult]
    waiting: list[range] = field(default_factory=list)
    running: dict[str, range | None] = field(default_factory=dict)
    fractions: dict[str, float] = field(default_factory=dict)
    failure: CellResult | None = None

    def called(self, part: range) -> str:
        """What a part is called: `part 2 of 3 (IMG_4 to IMG_6)`."""
        first, last = self.names[part[0]], self.names[part[-1]]
        names = first if len(part) == 1 else f"{first} to {last}"
        return f"part {self.parts.index(part) + 1} of {len(self.parts)} ({names})"

    def next_task(self) -> Task | None:
        """Give the task that can begin now; None where everything runs that can."""
        if self.failure is not None or None in self.running.values():
            return None
        if not self.waiting:
            return self._joining() if not self.running else None
        part = self.waiting.pop(0)
        key, preimage = _key(self.task.key, part)
        folder = Path(self.task.folder).with_name(uuid.uuid4().hex[:12])
        task = replace(
            self.task,
            address=f"{self.task.address}, {self.called(part)}",
            key=key,
            key_preimage=preimage,
            folder=str(folder),
            # The log of the step is made of those of its parts when it ends.
            log=str(folder / "log"),
            part=TaskPart(first=part.start, end=part.stop),
            parts_store=str(self.store.folder),
        )
        self.running[task.address] = part
        return task

    def take(self, task: Task, result: CellResult) -> tuple[Task, CellResult] | None:
        """Take what a task came to; give task and result of the step once it has ended."""
        part = self.running.pop(task.address)
        if part is None:
            return self.task, self._whole(result)
        if result.status == "ok":
            self.found[part] = result
            if self.facts.is_code_unchanged():
                self.store.put_result(task.key, result, task.method)
        elif self.failure is None:
            is_cancelled = result.exit_code == CancelledStepError.exit_code
            where = "" if is_cancelled else f"{self.called(part)}: "
            self.failure = replace(
                result,
                key=self.task.key,
                key_preimage=self.task.key_preimage,
                error_message=f"{where}{result.error_message}",
            )
        if self.failure is None or self.running:
            return None
        return self.task, self._whole(self.failure)

    def _joining(self) -> Task:
        parts = tuple(
            TaskPart(first=part.start, end=part.stop, ref=self.found[part].outputs[PART])
            for part in self.parts
        )
        self.running[self.task.address] = None
        return replace(self.task, parts=parts, parts_store=str(self.store.folder))

    def _whole(self, last: CellResult) -> CellResult:
        """Add to the last result what the parts said and took."""
        parts = [(self.called(part), self.found[part]) for part in self.parts if part in self.found]
        results = [*(result for _, result in parts), last]
        logs = [f"{name}, {result.wall_s:.1f} s:\n{result.log}" for name, result in parts]
        log = "".join([*logs, "joined:\n" if last.status == "ok" else "", last.log])
        write_whole(Path(self.task.log), log.encode())
        return replace(
            last,
            started=min(result.started for result in results),
            wall_s=round(sum(result.wall_s for result in results), 4),
            cpu_s=round(sum(result.cpu_s for result in results), 4),
            compile_s=round(sum(result.compile_s or 0.0 for result in results), 4),
            peak_rss_mib=max(result.peak_rss_mib for result in results),
            warnings=tuple(dict.fromkeys(text for result in results for text in result.warnings)),
            diagnostics=tuple(unique(one for result in results for one in result.diagnostics)),
            log=log,
        )


class Splits:
    """The steps of a run that are computed in parts."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._splits: dict[str, _Split] = {}
        self._cells: dict[str, str] = {}

    def begin(self, task: Task, facts: MethodFacts, n_parts: int, *, is_forced: bool) -> bool:
        """Compute a step in parts, if that makes sense.

        Args:
            task: of the whole step.
            facts: of its method.
            n_parts: so many, if there are as many items; what an interrupted run left counts too.
            is_forced: take nothing that is there.
        """
        folder = parts_folder(self._store) / task.key
        if facts.maps_over is None or (n_parts < 2 and not folder.is_dir()):
            return False
        if is_forced:
            remove_tree(folder)
        try:
            names = _item_names(self._store, task, facts.maps_over)
        except DamageError:
            # The step will say so, and its input be computed again.
            return False
        store = Store(folder)
        found = _found_parts(store, task.key, len(names))
        parts = tuple(_parts(len(names), n_parts, found))
        if len(parts) < 2:
            return False
        self._splits[task.address] = _Split(
            task=task,
            facts=facts,
            store=store,
            names=names,
            parts=parts,
            found=found,
            waiting=[part for part in parts if part not in found],
        )
        return True

    @property
    def addresses(self) -> tuple[str, ...]:
        """Addresses of the cells that are computed in parts now."""
        return tuple(self._splits)

    def has_key(self, key: str) -> bool:
        """Whether a step with this key is computed in parts now."""
        return any(split.task.key == key for split in self._splits.values())

    def next_task(self, address: str) -> Task | None:
        """Give the next task of a cell; None where nothing can begin now."""
        task = self._splits[address].next_task()
        if task is not None:
            self._cells[task.address] = address
        return task

    def take(self, task: Task, end: TaskEnd) -> tuple[Task, CellResult] | None:
        """Take the end of a task of any step; None where its step goes on.

        Returns:
            Task and result of the step, whether it was computed in parts or not.
        """
        address = self._cells.pop(task.address, None)
        if address is None:
            return task, end.result
        over = self._splits[address].take(task, end.result)
        if over is not None:
            del self._splits[address]
        return over

    def forget(self, key: str) -> None:
        """Remove the parts of a step whose result is in the store."""
        remove_tree(parts_folder(self._store) / key)

    def said_by(self, address: str, fraction: float) -> tuple[str, float]:
        """Say whose word that of a task is, and how far that cell is then.

        Args:
            address: of the task.
            fraction: how far the task is.
        """
        cell = self._cells.get(address)
        if cell is None:
            return address, fraction
        split = self._splits[cell]
        split.fractions[address] = fraction
        under_way = sum(split.fractions.get(name, 0.0) for name in split.running)
        return cell, min(1.0, (len(split.found) + under_way) / (len(split.parts) + 1))


def _item_names(store: Store, task: Task, mapped: MappedPort) -> tuple[str, ...]:
    items = store.product_metadata(task.inputs[mapped.port].ref.digest).get(mapped.field)
    return tuple(
        one_line((isinstance(item, dict) and item.get(mapped.item_name)) or nth, _LONGEST_NAME)
        for nth, item in enumerate(items if isinstance(items, list) else [], start=1)
    )


def _found_parts(store: Store, key: str, n_items: int) -> dict[range, CellResult]:
    """Parts that are there and do not overlap, the first ones first."""
    candidates: list[tuple[range, CellResult]] = []
    for path in store.results.glob("*.json"):
        result = store.take(path.stem).result
        said = read_preimage(result.key_preimage) if result is not None else {}
        first, end = said.get("first"), said.get("end")
        if (
            result is None
            or said.get("of") != key
            or type(first) is not int
            or type(end) is not int
        ):
            continue
        if 0 <= first < end <= n_items:
            candidates.append((range(first, end), result))
    found: dict[range, CellResult] = {}
    covered = 0
    for part, result in sorted(candidates, key=lambda item: (item[0].start, -item[0].stop)):
        if part.start >= covered:
            found[part] = result
            covered = part.stop
    return found


def _parts(n_items: int, n_parts: int, found: Mapping[range, CellResult]) -> Iterator[range]:
    """Cut the items into parts about as large as asked for, around those that are there."""
    size = -(-n_items // max(1, n_parts))
    begin = 0
    for part in (*found, range(n_items, n_items)):
        n_gap = part.start - begin
        n_cuts = -(-n_gap // size) if n_gap else 0
        bounds = [begin + n_gap * nth // n_cuts for nth in range(n_cuts + 1)] if n_cuts else []
        yield from (range(*bound) for bound in pairwise(bounds))
        if part:
            yield part
        begin = part.stop


def _key(step: str, part: range) -> tuple[str, str]:
    """Key of a part, and the text that it is the SHA-256 of."""
    text = canonical_json(
        {"what": _WHAT, "v": 1, "of": step, "first": part.start, "end": part.stop}
    )
    return hashlib.sha256(text.encode()).hexdigest(), text
