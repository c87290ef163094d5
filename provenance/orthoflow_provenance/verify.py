"""Checking a record against itself: the seal, every digest, every required field."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import h5py

from orthoflow_provenance import layout
from orthoflow_provenance.digests import ArrayFingerprint, digest_of_parts, sha256_text
from orthoflow_provenance.encoding import (
    HDF5_ERRORS,
    parse_json,
    read_json,
    read_text,
    storable_text,
    text_attribute,
)
from orthoflow_provenance.errors import ForeignFormatError, RecordFormatError
from orthoflow_provenance.inner_files import colliding, name_problem, path_problem
from orthoflow_provenance.input_files import content_name
from orthoflow_provenance.model import (
    FIGURE_SUFFIXES,
    RUN_FORMAT,
    RUN_FORMAT_VERSION,
    RecordedCell,
    RecordedInput,
    RecordedProduct,
    RunRecord,
    cost_metrics,
)
from orthoflow_provenance.payloads import array_datasets, open_group
from orthoflow_provenance.reader import record_of
from orthoflow_provenance.safe import check_format, safe_open
from orthoflow_provenance.seal import (
    SEAL_ATTRIBUTE,
    SEAL_DATASET,
    ContentDigests,
    digest_contents,
    read_seal,
)

_LETTERS_MOST: Final = 60
_HEX_DIGITS: Final = frozenset("0123456789abcdef")


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something in a record that is not as it should be.

    Attributes:
        place: path in the file, with `@` before the name of an attribute.
        problem: one sentence.
        is_foreign: the file is of another program or a later version, so nothing was checked.
    """

    place: str
    problem: str
    is_foreign: bool = False


def verify_record(path: Path) -> tuple[Finding, ...]:
    """Check a record; never raises, whatever the file is.

    Returns:
        What was found, in the order of the checks; empty when the record is whole and unchanged.
    """
    try:
        with safe_open(path) as file:
            return tuple(_findings(file))
    except RecordFormatError as error:
        is_foreign = isinstance(error, ForeignFormatError)
        return (Finding(place="/", problem=str(error), is_foreign=is_foreign),)
    except HDF5_ERRORS as error:
        problem = f"{path.name} cannot be read: {error}"
        return (Finding(place="/", problem=problem),)


def verify_seal(path: Path, *, largest_bytes: float) -> tuple[Finding, ...]:
    """Check the seal of a record alone, at the cost of reading its smaller parts.

    Args:
        path: the record.
        largest_bytes: larger datasets are not looked at.

    Raises:
        RecordFormatError: it is no record, or unsafe to open.
    """
    with safe_open(path) as file:
        contents = digest_contents(file, largest_bytes=largest_bytes)
        unreadable = (
            Finding(place=place, problem=problem) for place, problem in contents.unreadable.items()
        )
        return (*unreadable, *_seal_findings(file, contents))


def _findings(file: h5py.File) -> Iterator[Finding]:
    check_format(file, RUN_FORMAT, RUN_FORMAT_VERSION)
    contents = digest_contents(file)
    for place, problem in contents.unreadable.items():
        yield Finding(place=place, problem=problem)
    yield from _seal_findings(file, contents)
    try:
        record = record_of(file)
    except RecordFormatError as error:
        yield Finding(place="/", problem=str(error))
        return
    yield from _workflow_findings(file, record)
    yield from _run_findings(record)
    for entry in record.inputs:
        yield from _input_findings(entry, contents)
    yield from _published_findings(record)
    environments = {entry.id for entry in record.environments}
    outputs = {
        f"{cell.address}.{port}": product.digest
        for cell in record.cells
        for port, product in cell.outputs.items()
    }
    yield from _name_findings(record)
    for cell in record.cells:
        yield from _cell_findings(cell, environments)
        yield from _reference_findings(cell, outputs)
        yield from _product_findings(file, cell, contents)


def _seal_findings(file: h5py.File, contents: ContentDigests) -> Iterator[Finding]:
    try:
        sealed = read_seal(file)
        text = read_text(file, SEAL_DATASET)
        content_sha256 = text_attribute(file, SEAL_ATTRIBUTE)
    except RecordFormatError as error:
        yield Finding(place=f"/{SEAL_DATASET}", problem=f"the seal is broken: {error}")
        return
    if sha256_text(text) != content_sha256:
        yield Finding(
            place=f"/@{SEAL_ATTRIBUTE}",
            problem=f"the content digest is {content_sha256}, the seal's is {sha256_text(text)}",
        )
    for place in sorted(sealed.keys() | contents.objects.keys()):
        if place in contents.unreadable or place in contents.left_out:
            continue
        if place not in contents.objects:
            yield Finding(place=place, problem="sealed, but not in the file any more")
        elif place not in sealed:
            yield Finding(place=place, problem="in the file, but not sealed")
        elif sealed[place] != contents.objects[place]:
            yield Finding(place=place, problem="changed after the record was sealed")


def _workflow_findings(file: h5py.File, record: RunRecord) -> Iterator[Finding]:
    stated = text_attribute(file, "workflow_sha256")
    actual = sha256_text(storable_text(record.workflow_source))
    if stated != actual:
        yield Finding(
            place="/workflow/source",
            problem=f"the workflow's text has the SHA-256 {actual}, the record says {stated}",
        )
    try:
        parse_json(record.workflow_resolved, "/workflow/resolved")
    except RecordFormatError as error:
        yield Finding(place="/workflow/resolved", problem=str(error))


def _run_findings(record: RunRecord) -> Iterator[Finding]:
    for name in ("run_id", "name", "created_by", "started", "ended", "workflow_source"):
        if not getattr(record, name):
            yield Finding(place="/", problem=f"{name} must not be empty")
    has_failed = any(cell.status == "failed" for cell in record.cells)
    if has_failed != (record.status == "failed"):
        yield Finding(
            place="/@status",
            problem=f"the run is {record.status}, which does not fit the status of its cells",
        )


def _input_findings(entry: RecordedInput, contents: ContentDigests) -> Iterator[Finding]:
    place = f"/{layout.INPUTS}/{entry.name}"
    for index, file in enumerate(entry.files):
        if problem := name_problem(file.name):
            yield Finding(place=place, problem=f"the name of the file {file.name!r} {problem}")
        if not (_is_sha256(file.sha256) and file.size_bytes >= 0):
            yield Finding(place=place, problem=f"the file {file.name!r} needs a size and a SHA-256")
        if not entry.embedded:
            continue
        inside = f"{place}/{layout.INPUT_CONTENTS}/{content_name(index)}"
        stated = ArrayFingerprint(dtype="|u1", shape=(file.size_bytes,), sha256=file.sha256)
        if contents.arrays.get(inside) != stated:
            yield Finding(place=inside, problem=f"does not hold the bytes of {file.name}")


def _published_findings(record: RunRecord) -> Iterator[Finding]:
    place = f"/{layout.PUBLISHED}"
    for file in record.published:
        if problem := path_problem(file.path):
            yield Finding(
                place=place,
                problem=f"{file.path!r} {problem}: it must be a path from the folder of the record",
            )
        if not (_is_sha256(file.sha256) and file.size_bytes >= 0):
            yield Finding(place=place, problem=f"the file {file.path!r} needs a size and a SHA-256")
    paths = [file.path for file in record.published]
    if twice := colliding(paths):
        yield Finding(place=place, problem=f"{twice!r} is named twice, as some systems see it")


def _name_findings(record: RunRecord) -> Iterator[Finding]:
    """Check what folders and files of other programs are called after."""
    named = [("/@name", record.name), ("/@run_id", record.run_id)]
    named += [(f"/{layout.INPUTS}/{entry.name}", entry.name) for entry in record.inputs]
    for cell in record.cells:
        place = f"/{layout.CELLS}/{cell.address}"
        named += [(place, _shortened(cell.address)), (f"{place}@step", cell.step)]
        named += [(f"{place}/{layout.CELL_OUTPUTS}/{port}", port) for port in cell.outputs]
        yield from _figure_findings(cell)
    for place, name in named:
        # What must not be empty is said elsewhere.
        if name and (problem := name_problem(name)):
            yield Finding(place=place, problem=f"{name!r} {problem}, so no file can be named so")


def _shortened(address: str) -> str:
    """An address as the names of files have it: they cut the longest ones, and add a digest."""
    return address if len(address) <= _LETTERS_MOST else f"{address[:_LETTERS_MOST]}-"


def _figure_findings(cell: RecordedCell) -> Iterator[Finding]:
    place = f"/{layout.CELLS}/{cell.address}/{layout.FIGURES}"
    for figure in cell.figures:
        suffix = FIGURE_SUFFIXES.get(figure.media_type, "")
        if not suffix:
            problem = f"the figure {figure.name!r} has the media type {figure.media_type!r}"
            yield Finding(place=place, problem=f"{problem}, not that of a PNG, WebP or SVG file")
        if problem := name_problem(figure.name) or name_problem(f"{figure.name}{suffix}"):
            yield Finding(place=place, problem=f"the name of the figure {figure.name!r} {problem}")
    if twice := colliding(figure.name for figure in cell.figures):
        problem = f"two figures are named {twice!r}, as some systems see it"
        yield Finding(place=place, problem=problem)


def _cell_findings(cell: RecordedCell, environments: Set[str]) -> Iterator[Finding]:
    place = f"/{layout.CELLS}/{cell.address}"
    required = ["step", "method"]
    if cell.status == "ok":
        required += ["key", "key_preimage", "started", "ended", "environment", "determinism"]
        required += ["distribution", "distribution_version"]
    else:
        required.append("error_message")
    for name in required:
        if not getattr(cell, name):
            yield Finding(place=place, problem=f"{name} must not be empty ({cell.status} cell)")
    if cell.key and cell.key != sha256_text(cell.key_preimage):
        yield Finding(place=f"{place}@key", problem="the key is not the SHA-256 of its preimage")
    if cell.environment and cell.environment not in environments:
        yield Finding(
            place=f"{place}@environment", problem=f"there is no environment {cell.environment}"
        )
    for metric in cell.metrics:
        if not math.isfinite(metric.value) or not metric.name or not metric.unit:
            yield Finding(
                place=f"{place}/metrics",
                problem=f"the metric {metric.name!r} must be a finite number with a unit, got "
                f"{metric.value} {metric.unit!r}",
            )
    for cost in cost_metrics(cell):
        if not math.isfinite(cost.value) or cost.value < 0:
            problem = f"must not be negative, got {cost.value}"
            yield Finding(place=f"{place}@{cost.name}", problem=problem)


def _reference_findings(cell: RecordedCell, outputs: Mapping[str, str]) -> Iterator[Finding]:
    """Check that digests are digests and that an input is what its source gave."""
    for folder, products in (
        (layout.CELL_INPUTS, cell.inputs),
        (layout.CELL_OUTPUTS, cell.outputs),
    ):
        for port, product in products.items():
            place = f"/{layout.CELLS}/{cell.address}/{folder}/{port}"
            scheme, _, digits = product.digest.partition(":")
            if scheme != "sha256" or not _is_sha256(digits):
                yield Finding(place=place, problem=f"{product.digest!r} is no SHA-256 digest")
            if product.source and outputs.get(product.source, product.digest) != product.digest:
                yield Finding(
                    place=place,
                    problem=f"has the digest {product.digest}, but its source {product.source} "
                    f"gave {outputs[product.source]}",
                )


def _product_findings(
    file: h5py.File, cell: RecordedCell, contents: ContentDigests
) -> Iterator[Finding]:
    for port, output in cell.outputs.items():
        if not output.embedded:
            continue
        place = f"/{layout.CELLS}/{cell.address}/{layout.CELL_OUTPUTS}/{port}"
        try:
            digest = _product_digest(open_group(file, place), output, contents)
        except RecordFormatError as error:
            yield Finding(place=place, problem=str(error))
            continue
        if digest != output.digest:
            yield Finding(
                place=place, problem=f"has the digest {digest}, the record says {output.digest}"
            )


def _product_digest(group: h5py.Group, output: RecordedProduct, contents: ContentDigests) -> str:
    arrays: dict[str, ArrayFingerprint] = {}
    for name, _ in array_datasets(group):
        path = f"{group.name}/arrays/{name}"
        if path not in contents.arrays:
            raise RecordFormatError(f"{path} cannot be digested, so {group.name} cannot either")
        arrays[name] = contents.arrays[path]
    metadata = read_json(group, "metadata")
    return digest_of_parts(output.type_name, output.encoding_version, metadata, arrays)


def _is_sha256(text: str) -> bool:
    return len(text) == 64 and _HEX_DIGITS.issuperset(text)
