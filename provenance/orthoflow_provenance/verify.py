"""Checks of a record: the seal, all digests, all objects and all required fields."""

from __future__ import annotations

import math
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from orthoflow_provenance.arrays import payload_digest, read_payload
from orthoflow_provenance.document import (
    DIGEST_PREFIX,
    FIGURE_SUFFIXES,
    RUN_FORMAT,
    LockedFileError,
    PublishedFile,
    RecordedCell,
    RecordedFile,
    RecordFormatError,
    RunRecord,
    UnknownFormatError,
    cost_metrics,
    parse_json,
    sha256_text,
)
from orthoflow_provenance.hdf5 import (
    HDF5_ERRORS,
    bytes_behind_end,
    dataset_of,
    open_group,
    read_text,
    read_whole,
    reading,
    safe_open,
)
from orthoflow_provenance.paths import colliding, name_problem, path_problem
from orthoflow_provenance.record import (
    CELLS,
    DOCUMENT,
    FILES,
    PRODUCTS,
    SEAL,
    Node,
    dataset_sha256,
    expected_nodes,
    file_sha256,
    is_sha256,
    product_path,
    record_of,
)

_LETTERS_MOST: Final = 60
_OF_RESULTS: Final = (
    *("key", "key_preimage", "started", "ended", "environment", "determinism"),
    *("distribution", "distribution_version"),
)
_PRODUCT_ATTRIBUTES: Final = frozenset({"type", "encoding_version", "digest", "mapped"})


class Finding(NamedTuple):
    """A problem found in a record.

    Attributes:
        code: kind of problem: `foreign` or `locked` if the file cannot be checked; otherwise
            `damaged`, `seal`, `appended`, `document`, `object`, `product`, `file`, `field`, `name`,
            `key` or `reference`.
        place: path in the file, with `@` before the name of an attribute.
        problem: description of the problem, one sentence.
    """

    code: str
    place: str
    problem: str


def verify_record(path: Path, *, with_arrays: bool = True) -> tuple[Finding, ...]:
    """Check a record; problems of the file are returned as findings, never raised as exceptions.

    Args:
        path: the record.
        with_arrays: whether to check also the seal of the file, the arrays of products, and input
            files; otherwise, only the document, the objects that repeat it, and figures are read.

    Returns:
        All findings, in the order of the checks; empty if the record is intact and unchanged.
    """
    try:
        with safe_open(path, RUN_FORMAT) as file:
            found = list(_document_findings(file, with_arrays=with_arrays))
            # Check the seal last, because the other checks can name the object that was changed.
            found += _seal_findings(file, path) if with_arrays else ()
            return tuple(found)
    except RecordFormatError as error:
        codes = {LockedFileError: "locked", UnknownFormatError: "foreign"}
        return (Finding(codes.get(type(error), "damaged"), "/", str(error)),)
    except HDF5_ERRORS as error:
        return (Finding("damaged", "/", f"cannot read {path.name}: {error}"),)


def _document_findings(file: h5py.File, *, with_arrays: bool) -> Iterator[Finding]:
    try:
        text = read_text(file, DOCUMENT)
        record = record_of(file)
        nodes = expected_nodes(record, text)
        # The type is Any; the reader has checked the structure of the document.
        document: Any = parse_json(text, f"/{DOCUMENT}")
        contents = _contents(document)
    except RecordFormatError as error:
        yield Finding("document", f"/{DOCUMENT}", str(error))
        return
    yield from _object_findings(file, record, nodes, contents)
    yield from _content_findings(file, contents, with_arrays=with_arrays)
    if with_arrays:
        yield from _product_findings(file, record)
    yield from _run_findings(record)
    outputs = {
        f"{cell.address}.{port}": product.digest
        for cell in record.cells
        for port, product in cell.outputs.items()
    }
    for cell in record.cells:
        yield from _cell_findings(cell, record)
        yield from _reference_findings(cell, outputs)


def _seal_findings(file: h5py.File, path: Path) -> Iterator[Finding]:
    n_bytes = bytes_behind_end(path)
    if n_bytes:
        after = f"there are {n_bytes} bytes after"
        how = after if n_bytes > 0 else f"{-n_bytes} bytes are missing before"
        yield Finding("appended", "/", f"{how} the end declared in the file")
    try:
        seal = read_text(file, SEAL)
        offset = dataset_of(file, SEAL).id.get_offset()
    except RecordFormatError as error:
        yield Finding("seal", f"/{SEAL}", f"the seal is broken: {error}")
        return
    found = "" if offset is None or len(seal) != 64 else file_sha256(path, offset)
    if found != seal:
        problem = f"the seal is {seal:.80}, but the SHA-256 of the content is {found}"
        yield Finding("seal", f"/{SEAL}", f"{problem}: the file has been changed")


def _object_findings(
    file: h5py.File, record: RunRecord, nodes: Mapping[str, Node], contents: Container[str]
) -> Iterator[Finding]:
    """Compare the objects that are not referenced by a digest with the document."""
    places = {product_path(digest).rpartition("/")[2] for digest in _embedded(record)}
    known = {*nodes, f"/{SEAL}", f"/{PRODUCTS}", f"/{FILES}"}
    missing = set(known)
    for path, item in _objects(file):
        missing.discard(path)
        _, top, *below = path.split("/")
        is_known, attributes = path in known, frozenset[str]()
        if top == PRODUCTS and below:
            is_known = below[0] in places and below[1:2] in ([], ["metadata"], ["arrays"])
            attributes = frozenset() if below[1:] else _PRODUCT_ATTRIBUTES
        elif top == FILES and below:
            is_known = below[0] in contents
        problem = "is in the file, but not listed in the document"
        if is_known:
            try:
                problem = _object_problem(item, nodes.get(path), attributes)
            except RecordFormatError as error:
                problem = str(error)
        if problem:
            yield Finding("object", path, problem)
    for path in sorted(missing):
        yield Finding("object", path, "is missing from the file")


def _object_problem(
    item: h5py.Group | h5py.Dataset, node: Node | None, attributes: Collection[str]
) -> str:
    """Return how an object differs from a node; without a node, check only attribute names."""
    with reading(item.name):
        if isinstance(item, h5py.Group) and item.id.get_create_plist().get_link_creation_order():
            return "tracks the creation order of its links, which is not allowed in a record"
        odd = set(item.attrs) ^ set(node.attributes if node else attributes)
        odd |= {
            name
            for name, value in (node.attributes if node else {}).items()
            if name not in odd and not _is_same(np.asarray(item.attrs[name]), value)
        }
    if odd:
        return f"its attribute {min(odd)!r} differs from the document"
    if node is None or (node.data is None and isinstance(item, h5py.Group)):
        return ""
    is_alike = (
        node.data is not None
        and isinstance(item, h5py.Dataset)
        and (item.shape, item.nbytes) == (node.data.shape, node.data.nbytes)
        and _is_same(np.asarray(read_whole(item)), node.data)
    )
    return "" if is_alike else "differs from the document"


def _is_same(found: NDArray[Any], expected: NDArray[Any]) -> bool:
    kinds = (found.dtype, found.shape) == (expected.dtype, expected.shape)
    return kinds and found.tobytes() == expected.tobytes()


def _objects(file: h5py.File) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    pending: list[tuple[str, h5py.Group | h5py.Dataset]] = [("/", file)]
    while pending:
        path, item = pending.pop()
        yield path, item
        if isinstance(item, h5py.Group):
            with reading(path):
                pending += [
                    (f"{path.rstrip('/')}/{name}", item[name])
                    for name in sorted(item, reverse=True)
                ]


def _embedded(record: RunRecord) -> dict[str, str]:
    """Return the types of the products whose arrays are in the record, by digest."""
    return {
        output.digest: output.type_name
        for cell in record.cells
        for output in cell.outputs.values()
        if output.embedded and is_sha256(output.digest.removeprefix(DIGEST_PREFIX))
    }


def _contents(document: Mapping[str, Any]) -> dict[str, int | None]:
    """Return the sizes of the contents of `/files`, by SHA-256; None for figures."""
    return {
        **{figure["data"]: None for cell in document["cells"] for figure in cell["figures"]},
        **{
            file["sha256"]: file["size_bytes"]
            for entry in document["inputs"]
            for file in (entry["files"] if entry["embedded"] else ())
        },
    }


def _content_findings(
    file: h5py.File, contents: Mapping[str, int | None], *, with_arrays: bool
) -> Iterator[Finding]:
    """Check the contents of `/files`; without `with_arrays`, only the sizes of input files."""
    for sha256, size_bytes in contents.items():
        problem = "does not have the size and the SHA-256 that the document states"
        try:
            dataset = dataset_of(open_group(file, FILES), sha256)
            is_sized = size_bytes in (None, dataset.size)
            if dataset.dtype == np.uint8 and dataset.ndim == 1 and is_sized:
                is_left_out = size_bytes is not None and not with_arrays
                if is_left_out or dataset_sha256(dataset) == sha256:
                    continue
        except RecordFormatError as error:
            problem = str(error)
        yield Finding("file", f"/{FILES}/{sha256}", problem)


def _product_findings(file: h5py.File, record: RunRecord) -> Iterator[Finding]:
    for digest in _embedded(record):
        place = product_path(digest)
        try:
            payload = read_payload(open_group(file, place))
            found = payload_digest(payload)
            if found != digest or payload.digest != digest:
                problem = f"has the digest {found}, but the record states {digest}"
                yield Finding("product", place, problem)
        except RecordFormatError as error:
            yield Finding("product", place, str(error))


def _run_findings(record: RunRecord) -> Iterator[Finding]:
    for name in ("run_id", "name", "created_by", "started", "ended", "workflow_source"):
        if not getattr(record, name):
            yield Finding("field", "/", f"{name} must not be empty")
    if any(cell.status == "failed" for cell in record.cells) != (record.status == "failed"):
        problem = f"the status of the run is {record.status}, which contradicts that of its cells"
        yield Finding("field", "/@status", problem)
    try:
        parse_json(record.workflow_resolved, "workflow_resolved")
    except RecordFormatError as error:
        yield Finding("field", f"/{DOCUMENT}", str(error))
    yield from _name_findings(record)


def _name_findings(record: RunRecord) -> Iterator[Finding]:
    named = [("/@name", record.name), ("/@run_id", record.run_id)]
    for entry in record.inputs:
        place = f"/inputs/{entry.name}"
        named += [(place, entry.name), *((place, file.name) for file in entry.files)]
        yield from _file_findings(place, entry.files)
    for cell in record.cells:
        place = f"/{CELLS}/{cell.address}"
        # File names contain only the beginning of long addresses.
        named += [(place, cell.address[:_LETTERS_MOST]), (f"{place}@step", cell.step)]
        named += [(f"{place}/outputs/{port}", port) for port in cell.outputs]
        for figure in cell.figures:
            if figure.media_type not in FIGURE_SUFFIXES:
                problem = (
                    f"the figure {figure.name!r} must not have the media type {figure.media_type!r}"
                )
                yield Finding("field", f"{place}/figures", problem)
            suffix = FIGURE_SUFFIXES.get(figure.media_type, "")
            named.append((f"{place}/figures", f"{figure.name}{suffix}"))
        yield from _twice(f"{place}/figures", [figure.name for figure in cell.figures])
    yield from _file_findings("/published", record.published)
    yield from _twice("/published", [file.path for file in record.published])
    problems = [(place, name, name_problem(name)) for place, name in named if name]
    problems += [("/published", one.path, path_problem(one.path)) for one in record.published]
    for place, name, problem in problems:
        if problem:
            yield Finding("name", place, f"{name!r} {problem}, so it cannot be a file name")


def _file_findings(place: str, files: Sequence[RecordedFile | PublishedFile]) -> Iterator[Finding]:
    if not all(is_sha256(file.sha256) and file.size_bytes >= 0 for file in files):
        yield Finding("field", place, "each file needs a size and a SHA-256")


def _twice(place: str, names: Sequence[str]) -> Iterator[Finding]:
    if twice := colliding(names):
        yield Finding("name", place, f"{twice!r} occurs twice on file systems that ignore case")


def _cell_findings(cell: RecordedCell, record: RunRecord) -> Iterator[Finding]:
    place = f"/{CELLS}/{cell.address}"
    required = ["step", "method", *(["error_message"] if cell.status != "ok" else _OF_RESULTS)]
    for name in required:
        if not getattr(cell, name):
            yield Finding("field", place, f"{name} must not be empty ({cell.status} cell)")
    if cell.key and cell.key != sha256_text(cell.key_preimage):
        yield Finding("key", f"{place}@key", "the key is not the SHA-256 of its preimage")
    if cell.environment not in {"", *(entry.id for entry in record.environments)}:
        problem = f"there is no environment {cell.environment}"
        yield Finding("reference", f"{place}@environment", problem)
    for metric in cell.metrics:
        if not math.isfinite(metric.value) or not metric.name or not metric.unit:
            problem = f"the metric {metric.name!r} must be a finite number with a unit, got "
            yield Finding("field", f"{place}/metrics", f"{problem}{metric.value} {metric.unit!r}")
    for cost in cost_metrics(cell):
        if not math.isfinite(cost.value) or cost.value < 0:
            yield Finding(
                "field", f"{place}@{cost.name}", f"must not be negative, got {cost.value}"
            )


def _reference_findings(cell: RecordedCell, outputs: Mapping[str, str]) -> Iterator[Finding]:
    for folder, products in (("inputs", cell.inputs), ("outputs", cell.outputs)):
        for port, product in products.items():
            place, digest = f"/{CELLS}/{cell.address}/{folder}/{port}", product.digest
            scheme, _, digits = digest.partition(":")
            if scheme != "sha256" or not is_sha256(digits):
                yield Finding("reference", place, f"{digest!r} is not a SHA-256 digest")
            given = outputs.get(product.source, digest) if product.source else digest
            if given != digest:
                problem = (
                    f"has the digest {digest}, but its source {product.source} returned {given}"
                )
                yield Finding("reference", place, problem)
