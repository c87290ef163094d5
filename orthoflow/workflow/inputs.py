"""Inputs of a workflow: what its file names, what `--input` puts in the place, what is there."""

from __future__ import annotations

import glob
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path
from typing import Final

from orthoflow.alike import first_few
from orthoflow.catalog.wording import did_you_mean
from orthoflow.errors import InputError
from orthoflow.files.yaml_positions import Value, join
from orthoflow.products.input_files import InputFiles
from orthoflow.workflow.format import FILES, INPUT, INPUTS, OPTIONAL, Workflow, WorkflowInputSpec
from orthoflow.workflow.problems import ProblemLog

# Files and folders that are looked at for one input: `/**` would go on for hours.
MOST_LOOKED_AT: Final = 100_000
_MOST_LISTED: Final = 12
_MOST_BESIDE: Final = 200


class MissingInputsError(InputError):
    """Input files are missing; `problems` says which, of many the first."""

    def __init__(self, problems: Sequence[str], *, most: int = 100) -> None:
        self.problems = tuple(problems)
        n_more = len(problems) - most
        more = [f"and {n_more} more have no files"] if n_more > 0 else []
        super().__init__("\n".join([*problems[:most], *more]))


def read_inputs(value: Value, folder: Path, log: ProblemLog) -> dict[str, WorkflowInputSpec]:
    """Read the section `inputs`.

    Args:
        value: the section.
        folder: folder of the workflow file.
        log: takes the problems.
    """
    specs: dict[str, WorkflowInputSpec] = {}
    for entry in INPUTS.shape.read(value, INPUTS.name, log) or ():
        path = join(INPUTS.name, entry.key)
        table = INPUT.read(entry.value, path, log)
        named = table.get(FILES.name) if table else None
        specs[entry.key] = WorkflowInputSpec(
            name=entry.key,
            files=(FILES.read(table, path, log) or ()) if table else (),
            optional=bool(table and OPTIONAL.read(table, path, log)),
            folder=folder,
            place=log.place(named.value.position, join(path, FILES.name)) if named else None,
        )
    return specs


@dataclass(frozen=True, kw_only=True)
class InputOption:
    """One `--input`.

    Attributes:
        name: of the workflow's input.
        path: a file, a folder or a glob, relative to the working directory.
    """

    name: str
    path: str

    def __str__(self) -> str:
        return f"--input {self.name}={self.path}"

    @property
    def is_of_dataset(self) -> bool:
        """Whether it names the input of one dataset, as in `scan@hall`."""
        return "@" in self.name

    @property
    def without_folder(self) -> str:
        """The option as a record keeps it, which names no folder of this machine."""
        return f"--input {self.name}={Path(self.path).name}"


def read_input_options(texts: Sequence[str], log: ProblemLog) -> tuple[InputOption, ...]:
    """Read what stands behind each `--input`; what is no NAME=PATH goes to the log."""
    options = []
    for text in texts:
        name, _, path = text.partition("=")
        if name and path:
            options.append(InputOption(name=name, path=path))
        else:
            log.add_option(f"--input {text}", "expected NAME=PATH")
    return tuple(options)


def override_inputs(
    specs: Mapping[str, WorkflowInputSpec], options: Sequence[InputOption], log: ProblemLog
) -> dict[str, WorkflowInputSpec]:
    """Put files from the command line over the file's inputs; several of one name add up."""
    changed = dict(specs)
    for option in options:
        name = option.name
        if name not in specs:
            log.add_option(
                str(option),
                f"there is no input {name}{did_you_mean(name, specs)}; inputs: {some_of(specs)}",
            )
        else:
            before = changed[name].files if changed[name].is_given else ()
            changed[name] = replace(
                specs[name], files=(*before, option.path), folder=Path.cwd(), is_given=True
            )
    return changed


def check_shared_inputs(
    workflow: Workflow, options: Sequence[InputOption], log: ProblemLog
) -> None:
    """Refuse files for an input of which every dataset has its own."""
    for option in options:
        if option.name in workflow.inputs and option.name not in workflow.input_specs:
            example = workflow.chosen_data[0].inputs[option.name].name
            log.add_option(
                str(option),
                f"every dataset has its own {option.name}; name that of one of them, as in --input "
                f"{example}=PATH",
            )


def resolve_input_files(workflow: Workflow) -> Mapping[str, InputFiles | None]:
    """Find the files of every input, sorted by name; None for optional data that are absent.

    A file stands for itself, a folder for the files directly in it (hidden ones left out), a
    pattern for the files it matches (`**` for folders at any depth).

    Raises:
        InputError: a file is missing, a folder is empty, a pattern matches nothing, or an input
            that is not optional was given no files; says so of every input. An optional input may
            be missing unless it was named on the command line or by a dataset.
    """
    found: dict[str, InputFiles | None] = {}
    missing: list[str] = []
    for spec in workflow.input_specs.values():
        try:
            found[spec.name] = _resolve(spec)
        except InputError as error:
            missing.append(str(error))
    if len(missing) == 1:
        raise InputError(missing[0])
    if missing:
        raise MissingInputsError(missing, most=_MOST_LISTED)
    return found


def add_missing_inputs(workflow: Workflow, log: ProblemLog) -> None:
    """Add to the problems of a workflow the inputs whose files are missing."""
    for spec in workflow.input_specs.values():
        try:
            _resolve(spec)
        except InputError as error:
            place = _place(spec)
            log.add_input(spec.place if place else None, str(error).removeprefix(place))


def present_inputs(workflow: Workflow) -> frozenset[str]:
    """Names of the inputs that are there; those that are not optional always count as there."""
    return frozenset(
        spec.name
        for spec in workflow.input_specs.values()
        if not spec.optional or _resolve(spec) is not None
    )


def some_of(names: Collection[str]) -> str:
    """Name what there is, of many only the first.

    >>> some_of(["scan", "photos"]), some_of([])
    ('scan, photos', 'none')
    """
    return first_few(list(names), most=_MOST_LISTED) or "none"


def _resolve(spec: WorkflowInputSpec) -> InputFiles | None:
    if not spec.files:
        if spec.optional:
            return None
        raise InputError(
            f"input {spec.name} has no files; name them in the workflow or with "
            f"--input {spec.name}=PATH"
        )
    try:
        paths = {path for pattern in spec.files for path in _find(spec, pattern)}
    except InputError:
        if spec.optional and not spec.is_given:
            return None
        raise
    return InputFiles(name=spec.name, paths=tuple(sorted(paths, key=lambda p: (p.name, str(p)))))


def _find(spec: WorkflowInputSpec, pattern: str) -> list[Path]:
    path = spec.folder / pattern
    beside = f"the table {spec.said_in}" if spec.said_in else "the workflow"
    where = " in the working directory" if spec.is_given else f" beside {beside} ({path})"
    if Path(pattern).is_absolute():
        where = ""
    look = _Look(f"input {spec.name}: {pattern}{where}")
    if path.is_dir():
        files = [item for item in look.below(path) if item.name[0] != "."]
        missing = f"the folder {pattern}{where} holds no files"
    elif path.exists():
        files, missing = [path], ""
    elif glob.has_magic(pattern):
        # Names may themselves hold brackets; only what is no existing path is taken as a pattern.
        files = [match for match in look.for_pattern(spec.folder, pattern) if match.is_file()]
        missing = f"no file matches {pattern}{where}"
    else:
        files, missing = [], f"there is no file {pattern}{where}{_meant(path)}"
    if not files:
        raise InputError(f"{_place(spec)}input {spec.name}: {missing}")
    return [item.absolute() for item in files]


def _place(spec: WorkflowInputSpec) -> str:
    return spec.place.place if spec.place and not spec.is_given else ""


def _meant(path: Path) -> str:
    """Ask whether a file beside it was meant, empty where none is called alike."""
    with suppress(OSError):
        beside = [item.name for item in islice(path.parent.iterdir(), _MOST_BESIDE)]
        return did_you_mean(path.name, beside)
    return ""


class _Look:
    """Looks into folders, and counts what it sees there."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._n_seen = 0

    def into(self, folder: Path) -> Iterator[Path]:
        """Give what lies in a folder, nothing when it cannot be read.

        Raises:
            InputError: it was too much.
        """
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    self._n_seen += 1
                    if self._n_seen > MOST_LOOKED_AT:
                        raise InputError(
                            f"{self._what} has more than {MOST_LOOKED_AT} files and folders to "
                            "look at; name a folder nearer to the files"
                        )
                    yield folder / entry.name
        except OSError:
            return

    def below(self, folder: Path) -> Iterator[Path]:
        """Yield the files in a folder and its subfolders; links to folders are not followed."""
        waiting = [folder]
        while waiting:
            for path in self.into(waiting.pop()):
                if path.is_dir():
                    if path.name[0] != "." and not path.is_symlink():
                        waiting.append(path)
                elif path.is_file():
                    yield path

    def for_pattern(self, folder: Path, pattern: str) -> list[Path]:
        """Give what a pattern matches below a folder, as `glob` does with `recursive`.

        Raises:
            InputError: it was too much.
        """
        anchor = Path(pattern).anchor
        found = [folder / anchor]
        for part in Path(pattern).parts[bool(anchor) :]:
            matches = (path for place in found for path in self._matches(place, part))
            # `**/**` comes to one place by many ways.
            found = list(dict.fromkeys(matches))
        return found

    def _matches(self, folder: Path, part: str) -> Iterator[Path]:
        if part == "**":
            yield from self._below(folder)
        elif not glob.has_magic(part) or os.path.lexists(folder / part):
            yield folder / part
        else:
            for path in self.into(folder):
                if fnmatchcase(path.name, part) and (path.name[0] != "." or part[0] == "."):
                    yield path

    def _below(self, folder: Path) -> Iterator[Path]:
        waiting = [folder]
        while waiting:
            place = waiting.pop()
            yield place
            waiting += (path for path in self.into(place) if path.name[0] != ".")
