"""Search for the input files of a record by content, and extraction of embedded input files."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from orthoflow_provenance.document import RecordedFile, RecordedInput
from orthoflow_provenance.paths import name_problem
from orthoflow_provenance.record import extract_files

from orthoflow.engine.durability import writing_to
from orthoflow.engine.file_digests import FileDigests
from orthoflow.errors import OrthoflowError, PluginError, RecordError
from orthoflow.records.runs import Run, record_errors
from orthoflow.workflow.inputs import (
    override_inputs,
    read_input_options,
    resolve_input_files,
    written_files,
)
from orthoflow.workflow.model import Workflow
from orthoflow.workflow.source import ProblemLog


class ProblemsError(OrthoflowError):
    """Several problems; `problems` contains one sentence for each."""

    def __init__(self, problems: Iterable[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(self.problems))


class RefusedRunError(ProblemsError, RecordError):
    """A run cannot be repeated unchanged, or input files differ from the record."""


class MissingMethodsError(ProblemsError, PluginError):
    """Methods or product types that a record needs are not installed."""


@dataclass(frozen=True, kw_only=True)
class InputSearch:
    """Result of a search for input files.

    Attributes:
        paths: input -> its files in the order of the record; optional inputs that were not given
            are omitted.
        problems: one sentence for each missing or changed file.
        is_changed: whether one of the files was found with different content.
    """

    paths: Mapping[str, tuple[Path, ...]]
    problems: tuple[str, ...]
    is_changed: bool


def find_inputs(
    workflow: Workflow,
    recorded: Sequence[RecordedInput],
    run_folder: Path,
    digests: FileDigests,
    *,
    given: Sequence[str] = (),
    extracted: Mapping[str, tuple[Path, ...]] | None = None,
    noted: Sequence[FileDigests] = (),
) -> InputSearch:
    """Search for files with the content given in a record.

    If paths are given for an input, only these are searched, and the files may have any name.
    Otherwise, the files extracted from the record are used. If there are none, two places are
    searched: the paths that stores have recorded for the content, and the paths in the workflow,
    relative to the working directory and to the run folder.

    Args:
        workflow: workflow of the record.
        recorded: recorded inputs.
        run_folder: folder of the record.
        digests: cache of digests, so that each file is read only once.
        given: inputs as `NAME=PATH`, as for `--input`.
        extracted: input -> files extracted from the record.
        noted: digest caches of other stores, which may contain paths of the files.

    Raises:
        InvalidArgumentsError: `given` contains a name that is not an input of the workflow.
        InputError: a given path does not exist, or a file cannot be read.
    """
    known = {**(extracted or {}), **_given_files(workflow, given)}
    written = written_files(workflow.source)
    paths: dict[str, tuple[Path, ...]] = {}
    problems: list[str] = []
    is_changed = False
    for entry in recorded:
        named = [Path(), *map(Path, written.get(entry.name.partition("@")[0], ()))]
        named += map(Path, workflow.input_specs[entry.name].files)
        inside = [part for path in named for part in (path, path.parent)]
        folders = [root / part for root in (Path(), run_folder) for part in inside]
        found = []
        for file in entry.files:
            if entry.name in known:
                candidates = list(known[entry.name])
            else:
                candidates = _candidates(file, folders, (digests, *noted))
            path = next((one for one in candidates if _is_same(one, file, digests)), None)
            if path is not None:
                found.append(path.absolute())
                continue
            rival = next((path for path in candidates if path.name == file.name), None)
            is_changed |= rival is not None
            problems.append(
                f"input {entry.name}: no file with the content of the recorded {file.name} "
                f"({file.size_bytes} bytes, SHA-256 {file.sha256[:12]}...) was found; "
                + (f"{rival} has been changed" if rival else f"pass --input {entry.name}=PATH")
            )
        paths[entry.name] = tuple(found)
    return InputSearch(paths=paths, problems=tuple(problems), is_changed=is_changed)


def _given_files(workflow: Workflow, given: Sequence[str]) -> dict[str, tuple[Path, ...]]:
    """Return the files given with `--input`.

    `scan=FOLDER` applies to the input `scan` of all datasets.
    """
    log = ProblemLog(file="")
    specs = workflow.input_specs
    options = [
        dataclasses.replace(option, name=name)
        for option in read_input_options(given, log)
        for name in [name for name in specs if name.partition("@")[0] == option.name]
        or [option.name]
    ]
    overridden = override_inputs(specs, options, log)
    log.raise_any()
    found = {name: spec for name, spec in overridden.items() if spec.is_given}
    resolved = resolve_input_files(dataclasses.replace(workflow, inputs=found, datasets={}))
    return {name: entry.paths for name, entry in resolved.items() if entry is not None}


def _candidates(
    file: RecordedFile, folders: Sequence[Path], memories: Sequence[FileDigests]
) -> list[Path]:
    seen = [path for memory in memories if (path := memory.place(file.sha256)) is not None]
    if not name_problem(file.name):
        seen += [folder / file.name for folder in folders]
    return [path for path in dict.fromkeys(seen) if _is_file(path)]


def _is_file(path: Path) -> bool:
    with suppress(OSError):
        return path.is_file()
    return False


def _is_same(path: Path, file: RecordedFile, digests: FileDigests) -> bool:
    is_as_large = path.stat().st_size == file.size_bytes
    return is_as_large and digests.digest(path).sha256 == file.sha256


class PlacedInputs:
    """Input files of a record under their recorded names, in a temporary folder.

    Attributes:
        extracted: input -> files extracted from the record.
    """

    def __init__(self, beside: Path, stack: ExitStack) -> None:
        self.extracted: Mapping[str, tuple[Path, ...]] = {}
        self._beside = beside
        self._stack = stack

    @cached_property
    def folder(self) -> Path:
        """The temporary folder, which is created on first use.

        Raises:
            StoreError: the disk cannot be written to.
        """
        with writing_to(self._beside):
            self._beside.mkdir(parents=True, exist_ok=True)
            made = tempfile.TemporaryDirectory(prefix=".inputs-", dir=self._beside)
            return Path(self._stack.enter_context(made))

    def named(self, entry: RecordedInput, paths: tuple[Path, ...]) -> tuple[Path, ...]:
        """Return files with the names and order recorded for an input; create links if needed.

        Raises:
            StoreError: the disk cannot be written to.
        """
        names = [file.name for file in entry.files]
        # Files with the same name are sorted by folder, so put each in a numbered folder to keep
        # the order.
        if [path.name for path in paths] == names and len(set(names)) == len(names):
            return paths
        links = []
        with writing_to(self.folder):
            for index, (name, path) in enumerate(zip(names, paths, strict=True)):
                links.append(self.folder / "links" / entry.name / f"{index:06}" / name)
                links[-1].parent.mkdir(parents=True)
                links[-1].symlink_to(path)
        return tuple(links)


@contextmanager
def embedded_inputs(run: Run, beside: Path) -> Iterator[PlacedInputs]:
    """Extract the input files embedded in a record while the block runs.

    Args:
        run: the run.
        beside: parent of the temporary folder, on a disk with enough space; created if missing.

    Raises:
        RecordError: the record is damaged.
        StoreError: the disk cannot be written to.
    """
    with ExitStack() as stack:
        placed = PlacedInputs(beside, stack)
        if any(entry.embedded for entry in run.record.inputs):
            folder = placed.folder / "embedded"
            with record_errors(run.path), writing_to(folder):
                placed.extracted = extract_files(run.path, run.record.inputs, folder)
        yield placed
