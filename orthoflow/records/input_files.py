"""The input files of a record, found again: by content wherever they lie now, or in the record."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow_provenance.inner_files import name_problem
from orthoflow_provenance.input_files import extract_files
from orthoflow_provenance.model import RecordedFile, RecordedInput

from orthoflow.engine.durability import writing_to
from orthoflow.engine.file_digests import FileDigests
from orthoflow.files.yaml_positions import Table, read_yaml
from orthoflow.records.runs import Run, record_errors
from orthoflow.workflow.format import Workflow, WorkflowInputSpec
from orthoflow.workflow.inputs import (
    InputOption,
    override_inputs,
    read_input_options,
    read_inputs,
    resolve_input_files,
)
from orthoflow.workflow.problems import ProblemLog

# A run lies in runs/<name>/ below the folder of its workflow, when nobody says otherwise.
_FOLDERS_ABOVE: Final = 3


@dataclass(frozen=True, kw_only=True)
class InputSearch:
    """What a search found.

    Attributes:
        paths: input -> its files in the order of the record; inputs that were not given have none.
        problems: one sentence per file that is missing or was changed.
    """

    paths: Mapping[str, tuple[Path, ...]]
    problems: tuple[str, ...]


def find_inputs(
    workflow: Workflow,
    recorded: Sequence[RecordedInput],
    run_folder: Path,
    digests: FileDigests,
    *,
    given: Sequence[str] = (),
    extracted: Mapping[str, tuple[Path, ...]] | None = None,
) -> InputSearch:
    """Look for files with the content and the name that a record states.

    Looks where `given` says; else among the `extracted`; else at the places that the workflow
    names, below the working directory, the run's folder and the folders above it, and in these
    folders themselves.

    Args:
        workflow: of the record.
        recorded: the record's inputs.
        run_folder: the folder of the record.
        digests: remembers digests, so that each file is read once.
        given: `NAME=PATH`, each as behind `--input`.
        extracted: input -> files that lay in the record itself.

    Raises:
        InvalidArgumentsError: `given` names no input of the workflow.
        InputError: there is nothing at a given path.
    """
    places = _places(workflow, run_folder, given, extracted or {})
    paths: dict[str, tuple[Path, ...]] = {}
    problems: list[str] = []
    for entry in recorded:
        found = []
        for file in entry.files:
            where = _find(entry.name, file, places[entry.name], digests)
            if isinstance(where, Path):
                found.append(where)
            else:
                problems.append(where)
        paths[entry.name] = tuple(found)
    return InputSearch(paths=paths, problems=tuple(problems))


@contextmanager
def embedded_inputs(run: Run, beside: Path) -> Iterator[Mapping[str, tuple[Path, ...]]]:
    """Give the input files that lie in a record as files, as long as the context lasts.

    Args:
        run: the run.
        beside: folder on a disk with room for them, made when missing.

    Raises:
        RecordError: the record is damaged.
        StoreError: the disk refuses.
    """
    if not any(entry.embedded for entry in run.record.inputs):
        yield {}
        return
    with writing_to(beside):
        beside.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".inputs-", dir=beside) as folder:
        with record_errors(run.path), writing_to(Path(folder)):
            files = extract_files(run.path, run.record.inputs, Path(folder))
        yield files


def _find(name: str, file: RecordedFile, places: _Places, digests: FileDigests) -> Path | str:
    """The file, or a sentence that says why there is none."""
    same_name: list[Path] = []
    for path in places.candidates(file.name):
        if path in same_name or not path.is_file():
            continue
        is_same_size = path.stat().st_size == file.size_bytes
        if is_same_size and digests.digest(path).sha256 == file.sha256:
            return path.absolute()
        same_name.append(path)
    if same_name:
        return (
            f"input {name}: {same_name[0]} is not the {file.name} of the record: it was changed "
            f"(expected {file.size_bytes} bytes with the SHA-256 {file.sha256[:12]}...)"
        )
    return (
        f"input {name}: {file.name} ({file.size_bytes} bytes, SHA-256 {file.sha256[:12]}...) is "
        f"not to be found; give it with --input {name}=PATH"
    )


@dataclass(frozen=True, kw_only=True)
class _Places:
    """Where the files of one input may lie: in folders, or exactly here when a user says so."""

    folders: tuple[Path, ...] = ()
    files: tuple[Path, ...] = ()

    def candidates(self, name: str) -> Iterator[Path]:
        """Paths at which a file of that name may be, the likeliest first."""
        if name_problem(name):
            return
        yield from (path for path in self.files if path.name == name)
        yield from (folder / name for folder in self.folders)


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
    written = _written_specs(workflow)
    places: dict[str, _Places] = {}
    for name, spec in specs.items():
        by_name = by_hand.get(name)
        files = by_name.paths if by_name is not None else extracted.get(name)
        if files is not None:
            places[name] = _Places(files=files)
            continue
        texts = (*spec.files, *(written[name].files if name in written else ()))
        named = [
            root / folder
            for root in roots
            for pattern in map(Path, dict.fromkeys(texts))
            for folder in (pattern.parent, pattern)
        ]
        places[name] = _Places(folders=tuple(dict.fromkeys((*named, *roots))))
    return places


def _of_all_datasets(
    options: Sequence[InputOption], specs: Mapping[str, WorkflowInputSpec]
) -> tuple[InputOption, ...]:
    """Let `scan=FOLDER` stand for the `scan@...` of every dataset, where there is no other scan."""

    def meant(name: str) -> Sequence[str]:
        own = [found for found in specs if found.partition("@")[0] == name]
        return own if name not in specs and own else [name]

    return tuple(
        dataclasses.replace(option, name=name) for option in options for name in meant(option.name)
    )


def _written_specs(workflow: Workflow) -> Mapping[str, WorkflowInputSpec]:
    """What the file itself names: the resolved form has options in its place, and no folders."""
    log = ProblemLog(file="")
    document = read_yaml(workflow.source, log)
    section = document.get("inputs") if isinstance(document, Table) else None
    return read_inputs(section.value, Path(), log) if section else {}
