"""Inputs and datasets of a workflow: file names, overrides and the search for files."""

from __future__ import annotations

import csv
import glob
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

from orthoflow.errors import InputError, WorkflowError, did_you_mean
from orthoflow.files.yaml_positions import Document, Location, Position, describe
from orthoflow.products.input_files import InputFiles
from orthoflow.products.product import JsonValue
from orthoflow.untrusted_text import first_few
from orthoflow.workflow.model import (
    DATA,
    SEED,
    Dataset,
    DatasetSection,
    DatasetsSection,
    InputSection,
    SeedSection,
    StepVariant,
    Workflow,
    WorkflowFile,
    WorkflowInputSpec,
)
from orthoflow.workflow.parameters import (
    DraftStep,
    Overrides,
    Report,
    overrides_of_settings,
    resolve_call,
)
from orthoflow.workflow.source import ProblemLog, read_text, validate

#: bytes of a table of datasets
MOST_TABLE_BYTES: Final = 4_000_000
#: datasets in a table
MOST_DATASETS: Final = 10_000
_MOST_LISTED: Final = 12
_MOST_BESIDE: Final = 200
_DATASETS: Final = "datasets"
_NOWHERE: Final = Position(line=0, column=0)
_NUMBER: Final = re.compile(r"-?(0|[1-9]\d{0,14})(\.\d{1,15})?")
# The first of these characters that occurs in the header is the separator.
_SEPARATORS: Final = (";", "\t", ",")


class MissingInputsError(InputError):
    """Input files are missing; `problems` contains one sentence for each input."""

    def __init__(self, problems: Sequence[str], *, most: int = 100) -> None:
        self.problems = tuple(problems)
        n_more = len(problems) - most
        more = [f"and {n_more} more inputs have no files"] if n_more > 0 else []
        super().__init__("\n".join([*problems[:most], *more]))


# Inputs in the file and on the command line
# --------------------------------------------------------


def input_specs(
    sections: Mapping[str, InputSection], folder: Path, log: ProblemLog
) -> dict[str, WorkflowInputSpec]:
    """Return the inputs of a workflow file in a given folder."""
    return {
        name: WorkflowInputSpec(
            name=name,
            files=section.files,
            optional=section.optional,
            folder=folder,
            place=log.place(("inputs", name, "files")) if section.files else None,
        )
        for name, section in sections.items()
    }


def written_files(source: str) -> Mapping[str, tuple[str, ...]]:
    """Return input -> files as written in the text of a workflow."""
    log = ProblemLog(file="")
    log.parse(source)
    file = validate(WorkflowFile, {"inputs": log.get(("inputs",)) or {}}, log) or WorkflowFile()
    return {name: spec.files for name, spec in file.inputs.items()}


@dataclass(frozen=True, kw_only=True)
class InputOption:
    """A value of `--input`.

    Attributes:
        name: name of the workflow input.
        path: a file, a folder or a glob pattern, relative to the working directory.
    """

    name: str
    path: str

    def __str__(self) -> str:
        return f"--input {self.name}={self.path}"

    @property
    def is_of_dataset(self) -> bool:
        """Whether the option refers to the input of one dataset, as in `scan@hall`."""
        return "@" in self.name

    @property
    def without_folder(self) -> str:
        """The option as it is recorded, without the folders of this machine."""
        return f"--input {self.name}={Path(self.path).name}"


def read_input_options(texts: Sequence[str], log: ProblemLog) -> tuple[InputOption, ...]:
    """Parse the values of `--input`; report values that are not NAME=PATH."""
    options = []
    for text in texts:
        name, _, path = text.partition("=")
        if name and path:
            options.append(InputOption(name=name, path=path))
        else:
            log.report_option(f"--input {text}", "expected NAME=PATH")
    return tuple(options)


def override_inputs(
    specs: Mapping[str, WorkflowInputSpec], options: Sequence[InputOption], log: ProblemLog
) -> dict[str, WorkflowInputSpec]:
    """Replace input files by those on the command line; join options for the same input."""
    changed = dict(specs)
    for option in options:
        name = option.name
        if name not in specs:
            log.report_option(
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
    """Report options for inputs that every dataset sets itself."""
    for option in options:
        if option.name in workflow.inputs and option.name not in workflow.input_specs:
            example = workflow.chosen_data[0].inputs[option.name].name
            log.report_option(
                str(option),
                f"every dataset has its own {option.name}; name the dataset, as in --input "
                f"{example}=PATH",
            )


def some_of(names: Collection[str]) -> str:
    """Return the names as a list, shortened if there are many.

    >>> some_of(["scan", "photos"]), some_of([])
    ('scan, photos', 'none')
    """
    return first_few(list(names), most=_MOST_LISTED) or "none"


def resolve_input_files(workflow: Workflow) -> Mapping[str, InputFiles | None]:
    """Return input -> files, sorted by name; None for an optional input without files.

    A path may be a file, a folder or a glob pattern. A folder stands for all files in it and in its
    subfolders, except hidden files. A pattern stands for all matching files; `**` matches folders
    at any depth.

    Raises:
        InputError: a file is missing, a folder is empty, a pattern has no match, or a required
            input has no files; the message lists all such inputs. An optional input may be missing
            unless it was given on the command line or in a dataset.
    """
    found: dict[str, InputFiles | None] = {}
    missing: list[str] = []
    for spec in workflow.input_specs.values():
        try:
            found[spec.name] = _resolve(spec)
        except InputError as error:
            place = spec.place.place if spec.place and not spec.is_given else ""
            missing.append(f"{place}{error}")
    if len(missing) == 1:
        raise InputError(missing[0])
    if missing:
        raise MissingInputsError(missing, most=_MOST_LISTED)
    return found


def add_missing_inputs(workflow: Workflow, log: ProblemLog) -> None:
    """Add a problem for each input whose files are missing."""
    for spec in workflow.input_specs.values():
        try:
            _resolve(spec)
        except InputError as error:
            log.report_input(None if spec.is_given else spec.place, str(error))


def present_inputs(workflow: Workflow) -> frozenset[str]:
    """Return the names of available inputs; required inputs are assumed to be available."""
    return frozenset(
        spec.name
        for spec in workflow.input_specs.values()
        if not spec.optional or _resolve(spec) is not None
    )


def _resolve(spec: WorkflowInputSpec) -> InputFiles | None:
    if not spec.files:
        if spec.optional:
            return None
        raise InputError(
            f"input {spec.name} has no files; list them in the workflow, or pass --input "
            f"{spec.name}=PATH"
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
    beside = f"the table {spec.table}" if spec.table else "the workflow"
    where = " in the working directory" if spec.is_given else f" next to {beside} ({path})"
    if Path(pattern).is_absolute():
        where = ""
    if path.is_dir():
        files = [item for item in _below(path) if item.is_file()]
        missing = f"the folder {pattern}{where} contains no files"
    elif path.exists():
        files, missing = [path], ""
    elif path.is_symlink():
        files = []
        missing = f"{pattern}{where} is a link to {path.readlink()}, which does not exist"
    elif glob.has_magic(pattern):
        # A file name may contain brackets, so a path is a pattern only if it does not exist.
        # `Path.glob` does not support absolute patterns.
        matches = glob.iglob(pattern, root_dir=spec.folder, recursive=True)  # noqa: PTH207
        files = [spec.folder / match for match in matches if (spec.folder / match).is_file()]
        missing = f"no file matches {pattern}{where}"
    else:
        files, missing = [], f"there is no file {pattern}{where}{_meant(path)}"
    if not files:
        raise InputError(f"input {spec.name}: {missing}")
    return [item.absolute() for item in files]


def _meant(path: Path) -> str:
    with suppress(OSError):
        beside = [item.name for item in islice(path.parent.iterdir(), _MOST_BESIDE)]
        return did_you_mean(path.name, beside)
    return ""


def _below(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and its subfolders, except hidden files.

    Links to folders are not followed.
    """
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if name[0] != "."]
        yield from (Path(place, name) for name in names if name[0] != ".")


def check_no_step(
    steps: Sequence[DraftStep], factor: str, log: ProblemLog, location: Location
) -> None:
    """Report a step whose name is also a factor in addresses."""
    if any(step.name == factor for step in steps):
        what = {DATA: "the dataset", SEED: "the seed"}[factor]
        log.report(
            location,
            f"a step cannot be called {factor}, which denotes {what} in addresses; give the step "
            "another name",
            at_key=True,
        )


@dataclass(frozen=True, kw_only=True)
class _Origin:
    """Source of a list of datasets.

    Attributes:
        log: log of the file that contains the datasets.
        folder: base folder of relative paths.
        table: name of the table; empty for the workflow itself.
        is_given: whether the datasets were passed from Python; paths are then relative to the
            working directory.
    """

    log: ProblemLog
    folder: Path
    table: str = ""
    is_given: bool = False


@dataclass(frozen=True, kw_only=True)
class DatasetReader:
    """Reads datasets and checks them against a workflow.

    Attributes:
        folder: folder of the workflow.
        inputs: inputs of the workflow, including those from `--input`.
        steps: steps of the workflow.
        overrides: overrides from `--set`, which take precedence over settings of datasets.
        calls: (step, variant) -> method call without settings of datasets; only valid calls.
        log: log to which problems are added.
    """

    folder: Path
    inputs: Mapping[str, WorkflowInputSpec]
    steps: Sequence[DraftStep]
    overrides: Overrides
    calls: Mapping[tuple[str, str], StepVariant]
    log: ProblemLog

    def read(self, table: str | Mapping[str, JsonValue]) -> dict[str, Dataset]:
        """Read the datasets from a table or from the section `datasets`.

        Args:
            table: path given with `--datasets`, relative to the working directory; if empty, the
                section of the workflow is read, which may name a table. From Python, this may be
                the content of the section, with paths relative to the working directory.
        """
        if isinstance(table, Mapping):
            log = self.log.beside("datasets=", "")
            # Datasets that are passed from Python have no document.
            log.document = Document(value={_DATASETS: dict(table)}, places={(): _NOWHERE})
            log.unnamed = _DATASETS
            return self._named(_Origin(log=log, folder=Path.cwd(), is_given=True))
        if table:
            report = partial(self.log.report_option, f"--datasets {table}")
            return self._from_table(Path(table), table, report)
        section = self.log.get((_DATASETS,))
        if isinstance(section, str) and section:
            report = partial(self.log.report, (_DATASETS,))
            return self._from_table(self.folder / section, section, report)
        if isinstance(section, dict):
            return self._named(_Origin(log=self.log, folder=self.folder))
        if self.log.has((_DATASETS,)):
            form = "a CSV file, or a mapping from names to datasets, as in {hall: {scan: hall.e57}}"
            self.log.report((_DATASETS,), f"must be {form}, got {describe(section)}")
        return {}

    def _from_table(self, path: Path, name: str, report: Report) -> dict[str, Dataset]:
        try:
            text = read_text(path, "a table of datasets", MOST_TABLE_BYTES)
        except WorkflowError as error:
            missing = f"the datasets table {path} does not exist"
            report(str(error) if os.path.lexists(path) else missing)
            return {}
        log = self.log.beside(name, text)
        log.document, log.unnamed = read_rows(log), _DATASETS
        if not log.get((_DATASETS,)):
            if not log.has_any:
                report(f"the table {name} contains no datasets")
            return {}
        return self._named(_Origin(log=log, folder=path.resolve().parent, table=name))

    def _named(self, origin: _Origin) -> dict[str, Dataset]:
        log = origin.log
        check_no_step(self.steps, DATA, log, (_DATASETS,))
        written = log.get((_DATASETS,))
        assert isinstance(written, dict)  # noqa: S101 - by the callers
        if not written:
            log.report((_DATASETS,), "expected at least one dataset")
        # Report an unknown key once, without problems of its value.
        known = {"set", *self.inputs}
        data = dict(written)
        for name, items in written.items():
            if isinstance(items, dict):
                for key in items.keys() - known:
                    self._report_unknown(key, (_DATASETS, name, key), origin)
                data[name] = {key: value for key, value in items.items() if key in known}
        section = validate(DatasetsSection, {_DATASETS: data}, log)
        found = section.datasets if section else {}
        return {name: self._dataset(name, one, origin) for name, one in found.items()}

    def _dataset(self, name: str, section: DatasetSection, origin: _Origin) -> Dataset:
        log, here = origin.log, (_DATASETS, name)
        line = log.position(here, at_key=True).line
        specs = {
            key: WorkflowInputSpec(
                name=f"{key}@{name}",
                files=files,
                folder=origin.folder,
                is_given=origin.is_given,
                place=log.place((*here, key)),
                table=f"{origin.table}:{line}" if origin.table else "",
            )
            for key, files in (section.model_extra or {}).items()
        }
        for key, spec in self.inputs.items():
            if not log.has((*here, key)) and not spec.files and not spec.optional:
                log.report(
                    here,
                    f"neither the dataset nor the workflow names files for the input {key}; add "
                    f"{key} to the dataset",
                    at_key=True,
                )
        seeds: tuple[int, ...] = ()
        if SEED in section.set:
            own = validate(SeedSection, {SEED: section.set[SEED]}, log, (*here, "set"))
            seeds = own.seeds if own else ()
        settings = {key: value for key, value in section.set.items() if key != SEED}
        return Dataset(
            name=name,
            inputs=specs,
            sets=section.set,
            seeds=seeds,
            calls=self._calls(settings, (*here, "set"), origin),
        )

    def _report_unknown(self, key: str, location: Location, origin: _Origin) -> None:
        step, _, parameter = key.partition(".")
        meant = ""
        if key == SEED or (parameter and any(one.name == step for one in self.steps)):
            meant = f"; parameters belong in set: {{set: {{{key}: VALUE}}}}"
        elif origin.table:
            # In a table, the names of parameter columns contain a dot.
            meant = "; parameter columns are named step.parameter"
        origin.log.report(
            location,
            f"there is no input {key}{did_you_mean(key, self.inputs)}; inputs: "
            f"{', '.join(self.inputs) or 'none'}{meant}",
            at_key=True,
            # Report a problem with a table column once, and not for each row.
            shown=(key,) if origin.table else None,
        )

    def _calls(
        self, settings: Mapping[str, JsonValue], location: Location, origin: _Origin
    ) -> dict[tuple[str, str], StepVariant]:
        assigned = overrides_of_settings(
            settings, location, self.steps, origin.log, is_column=bool(origin.table)
        )
        shown = location[:-1] if origin.table else None
        blame = partial(origin.log.report, location, shown=shown)
        calls = {}
        for step in self.steps:
            for draft in step.calls:
                name = (step.name, draft.name)
                if name not in assigned:
                    continue
                call = self.calls.get(name)
                overrides = (*assigned[name], *self.overrides.get(name, ()))
                # If the call is invalid without the dataset, its mistakes are reported at their own
                # positions.
                resolved = resolve_call(draft, overrides, self.log, blame if call else None)
                if call is not None:
                    calls[name] = resolved
        return calls


def choose_data(
    texts: Sequence[str], datasets: Mapping[str, Dataset], log: ProblemLog
) -> tuple[str, ...]:
    """Parse the values of `--only-data`: dataset names, separated by commas."""
    chosen: dict[str, None] = {}
    for text in texts:
        for name in (part.strip() for part in text.split(",")):
            if name in datasets:
                chosen[name] = None
            elif not datasets and log.has_any:
                # The names of the datasets are unknown if the table could not be read.
                continue
            elif not datasets:
                log.report_option(f"--only-data {text}", "the workflow has no datasets")
            else:
                log.report_option(
                    f"--only-data {text}",
                    f"there is no dataset {name or '(empty name)'}{did_you_mean(name, datasets)}; "
                    f"datasets: {some_of(datasets)}",
                )
    return tuple(chosen)


def read_rows(log: ProblemLog) -> Document:
    """Convert a table to a document with the section `datasets`.

    Columns are separated by semicolons, tabs or commas. If the name of a column contains a dot or
    is `seed`, its fields are read as YAML and become entries of `set` of the datasets. Empty fields
    are omitted. The position of a key is that of the column in the header, so that a problem with a
    column is reported once.
    """
    rows = _rows(log)
    header = next(rows, None)
    start = Position(line=1, column=1)
    if header is None:
        log.add(
            start, "", "the table is empty; a datasets table begins with a line of column names"
        )
    columns = _columns(header, log) if header else []
    datasets: dict[str, JsonValue] = {}
    places: dict[Location, Position] = {(): start, (_DATASETS,): start}
    keys: dict[Location, Position] = {}
    for row in rows if columns else ():
        name = _row_name(row, columns, log)
        if name is None:
            continue
        here = (_DATASETS, name.text)
        if here in keys:
            log.add(
                name.position,
                "name",
                f"the dataset {name.text} already exists in line {keys[here].line}; give it "
                "another name",
            )
            continue
        if len(datasets) == MOST_DATASETS:
            log.add(name.position, "", f"a table has at most {MOST_DATASETS} datasets")
            break
        keys[here], places[here] = name.position, row[0].position
        dataset: dict[str, JsonValue] = {}
        settings: dict[str, JsonValue] = {}
        for column, field in zip(columns, row, strict=False):
            key = column.text
            if not field.text or key == "name":
                continue
            is_set = "." in key or key == SEED
            values = _as_yaml(field, key, log) if is_set else [field.text]
            for value in values:
                at = (*here, "set", key) if is_set else (*here, key)
                keys[at], places[at] = column.position, field.position
                (settings if is_set else dataset)[key] = value
        if settings:
            dataset["set"], places[(*here, "set")] = settings, row[0].position
        datasets[name.text] = dataset
    return Document(value={_DATASETS: datasets}, places=places, keys=keys)


class _Field(NamedTuple):
    text: str
    position: Position


def _rows(log: ProblemLog) -> Iterator[list[_Field]]:
    separator = ""
    for number, line in enumerate(log.lines, start=1):
        if not line.strip() or line.lstrip()[0] == "#":
            continue
        separator = separator or next((mark for mark in _SEPARATORS if mark in line), ",")
        try:
            fields = next(csv.reader([line], delimiter=separator, strict=True))
        except (csv.Error, StopIteration) as error:
            message = f"the line cannot be read as CSV: {error}"
            log.add(Position(line=number, column=1), "", message)
            continue
        placed, at = [], 0
        for field in fields:
            # A field with doubled quotes cannot be found literally, so its position is approximate.
            at = max(at, line.find(field, at))
            placed.append(_Field(field.strip(), Position(line=number, column=at + 1)))
            at += len(field)
        yield placed


def _columns(header: Sequence[_Field], log: ProblemLog) -> list[_Field]:
    """Return the columns of a table, including unnamed columns.

    The result is empty if the table has no column `name`.
    """
    names = [field.text for field in header]
    for index, (name, position) in enumerate(header):
        if name and name in names[:index]:
            message = f"the column {name} occurs twice; remove one of them"
            log.add(position, name, message)
    if "name" in names:
        return list(header)
    is_mapping = any(": " in name or name.endswith(":") for name in names)
    way_out = (
        ("; write the datasets as a mapping in the workflow instead, under datasets:")
        if is_mapping
        else ""
    )
    listed = first_few([name for name in names if name]) or "none"
    message = f"a table of datasets needs a column called `name`; its columns are {listed}{way_out}"
    log.add(header[0].position, "", message)
    return []


def _row_name(row: Sequence[_Field], columns: Sequence[_Field], log: ProblemLog) -> _Field | None:
    names = [column.text for column in columns]
    for index, field in enumerate(row):
        if field.text and not "".join(names[index : index + 1]):
            text = f"{field.text} is in column {index + 1}, which has no name in the header"
            log.add(field.position, "", text)
            return None
    found = [field for key, field in zip(names, row, strict=False) if key == "name" and field.text]
    if not found and any(field.text for field in row):
        log.add(
            row[0].position, "name", "the column `name` is empty, but each dataset needs a name"
        )
    return found[-1] if found else None


def _as_yaml(field: _Field, key: str, log: ProblemLog) -> list[JsonValue]:
    """Return a list with the value in a parameter column; empty if it is not valid YAML."""
    if _NUMBER.fullmatch(field.text):
        # Read numbers directly, because reading a value as YAML takes milliseconds, and tables may
        # be long.
        return [float(field.text) if "." in field.text else int(field.text)]
    own = ProblemLog(file="")
    if own.parse(field.text) is None or own.has_any:
        log.add(field.position, key, "the value cannot be read as YAML; quote it")
        return []
    return [own.get(())]
