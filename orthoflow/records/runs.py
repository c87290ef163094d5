"""A run as a Python object: cells, metrics, products, files and datasets."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import math
import os
import re
import shlex
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, Literal, TypeAlias

from orthoflow_provenance.arrays import StoredPayload
from orthoflow_provenance.document import (
    FIGURE_SUFFIXES,
    Metric,
    PublishedFile,
    RecordedCell,
    RecordedFigure,
    RecordFormatError,
    RunRecord,
    UnsafeFileError,
    cost_metrics,
    shared_fields,
)
from orthoflow_provenance.paths import (
    colliding,
    create_below,
    files_below,
    name_problem,
    open_below,
    path_below,
    path_problem,
)
from orthoflow_provenance.record import open_record

from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.engine.durability import writing_to
from orthoflow.engine.file_digests import file_sha256
from orthoflow.engine.journal import RECORD_FILE, cell_file_name, is_running
from orthoflow.errors import (
    ArgumentError,
    OrthoflowError,
    PluginError,
    RecordError,
    StoreError,
    did_you_mean,
)
from orthoflow.geometry.threads import in_order
from orthoflow.products.product import JsonValue, Payload, Product
from orthoflow.sdk.lines import one_line
from orthoflow.untrusted_text import csv_text, first_few, parse_json, shown
from orthoflow.workflow.model import (
    DATA,
)

if TYPE_CHECKING:
    pass

# The last digits depend on libraries; this is also the tolerance of floats in product metadata
# (SPEC 11.3).
_ROUNDING: Final = 1e-6
_UNITLESS: Final = ("1", "yes/no")
_COLUMNS: Final = ("cell", "step", "method", "metric", "value", "unit")


@dataclass(frozen=True, kw_only=True)
class MetricRow(Metric):
    """A metric of one cell.

    Attributes:
        cell: address of the cell.
        step: step of the cell.
        method: id of the method.
    """

    cell: str
    step: str
    method: str

    @property
    def metric(self) -> str:
        """Name of the metric, as in the columns of tables."""
        return self.name

    @property
    def title(self) -> str:
        """Label of the metric, or its name if the method declares no label."""
        return self.label or self.metric

    @property
    def titled(self) -> str:
        """Title with the unit; counts, shares and yes/no metrics have no unit."""
        return self.title if self.unit in _UNITLESS else f"{self.title} / {self.unit}"


def cell_metrics(cell: RecordedCell) -> tuple[MetricRow, ...]:
    """Return the metrics reported by the method, then those measured by the engine (time, memory).

    Cells without a result have no rows, because their costs are not comparable.
    """
    if cell.status != "ok":
        return ()
    return tuple(
        MetricRow(cell=cell.address, step=cell.step, method=cell.method, **vars(metric))
        for metric in (*cell.metrics, *cost_metrics(cell))
    )


def is_rounding(left: float, right: float) -> bool:
    """Whether two values of a metric are equal or differ only by rounding.

    The limit is a millionth of the larger value, or 1e-6 for values below 1; counts are never
    rounded.

    >>> is_rounding(0.84536087, 0.84536104), is_rounding(1.0, 1.00001), is_rounding(3e7, 3e7 + 1)
    (True, False, False)
    """
    is_counted = all(float(value).is_integer() for value in (left, right))
    return left == right or (
        not is_counted and math.isclose(left, right, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
    )


def write_metrics_csv(path: Path, rows: Iterable[MetricRow]) -> None:
    """Write rows of metrics with a header, in full precision."""
    text = csv_text([_COLUMNS, *([getattr(row, name) for name in _COLUMNS] for row in rows)])
    path.write_text(text, encoding="utf-8", newline="")


PRODUCTS_FOLDER: Final = "products"
METRICS_FILE: Final = "metrics.csv"


def upstream_cells(cells: Mapping[str, RecordedCell], address: str) -> Iterator[RecordedCell]:
    """Yield a cell and all cells upstream of it, nearest first."""
    waiting, seen = [address], {address}
    for name in waiting:
        # The list grows while the loop runs.
        yield cells[name]
        for given in cells[name].inputs.values():
            before = given.source.rpartition(".")[0]
            if before in cells and before not in seen:
                seen.add(before)
                waiting.append(before)


def published_files(run_folder: Path, address: str) -> tuple[Path, ...]:
    """Return the published files of a cell, in natural order (wall 2 before wall 10).

    Links are omitted, whatever their target.
    """
    inside = f"{PRODUCTS_FOLDER}/{cell_file_name(address)}"
    names = sorted(files_below(run_folder, inside), key=_by_number)
    return tuple(path_below(run_folder, f"{inside}/{name}") for name in names)


def _by_number(name: str) -> tuple[tuple[str, int], ...]:
    """Return a sort key that compares numbers in a name by value."""
    return tuple((text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", name))


PublishedState: TypeAlias = Literal["same", "changed", "missing", "no file"]


def published_state(folder: Path, file: PublishedFile) -> PublishedState:
    """Compare a published file with its entry in the record; do not follow links or open devices.

    Args:
        folder: run folder.
        file: the entry.
    """
    try:
        with open_below(folder, file.path) as stream:
            # Compare the sizes first, so that a huge sparse file is not read.
            if os.fstat(stream.fileno()).st_size != file.size_bytes:
                return "changed"
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
    except (FileNotFoundError, NotADirectoryError):
        return "missing"
    except (UnsafeFileError, OSError):
        return "no file"
    return "same" if digest == file.sha256 else "changed"


def described_file(folder: Path, path: str) -> PublishedFile:
    """Return the entry of a file that the caller has just written into a folder."""
    file = path_inside(folder, path)
    return PublishedFile(path=path, size_bytes=file.stat().st_size, sha256=file_sha256(file))


def require_unchanged(run: Run, *paths: Path) -> None:
    """Raise an error if one of the published files was changed.

    Args:
        run: the run.
        paths: published files in the folder of the run.

    Raises:
        RecordError: a file was changed, is a link or a device, or is not in the record.
    """
    known = {file.path: file for file in run.record.published}
    for path in paths:
        expected = known.get(path.relative_to(run.folder).as_posix())
        if expected is None:
            raise RecordError(
                f"{path} is not listed in the record of the run, so it cannot be checked"
            )
        _require_same(run.folder, expected, published_state(run.folder, expected))


def _require_same(folder: Path, file: PublishedFile, state: PublishedState) -> None:
    if state == "changed":
        raise RecordError(
            f"{folder / file.path} has been changed since the run: its digest in the record is "
            f"{file.sha256}"
        )
    if state != "same":
        raise RecordError(f"{folder / file.path} cannot be read: {state}")


REPORT_FILE: Final = "report.html"
METADATA_FILE: Final = "ro-crate-metadata.json"
WORKFLOW_FILE: Final = "workflow.yaml"
RESOLVED_FILE: Final = "workflow-resolved.json"
#: bytes of a report page, or of a file that it refers to
LARGEST_PAGE_BYTES: Final = 1 << 30
_DAMAGED: Final = "the file is damaged"
_AWAY: Final = "; use another copy, and check it with `orthoflow verify`"
FIGURES_FOLDER: Final = "figures"
GRAPH_FILE: Final = "graph.svg"
# A run on several datasets has one page per dataset in this folder.
PAGES_FOLDER: Final = "pages"
_MOST_NAMED: Final = 12
_LONGEST_REASON: Final = 400


@dataclass(frozen=True, kw_only=True, repr=False)
class Run:
    """A run with its record.

    Attributes:
        path: the record file.
        record: everything in the record except the arrays of products.
        output: function that reads the output with a given address and port from the open record;
            if None, the record is opened for each output.
        files_folder: folder of the run's files, if it is not the folder of the record.
        home: run folder of an unfinished run, whose record is in another folder.
        content_sha256: digest that seals the record; empty if it was not read from a file.
    """

    path: Path
    record: RunRecord
    output: Callable[[str, str], StoredPayload] | None = field(default=None, compare=False)
    files_folder: Path | None = field(default=None, compare=False)
    home: Path | None = field(default=None, compare=False)
    content_sha256: str = field(default="", compare=False)

    @property
    def file_name(self) -> str:
        """Final name of the record file, which has a temporary name while the run is written."""
        return RECORD_FILE if self.path.name.startswith(f".{RECORD_FILE}") else self.path.name

    @contextmanager
    def held_open(self) -> Iterator[Run]:
        """Yield the run with its record open, for repeated reading.

        Opening a record checks its seal, which would be too slow if repeated for many datasets.

        Raises:
            RecordError: the record is damaged or missing.
        """
        if self.output is not None:
            yield self
            return
        with ExitStack() as stack:
            with record_errors(self.path):
                opened = stack.enter_context(open_record(self.path))
            yield replace(self, output=opened.payload, content_sha256=opened.content_sha256)

    @property
    def folder(self) -> Path:
        """Folder that contains `products/` and the report, and usually the record."""
        return self.files_folder or self.path.parent

    @property
    def is_finished(self) -> bool:
        """Whether the run has its own record, not one with the results so far."""
        return self.home is None

    @property
    def home_folder(self) -> Path:
        """Folder for files derived from the run."""
        return self.home or self.folder

    @cached_property
    def cells(self) -> Mapping[str, RecordedCell]:
        """Cells by address, in the order of the graph."""
        return {cell.address: cell for cell in self.record.cells}

    def cell(self, address: str, *, repeat: int = 0, **variants: str) -> RecordedCell:
        """Return one cell of the run.

        Args:
            address: address of the cell; with `variants`, the name of the step suffices.
            repeat: number of the repeat, from 0.
            variants: name of a step with variants -> name of the variant, and `data` -> name of the
                dataset. For a sweep, the part of the name before the parameters suffices if only
                one variant matches. Entries that do not apply to the cell are ignored.

        Raises:
            ArgumentError: the run has no such cell, or several cells match.
        """
        if address in self.cells and not variants and not repeat:
            return self.cells[address]
        every = self.record.cells
        own = [cell for cell in every if address in (cell.step, cell.address)]
        names: dict[str, dict[str, None]] = {}
        for step, name in (pair for cell in every for pair in cell.assignment.items()):
            names.setdefault(step, {})[name] = None

        def is_wanted(step: str, name: str) -> bool:
            wanted = variants[step]
            return name == wanted or (wanted not in names[step] and name.startswith(f"{wanted}-"))

        unknown = {
            step
            for step, wanted in variants.items()
            if not any(is_wanted(step, name) for name in names.get(step, ()))
        }
        found = [
            cell
            for cell in own
            if all(is_wanted(*pair) for pair in cell.assignment.items() if pair[0] in variants)
            if cell.address == address or cell.repeat == repeat
        ]
        if len(found) == 1 and not unknown:
            return found[0]
        asked = ", ".join([repr(address), *(f"{step}={name}" for step, name in variants.items())])
        if own and (found or unknown):
            factors = [step for step in names if step in unknown] or [*names]
            left = own if unknown else found
            values = {step: {cell.assignment.get(step, "") for cell in left} for step in factors}
            choices = [
                f"{step}= ({first_few(sorted(filter(None, of_step)), most=_MOST_NAMED)})"
                for step, of_step in values.items()
                if len(of_step) > 1
            ]
            count = "no" if unknown else len(found)
            raise ArgumentError(
                f"the run {self.record.run_id} has {count} cells of {asked}: choose "
                f"{', '.join(choices)}"
            )
        known = [cell.address for cell in own] or dict.fromkeys(cell.step for cell in every)
        raise ArgumentError(
            f"the run {self.record.run_id} has no step {asked}"
            f"{'' if own else did_you_mean(address, [*known])}; it has "
            f"{first_few([*known], most=_MOST_NAMED)}"
        )

    def upstream(self, address: str) -> Iterator[RecordedCell]:
        """Yield a cell and all cells upstream of it, nearest first."""
        return upstream_cells(self.cells, address)

    def __repr__(self) -> str:
        counts = Counter(cell.status for cell in self.record.cells)
        statuses = ", ".join(f"{count} {status}" for status, count in counts.items())
        sentence = self.with_failure(
            f"{self.record.name} in {self.folder}: {statuses or 'no steps'}"
        )
        return shown(f"<Run {sentence}>")

    def with_failure(self, sentence: str) -> str:
        """Append the first failed cell and its error, if any, to a sentence about the run."""
        failed = [cell for cell in self.record.cells if cell.status == "failed"]
        if not failed:
            return sentence
        more = f" ({len(failed) - 1} more failed)" if len(failed) > 1 else ""
        why = one_line(failed[0].error_message, _LONGEST_REASON)
        return f"{sentence}; {failed[0].address} failed{more}: {why}"

    def metric_rows(self) -> tuple[MetricRow, ...]:
        """Return all metrics of all cells, including those measured by the engine."""
        return tuple(row for cell in self.record.cells for row in cell_metrics(cell))

    def figure(self, address: str, name: str) -> RecordedFigure:
        """Return a figure of a cell.

        Raises:
            ArgumentError: the run has no such cell, or the cell has no such figure.
        """
        figures = {figure.name: figure for figure in self.cell(address).figures}
        if name not in figures:
            raise ArgumentError(
                f"the step {address} has no figure {name!r}; it has {', '.join(figures) or 'none'}"
            )
        return figures[name]

    def payload(self, address: str, port: str) -> Payload:
        """Return an output as named arrays and JSON metadata; no plugin is needed.

        Raises:
            ArgumentError: the run has no such cell, or the cell has no such output.
            RecordError: the record contains only the digest of the output, or is damaged.
        """
        return next(self.payloads([(address, port)]))

    def payloads(self, places: Sequence[tuple[str, str]]) -> Iterator[Payload]:
        """Yield the outputs at the given addresses and ports; the record is opened only once.

        Raises:
            ArgumentError: the run has no such cell, or the cell has no such output.
            RecordError: the record contains only the digest of an output, is damaged, or contains
                an output that does not match its digest.
        """
        for address, port in places:
            self._check_embedded(address, port)
        if not places:
            return
        if self.output is None:
            with self.held_open() as run:
                yield from run.payloads(places)
            return
        with record_errors(self.path):
            for address, port in places:
                yield Payload(**shared_fields(self.output(address, port), Payload))

    def _check_embedded(self, address: str, port: str) -> None:
        cell = self.cell(address)
        outputs = cell.outputs
        if not outputs and cell.error_message:
            how = "failed" if cell.status == "failed" else "was skipped"
            raise ArgumentError(
                f"the step {address} has no {port!r}, because it {how}: {cell.error_message}"
            )
        if port not in outputs:
            raise ArgumentError(
                f"the step {address} has no output {port!r}; it has {', '.join(outputs) or 'none'}"
            )
        if not outputs[port].embedded:
            raise RecordError(
                f"{self.path} contains only the digest of {address}.{port}; to embed all products, "
                f"run `orthoflow export {shlex.quote(str(self.path))} --embed`, with "
                "`--store FOLDER` if the store of the run is not in this folder"
            )

    def product(self, address: str, port: str, *, repeat: int = 0, **variants: str) -> Product:
        """Return an output as an object of its product class.

        Args:
            address: address of the cell; with `variants`, the name of the step suffices.
            port: name of the output.
            repeat: see `cell`.
            variants: see `cell`.

        Raises:
            ArgumentError: the run has no such cell, or the cell has no such output.
            RecordError: the record contains only the digest of the output, or is damaged.
            PluginError: no installed plugin provides the product type.
        """
        from orthoflow.catalog.discovery import discover_catalog  # noqa: PLC0415 - only products need it

        address = self.cell(address, repeat=repeat, **variants).address
        payload = self.payload(address, port)
        try:
            cls = discover_catalog().product_class(payload.type_name)
        except PluginError as error:
            raise PluginError(
                f"{error}; payload({address!r}, {port!r}) gives its arrays without the plugin"
            ) from error
        return cls.from_payload(payload)

    @property
    def files(self) -> Mapping[str, tuple[Path, ...]]:
        """Address of a cell -> published files of the cell; cells without files are omitted."""
        found = {address: published_files(self.folder, address) for address in self.cells}
        return {address: files for address, files in found.items() if files}

    @property
    def orthoimages(self) -> tuple[Path, ...]:
        """Return the orthoimages among the published files, in the order of the graph."""
        return tuple(
            file
            for files in self.files.values()
            for file in files
            if file.name.endswith("_ortho.tif")
        )

    @property
    def products_folder(self) -> Path:
        """Folder of the published files."""
        return self.folder / PRODUCTS_FOLDER


def read_run(path: Path) -> Run:
    """Read a record file, which may have any name.

    Raises:
        RecordError: the record is damaged, not a record, or of another format.
    """
    with record_errors(path), open_record(path) as opened:
        return Run(path=path, record=opened.record, content_sha256=opened.content_sha256)


def find_record(path: str | Path) -> Path:
    """Return the record file in a run folder; if the path is a file, return it unchanged.

    Raises:
        ArgumentError: the path does not exist, or the folder contains no finished run.
    """
    given = Path(path)
    if given.is_dir():
        inside = given / RECORD_FILE
        if inside.is_file():
            return inside
        state = "is unfinished; repeat the run with -o {} to finish it"
        if is_running(given):
            state = "has not ended yet; wait until it ends"
        raise ArgumentError(
            f"{given} contains no {RECORD_FILE}: it is not a run folder, or its run "
            f"{state.format(given)}"
        )
    if not given.is_file():
        what = "is a device or a pipe" if given.exists() else "does not exist"
        raise ArgumentError(f"{given} {what}; give a run folder or its {RECORD_FILE}")
    return given


@contextmanager
def record_errors(path: Path) -> Iterator[None]:
    """Convert any error that the block raises while reading a record into a one-sentence error.

    Raises:
        RecordError: the block raised an error that is neither an error of orthoflow nor a missing
            permission.
    """
    try:
        yield
    except OrthoflowError:
        raise
    except RecordFormatError as error:
        text = str(error)
        rest = text.removeprefix(path.name) if text.startswith(path.name) else f": {text}"
        raise RecordError(f"{path}{rest}{_AWAY if _DAMAGED in text else ''}") from error
    except PermissionError as error:
        raise ArgumentError(f"{path} cannot be read: permission denied") from error
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        # If a file is damaged, h5py raises different errors depending on the damaged structure.
        if isinstance(error, OSError) and error.errno in (errno.ENOENT, errno.EISDIR):
            raise ArgumentError(f"{path} is not a file; give a run folder or its run.h5") from error
        raise RecordError(f"{path} is not a record or is damaged: {error}{_AWAY}") from error


def path_inside(folder: Path, name: str) -> Path:
    """Return the path of a file in a folder; the file name comes from a record.

    Raises:
        RecordError: the name is not allowed as a file name.
    """
    try:
        return path_below(folder, name)
    except UnsafeFileError as error:
        raise RecordError(f"cannot write to {folder}: {error}") from error


def environment_file(environment_id: str) -> str:
    """Return the name of the file in a crate that lists the packages of an environment."""
    return f"requirements-{environment_id.removeprefix('sha256:')[:12]}.txt"


def encoded(text: str) -> bytes:
    """Encode text from a record as UTF-8; unpaired surrogates become backslash escapes."""
    return text.encode("utf-8", "backslashreplace")


def crate_texts(record: RunRecord) -> dict[str, bytes]:
    """Return path -> content for the files of a crate that repeat text from the record."""
    lists = {
        environment_file(environment.id): "".join(
            f"{name}=={version}\n" for name, version in environment.packages.items()
        )
        for environment in record.environments
    }
    texts = {WORKFLOW_FILE: record.workflow_source, RESOLVED_FILE: record.workflow_resolved}
    return {name: encoded(text) for name, text in (texts | lists).items()}


def figure_files(run: Run, addresses: Iterable[str]) -> Mapping[str, RecordedFigure]:
    """Return relative path -> figure for the figures of cells.

    Raises:
        RecordError: the name of a cell or figure is not allowed as a file name, or the type of a
            figure has no suffix.
    """
    named: list[tuple[str, RecordedFigure]] = []
    problem = ""
    for address in addresses:
        for figure in run.cells[address].figures:
            path = f"{cell_file_name(address)}/{figure.name}{_suffix(run, figure)}"
            named.append((path, figure))
            if sentence := name_problem(figure.name) or path_problem(path):
                problem = problem or f"the figure {figure.name!r} of {address} {sentence}"
    if twice := colliding(path for path, _ in named):
        same = "on file systems that ignore case, two figures have the same name"
        problem = problem or f"{same}, {twice!r}"
    if problem:
        raise RecordError(f"{run.path}: {problem}, so the figures cannot be written to files")
    return dict(named)


def write_files(folder: Path, contents: Mapping[str, Callable[[], bytes | None]]) -> int:
    """Write files into a folder, replacing existing files; do not follow links.

    Args:
        folder: the folder, created if missing.
        contents: relative path -> function that returns the content, or None if no file is to be
            written; it is called in a thread.

    Returns:
        The number of files written.

    Raises:
        StoreError: the disk cannot be written to, or a path contains a link.
    """
    with writing_to(folder):
        folder.mkdir(parents=True, exist_ok=True)

    def write(item: tuple[str, Callable[[], bytes | None]]) -> bool:
        path, content = item
        data = content()
        if data is None:
            return False
        with creating(folder, path) as stream:
            stream.write(data)
        return True

    return sum(in_order(write, contents.items()))


def copy_files(
    source: Path, target: Path, paths: Iterable[str], published: Iterable[PublishedFile]
) -> tuple[str, ...]:
    """Copy regular files from one folder to another.

    Args:
        source: source folder.
        target: existing folder.
        paths: paths relative to both folders.
        published: entries of the published files in the record, with which the files are compared.

    Returns:
        The paths of the files that exist and were copied.

    Raises:
        RecordError: a file is a link or a device, or differs from the record.
        StoreError: the disk cannot be written to.
    """
    copied: list[str] = []
    known = {file.path: file for file in published}
    for path in paths:
        if path in known:
            # Hash each file only once, because published files can be very large.
            state = published_state(source, known[path])
            if state == "missing":
                continue
            _require_same(source, known[path], state)
        try:
            with open_below(source, path) as stream:
                n_bytes = os.fstat(stream.fileno()).st_size
                if path not in known and n_bytes > LARGEST_PAGE_BYTES:
                    raise RecordError(f"{source / path} is too large for a report: {n_bytes} bytes")
                with creating(target, path) as copy:
                    shutil.copyfileobj(stream, copy, 1 << 20)
        except (FileNotFoundError, NotADirectoryError):
            continue
        except UnsafeFileError as error:
            raise RecordError(f"{source}: {error}: only files of the run are copied") from error
        copied.append(path)
    return tuple(copied)


@contextmanager
def creating(folder: Path, path: str) -> Iterator[BinaryIO]:
    """Yield a stream for a new file in a folder; the file gets its final name at the end.

    Raises:
        StoreError: the disk cannot be written to, or the path contains a link.
    """
    try:
        with writing_to(folder), create_below(folder, path) as stream:
            yield stream
    except UnsafeFileError as error:
        raise StoreError(f"cannot write to {folder}: {error}") from error


def _suffix(run: Run, figure: RecordedFigure) -> str:
    # WebP figures are written as PNG, which can be used in papers and word processors.
    shown = "image/png" if figure.media_type == "image/webp" else figure.media_type
    if shown not in FIGURE_SUFFIXES:
        raise RecordError(
            f"{run.path}: the figure {figure.name!r} must be {', '.join(FIGURE_SUFFIXES)}, got "
            f"{shown!r}"
        )
    return FIGURE_SUFFIXES[shown]


_DATASETS = "datasets"


def datasets_of(run: Run) -> tuple[str, ...]:
    """Return the datasets that have cells in a run; empty if the workflow has no datasets.

    Invalid names are omitted, because folders and pages are named after datasets.
    """
    if not _resolved(run).get(_DATASETS):
        return ()
    named = (cell.assignment[DATA] for cell in run.record.cells if DATA in cell.assignment)
    return tuple(name for name in dict.fromkeys(named) if re.fullmatch(NAME_PATTERN, name))


def parts_of(run: Run) -> dict[str, Run]:
    """Return dataset -> its part of the run, as a run of its own with the same record file."""
    cells: dict[str, list[RecordedCell]] = {name: [] for name in datasets_of(run)}
    for cell in run.record.cells:
        for name in [cell.assignment[DATA]] if DATA in cell.assignment else cells:
            if name in cells:
                cells[name].append(cell)
    published: dict[str, list[PublishedFile]] = {}
    for file in run.record.published:
        published.setdefault(file.path.rpartition("/")[0], []).append(file)
    document = _resolved(run)
    return {
        name: dataclasses.replace(
            run, record=_record_of(run.record, document, name, tuple(own), published)
        )
        for name, own in cells.items()
    }


def _record_of(
    record: RunRecord,
    document: Mapping[str, JsonValue],
    name: str,
    cells: tuple[RecordedCell, ...],
    published: Mapping[str, Sequence[PublishedFile]],
) -> RunRecord:
    taken = {product.source for cell in cells for product in cell.inputs.values()}
    environments = {cell.environment for cell in cells}
    return dataclasses.replace(
        record,
        status="failed" if any(cell.status == "failed" for cell in cells) else "ok",
        workflow_resolved=_resolved_of(document, name),
        inputs=tuple(
            entry
            for entry in record.inputs
            if f"inputs.{entry.name}" in taken or entry.name.partition("@")[2] in ("", name)
        ),
        environments=tuple(item for item in record.environments if item.id in environments),
        cells=cells,
        published=tuple(
            file
            for cell in cells
            for file in published.get(f"{PRODUCTS_FOLDER}/{cell_file_name(cell.address)}", ())
        ),
    )


def pages_of(run: Run) -> dict[str, str]:
    """Return dataset -> path of its page in the run folder; empty for fewer than two datasets."""
    names = datasets_of(run)
    return {name: f"{PAGES_FOLDER}/{name}.html" for name in names} if len(names) > 1 else {}


def _resolved(run: Run) -> Mapping[str, JsonValue]:
    try:
        document = parse_json(run.record.workflow_resolved)
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}


def _resolved_of(document: Mapping[str, JsonValue], name: str) -> str:
    datasets = document[_DATASETS]
    own = {name: datasets.get(name)} if isinstance(datasets, dict) else datasets
    return json.dumps(
        {**document, _DATASETS: own},
        sort_keys=True,
        separators=(",", ":"),
        ensure_ascii=False,
        allow_nan=False,
    )
