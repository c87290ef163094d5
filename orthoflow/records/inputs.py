"""Search for the input files of a record by content, and extraction of embedded ones."""

from __future__ import annotations

import dataclasses
import os
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Final

from orthoflow_provenance.document import (
    RecordedFile,
    RecordedInput,
)
from orthoflow_provenance.paths import (
    name_problem,
)
from orthoflow_provenance.record import extract_files

from orthoflow.engine.durability import writing_to
from orthoflow.engine.file_digests import FileDigests
from orthoflow.errors import InputError, OrthoflowError, PluginError, RecordError
from orthoflow.records.runs import Run, record_errors
from orthoflow.untrusted_text import first_few
from orthoflow.workflow.inputs import (
    InputOption,
    override_inputs,
    read_input_options,
    resolve_input_files,
    written_files,
)
from orthoflow.workflow.model import Workflow, WorkflowInputSpec
from orthoflow.workflow.source import ProblemLog

# Maximum number of files in a folder that is searched by content; larger ones only by name.
_MOST_LISTED: Final = 10_000
# By default, a run is in runs/<name>/ in the folder of its workflow.
_FOLDERS_ABOVE: Final = 3


class ProblemsError(OrthoflowError):
    """Several problems; `problems` has one sentence for each."""

    def __init__(self, problems: Iterable[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(self.problems))


class RefusedRunError(ProblemsError, RecordError):
    """A run cannot be repeated unchanged, or input files differ from the record."""


class MissingMethodsError(ProblemsError, PluginError):
    """Methods or product types in a record are not installed."""


@dataclass(frozen=True, kw_only=True)
class InputSearch:
    """Result of a search for input files.

    Attributes:
        paths: input -> its files in the order of the record; inputs that were not given are
            missing.
        problems: one sentence for each missing or changed file.
        is_changed: whether one of the files exists with different content.
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
    """Search for files with the content given in a record, under any name.

    If paths are given for an input, only these are searched; otherwise the extracted files;
    otherwise the paths in the workflow, relative to the working directory, the run folder and its
    parents, then these folders themselves, and the paths recorded in stores.

    Args:
        workflow: workflow of the record.
        recorded: recorded inputs.
        run_folder: folder of the record.
        digests: cache of digests, so that each file is read only once.
        given: `NAME=PATH` as for `--input`.
        extracted: input -> files extracted from the record.
        noted: caches of other stores that may contain paths of the files.

    Raises:
        InvalidArgumentsError: `given` contains a name that is not an input of the workflow.
        InputError: a given path does not exist.
    """
    places = _places(workflow, run_folder, given, extracted or {})
    paths: dict[str, tuple[Path, ...]] = {}
    problems: list[str] = []
    is_changed = False
    for entry in recorded:
        found = []
        for file in entry.files:
            path, rival = _find(file, places[entry.name], (digests, *noted))
            if path is not None:
                found.append(path)
                continue
            problems.append(_problem(entry.name, file, rival, places[entry.name].files))
            is_changed |= rival is not None
        paths[entry.name] = tuple(found)
    return InputSearch(paths=paths, problems=tuple(problems), is_changed=is_changed)


class PlacedInputs:
    """Input files of a record under their recorded names, in a temporary folder.

    Attributes:
        extracted: input -> files extracted from the record.
    """

    def __init__(self, beside: Path, stack: ExitStack) -> None:
        self.extracted: Mapping[str, tuple[Path, ...]] = {}
        self._beside = beside
        self._stack = stack
        self._folders: list[Path] = []

    def folder(self) -> Path:
        """Create a new folder.

        Raises:
            StoreError: the disk cannot be written.
        """
        with writing_to(self._beside):
            if not self._folders:
                self._beside.mkdir(parents=True, exist_ok=True)
                made = tempfile.TemporaryDirectory(prefix=".inputs-", dir=self._beside)
                self._folders.append(Path(self._stack.enter_context(made)))
            self._folders.append(self._folders[0] / f"{len(self._folders):06}")
            self._folders[-1].mkdir()
        return self._folders[-1]

    def named(self, entry: RecordedInput, paths: tuple[Path, ...]) -> tuple[Path, ...]:
        """Return the files found for an input, under their recorded names and in recorded order.

        Raises:
            StoreError: the disk cannot be written.
        """
        names = [file.name for file in entry.files]
        # Files with the same name are sorted by folder, so they need new folders to keep their
        # order.
        if [path.name for path in paths] == names and len(set(names)) == len(names):
            return paths
        links = tuple(self.folder() / name for name in names)
        for link, path in zip(links, paths, strict=True):
            with writing_to(link.parent):
                link.symlink_to(path)
        return links


@contextmanager
def embedded_inputs(run: Run, beside: Path) -> Iterator[PlacedInputs]:
    """Extract the input files embedded in a record while the block runs.

    Args:
        run: the run.
        beside: folder on a disk with enough space, created if missing.

    Raises:
        RecordError: the record is damaged.
        StoreError: the disk cannot be written.
    """
    with ExitStack() as stack:
        placed = PlacedInputs(beside, stack)
        if any(entry.embedded for entry in run.record.inputs):
            folder = placed.folder()
            with record_errors(run.path), writing_to(folder):
                placed.extracted = extract_files(run.path, run.record.inputs, folder)
        yield placed


def _find(
    file: RecordedFile, places: _Places, memories: Sequence[FileDigests]
) -> tuple[Path | None, Path | None]:
    """Return the file, and a file with its name but different content; None if not found."""
    rival = None
    seen: set[Path] = set()
    for path in places.candidates(file, memories):
        size_bytes = _size_of_file(path)
        if path in seen or size_bytes is None:
            continue
        seen.add(path)
        try:
            if size_bytes == file.size_bytes and memories[0].digest(path).sha256 == file.sha256:
                return path.absolute(), None
        except InputError:
            # Ignore unreadable files that were not given explicitly and have another name.
            if path.name == file.name or places.files:
                raise
            continue
        if path.name == file.name:
            rival = rival or path
    return None, rival


def _problem(name: str, file: RecordedFile, rival: Path | None, given: tuple[Path, ...]) -> str:
    digest = f"SHA-256 {file.sha256[:12]}..."
    expected = f"{file.size_bytes} bytes with the {digest}"
    if rival is not None:
        return (
            f"input {name}: {rival} differs from the recorded {file.name}: it was changed "
            f"(expected {expected})"
        )
    if given:
        return (
            f"input {name}: the recorded {file.name} is not among the given files, "
            f"{first_few([str(path) for path in given])} (expected {expected}, under any name)"
        )
    return (
        f"input {name}: {file.name} ({file.size_bytes} bytes, {digest}) was not found; give it"
        f" with --input {name}=PATH"
    )


def _size_of_file(path: Path) -> int | None:
    """Return the size of a regular, accessible file; otherwise None."""
    try:
        state = path.stat()
    except (OSError, ValueError):
        return None
    return state.st_size if stat.S_ISREG(state.st_mode) else None


@dataclass(frozen=True, kw_only=True)
class _Places:
    """Candidate paths for the files of one input: folders to search, or given files.

    Attributes:
        folders: folders to search.
        files: files given by the user or extracted from the record; `folders` is then empty.
        listed: function that returns the files directly in a folder, by size.
    """

    folders: tuple[Path, ...] = ()
    files: tuple[Path, ...] = ()
    listed: Callable[[Path], Mapping[int, list[Path]]]

    def candidates(self, file: RecordedFile, memories: Sequence[FileDigests]) -> Iterator[Path]:
        """Yield candidate paths of a file, most likely first: with its name, then others."""
        if name_problem(file.name):
            return
        yield from (path for path in self.files if path.name == file.name)
        yield from (folder / file.name for folder in self.folders)
        yield from self.files
        if self.files:
            return
        noted = [memory.place(file.sha256) for memory in memories]
        seen_last = [path for path in noted if path is not None]
        yield from seen_last
        for folder in dict.fromkeys((*self.folders, *(path.parent for path in seen_last))):
            yield from self.listed(folder.absolute()).get(file.size_bytes, ())


def _listed(folder: Path) -> Mapping[int, list[Path]]:
    """Return the files directly in a folder by size; empty if it cannot be read."""
    found: dict[int, list[Path]] = {}
    try:
        with os.scandir(folder) as entries:
            for entry in islice(entries, _MOST_LISTED):
                if entry.is_file() and not name_problem(entry.name):
                    found.setdefault(entry.stat().st_size, []).append(folder / entry.name)
    except OSError:
        return {}
    return {size: sorted(paths) for size, paths in found.items()}


def _places(
    workflow: Workflow,
    run_folder: Path,
    given: Sequence[str],
    extracted: Mapping[str, tuple[Path, ...]],
) -> dict[str, _Places]:
    log = ProblemLog(file="")
    specs = workflow.input_specs
    options = _of_all_datasets(read_input_options(given, log), specs)
    overridden = override_inputs(specs, options, log)
    log.raise_any()
    found = {name: spec for name, spec in overridden.items() if spec.is_given}
    by_hand = resolve_input_files(dataclasses.replace(workflow, inputs=found, datasets={}))
    roots = dict.fromkeys(
        (Path(), run_folder, *run_folder.absolute().parents[: _FOLDERS_ABOVE - 1])
    )
    # The resolved workflow contains options instead of the paths in the file, and no folders.
    written = written_files(workflow.source)
    places: dict[str, _Places] = {}
    # List each folder only once.
    listed = cache(_listed)
    for name, spec in specs.items():
        by_name = by_hand.get(name)
        files = by_name.paths if by_name is not None else extracted.get(name)
        if files is not None:
            places[name] = _Places(files=files, listed=listed)
            continue
        texts = (*spec.files, *written.get(name, ()))
        named = [
            root / folder
            for root in roots
            for pattern in map(Path, dict.fromkeys(texts))
            for folder in (pattern.parent, pattern)
        ]
        folders = tuple(dict.fromkeys((*named, *roots)))
        places[name] = _Places(folders=folders, listed=listed)
    return places


def _of_all_datasets(
    options: Sequence[InputOption], specs: Mapping[str, WorkflowInputSpec]
) -> tuple[InputOption, ...]:
    """Apply `scan=FOLDER` to `scan@...` of all datasets, if there is no input `scan`."""

    def meant(name: str) -> Sequence[str]:
        own = [found for found in specs if found.partition("@")[0] == name]
        return own if name not in specs and own else [name]

    return tuple(
        dataclasses.replace(option, name=name) for option in options for name in meant(option.name)
    )
