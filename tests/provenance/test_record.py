"""Records come back as they were written, and no change of one byte stays unseen."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from orthoflow_provenance import record as module
from orthoflow_provenance.arrays import payload_digest
from orthoflow_provenance.document import (
    RUN_FORMAT,
    InputFileError,
    PublishedFile,
    RecordedCell,
    RecordedEnvironment,
    RecordedFile,
    RecordedInput,
    RecordFormatError,
    RunRecord,
)
from orthoflow_provenance.hdf5 import safe_open
from orthoflow_provenance.record import extract_files, open_record, read_record, write_record
from orthoflow_provenance.verify import verify_record

from tests import hostile_records as hostile
from tests.provenance_records import cloud_payload, sample_record, walls_payload, write_sample

WALL = "wall@plane=hough2d,orient=pnp#2"

TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)
NAME = st.text(st.characters(categories=["L", "N", "P"], exclude_characters="/"), min_size=1).map(
    lambda text: f"n{text}"
)
NUMBER = st.floats(allow_nan=False, allow_infinity=False)
SHORT = st.integers(-(2**62), 2**62)
UNIQUE: dict[type, Callable[[Any], str]] = {
    RecordedCell: lambda cell: cell.address,
    RecordedEnvironment: lambda environment: environment.id,
    RecordedInput: lambda entry: entry.name,
}
JSON_VALUE = st.none() | st.booleans() | st.integers() | TEXT | st.lists(TEXT, max_size=3)


# Any: what a dataclass's field may hold.
def of_type(kind: Any) -> st.SearchStrategy[Any]:
    """Values of the types that the dataclasses of a record declare."""
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return of_class(kind)
    if origin is Literal:
        return st.sampled_from(parts)
    if origin is tuple:
        return st.lists(of_type(parts[0]), max_size=3, unique_by=UNIQUE.get(parts[0])).map(tuple)
    if origin is Mapping:
        return st.dictionaries(NAME, of_type(parts[1]), max_size=3)
    if origin in (Union, UnionType):
        return st.one_of(*map(of_type, parts))
    plain = {str: TEXT, float: NUMBER, bool: st.booleans(), bytes: st.binary(max_size=20)}
    return plain.get(kind, {int: SHORT, type(None): st.none()}.get(kind, JSON_VALUE))


def of_class(kind: type) -> st.SearchStrategy[Any]:
    hints = typing.get_type_hints(kind)
    fields = {name: of_type(hint) for name, hint in hints.items()}
    if kind in UNIQUE:
        fields[{RecordedCell: "address", RecordedEnvironment: "id"}.get(kind, "name")] = NAME
    if kind is RecordedFile:
        fields["name"] = TEXT.map(lambda text: text.replace("/", ""))
    if "embedded" in fields:  # neither products nor files lie where the test writes records
        fields["embedded"] = st.just(value=False)
    return st.builds(kind, **fields)


@settings(max_examples=25)
@given(of_class(RunRecord))
def test_any_record_comes_back_as_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, record: RunRecord
) -> None:
    path = tmp_path_factory.mktemp("record") / "run.h5"
    write_record(path, record, lambda _: None, keep_folders=True)
    read = read_record(path)
    assert read == record
    for cell, written in zip(read.cells, record.cells, strict=True):
        assert list(cell.assignment) == list(written.assignment)


def test_equal_runs_give_equal_files(tmp_path: Path) -> None:
    path, record, shelf = write_sample(tmp_path)
    seal = write_record(tmp_path / "again.h5", record, shelf.find)
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()
    with safe_open(path, RUN_FORMAT) as file:
        assert file.attrs["content_sha256"] == seal.encode()


def test_an_embedded_product_comes_back_with_its_digest(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    with open_record(path) as opened:
        stored = opened.payload(WALL, "walls")
    assert stored.digest == payload_digest(stored) == payload_digest(walls_payload())
    np.testing.assert_array_equal(
        stored.arrays["walls/0/depth_m"], walls_payload().arrays["walls/0/depth_m"]
    )


def test_an_embedded_cloud_is_mapped_from_the_record_and_outlives_it(tmp_path: Path) -> None:
    path, record, _ = write_sample(tmp_path, embed=True)
    assert verify_record(path) == ()
    with open_record(path) as opened:
        stored = opened.payload("cloud", "cloud")
        outputs = [out for cell in opened.record.cells for out in cell.outputs.values()]
    assert all(output.embedded for output in outputs)
    assert isinstance(stored.arrays["x"].base, np.memmap)
    assert stored.arrays["x"].flags.aligned
    np.testing.assert_array_equal(stored.arrays["x"], cloud_payload().arrays["x"])
    assert not any(out.embedded for cell in record.cells[:1] for out in cell.outputs.values())


def test_a_product_that_is_not_embedded_is_named_by_its_digest(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    with open_record(path) as opened:
        with pytest.raises(RecordFormatError, match=r"by its digest only, sha256:.*--embed"):
            opened.payload("cloud", "cloud")
        with pytest.raises(RecordFormatError, match="no output walls of the cell nowhere"):
            opened.payload("nowhere", "walls")


def test_a_product_that_left_the_store_cannot_be_embedded(tmp_path: Path) -> None:
    path, record, shelf = write_sample(tmp_path)
    before = path.read_bytes()
    with pytest.raises(RecordFormatError, match="is not in the store any more: run the workflow"):
        write_record(path, record, lambda _: None)
    assert path.read_bytes() == before
    assert sorted(tmp_path.glob(".*")) == []
    other = shelf.put(cloud_payload(5))
    with pytest.raises(RecordFormatError, match=r"product-2\.h5 must hold the product sha256:"):
        write_record(path, record, lambda _: shelf.find(other))


def test_impossible_records_are_refused(tmp_path: Path) -> None:
    _, record, shelf = write_sample(tmp_path)
    cell, path = record.cells[0], "/home/jane/a.laz"
    file = RecordedFile(name=path, size_bytes=1, sha256="")
    changes: tuple[tuple[dict[str, Any], str], ...] = (
        ({"cells": (cell, cell)}, "the cell 'cloud' is given twice"),
        ({"cells": (dataclasses.replace(cell, address="a/b"),)}, "the cell 'a/b' cannot be a name"),
        ({"inputs": (RecordedInput(name="scan", files=(file,)),)}, f"'{path}' of the input scan"),
    )
    for change, message in changes:
        with pytest.raises(RecordFormatError, match=message):
            write_record(tmp_path / "other.h5", dataclasses.replace(record, **change), shelf.find)
    assert not (tmp_path / "other.h5").exists()


def test_folders_stay_out_of_the_record(tmp_path: Path) -> None:
    _, record, shelf = write_sample(tmp_path)
    cell = dataclasses.replace(
        record.cells[2],
        error_message="cannot read /home/jane/scans/hall.e57: it is cut off",
        log='File "/opt/python/numpy.py", see https://example.org/a/b; 3 m/s, ../a/b, and/or',
        warnings=(f"{Path.home()}/My Scans/x.las",),
    )
    told = dataclasses.replace(
        record,
        cells=(cell,),
        overrides=("--input scan=/home/jane/scans/hall.e57",),
        workflow_resolved='{"files":["/home/jane/scans/hall.e57"]}',
    )
    path = tmp_path / "run.h5"
    write_record(path, told, shelf.find)
    read = read_record(path)
    assert read.cells[0].error_message == "cannot read hall.e57: it is cut off"
    assert read.cells[0].log == (
        'File "numpy.py", see https://example.org/a/b; 3 m/s, ../a/b, and/or'
    )
    assert read.cells[0].warnings == ("My Scans/x.las",)
    assert read.overrides == ("--input scan=hall.e57",)
    assert read.workflow_resolved == '{"files":["hall.e57"]}'
    assert b"jane" not in path.read_bytes()
    write_record(path, told, shelf.find, keep_folders=True)
    assert read_record(path) == told


def test_what_is_no_record_is_a_finding_and_an_error(tmp_path: Path) -> None:
    _, _, shelf = write_sample(tmp_path)
    (product,) = [shelf.files[digest] for digest in list(shelf.files)[:1]]
    with pytest.raises(
        RecordFormatError, match="must be of format orthoflow-run, got 'orthoflow-p"
    ):
        read_record(product)
    (tmp_path / "run.h5").unlink()
    (finding,) = verify_record(tmp_path / "run.h5")
    assert "No such file" in finding.problem
    with pytest.raises(FileNotFoundError):
        read_record(tmp_path / "run.h5")


def test_any_changed_byte_is_found(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path, embed=True)
    content = path.read_bytes()
    rng = np.random.default_rng(11)
    with h5py.File(path) as file:
        spans = [
            (item.id.get_offset(), item.id.get_storage_size())
            for item in _datasets(file)
            if item.id.get_offset() is not None
        ]
    inside = [start + int(rng.integers(length)) for start, length in spans if length]
    for offset in (*inside, *rng.integers(0, len(content), 60)):
        flipped = bytearray(content)
        flipped[offset] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        assert verify_record(path), offset


def _datasets(group: h5py.Group) -> Iterator[h5py.Dataset]:
    for item in group.values():
        if isinstance(item, h5py.Dataset):
            yield item
        else:
            yield from _datasets(item)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_a_truncated_record_is_a_finding(tmp_path: Path, share: float) -> None:
    path, _, _ = write_sample(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    (finding,) = verify_record(path)
    assert finding.code in ("damaged", "foreign")
    with pytest.raises(RecordFormatError, match=r"^run\.h5"):
        read_record(path)


@pytest.mark.parametrize("is_sealed_again", [False, True])
def test_bytes_behind_the_end_are_found(tmp_path: Path, *, is_sealed_again: bool) -> None:
    path, record, _ = write_sample(tmp_path)
    with h5py.File(path) as file:
        offset = file["seal"].id.get_offset()
    with path.open("ab") as stream:
        stream.write(b"more")
    if is_sealed_again:
        module._seal_file(path, offset)
    assert "appended" in {finding.code for finding in verify_record(path)}
    assert read_record(path) == record


# --- changes made with a program ------------------------------------------------------------------


def _attribute(place: str, name: str, value: object) -> Callable[[h5py.File], None]:
    return lambda file: file[place].attrs.__setitem__(name, value)


def _order_links(file: h5py.File) -> None:
    properties = h5py.h5p.create(h5py.h5p.GROUP_CREATE)
    properties.set_link_creation_order(h5py.h5p.CRT_ORDER_TRACKED)
    h5py.h5g.create(file.id, b"new", gcpl=properties)
    for name in file["inputs"]:
        file.copy(f"inputs/{name}", file["new"])
    del file["inputs"]
    file.move("new", "inputs")


def _change_metric(file: h5py.File) -> None:
    table = file["metrics"][()]
    table["value"][-1] += 1
    file["metrics"][...] = table


def _retype(file: h5py.File) -> None:
    value = file["cells/cloud"].attrs["wall_s"]
    del file["cells/cloud"].attrs["wall_s"]
    file["cells/cloud"].attrs["wall_s"] = np.float32(value)


def _array(file: h5py.File) -> h5py.Dataset:
    (product,) = file["products"].values()
    return product["arrays/walls/0/mask"]


def _change_array(file: h5py.File) -> None:
    _array(file)[3, 4] ^= 1


OBJECTS: dict[str, tuple[Callable[[h5py.File], object], str]] = {
    "attribute of a cell": (_attribute("cells/cloud", "wall_s", 0.5), "/cells/cloud"),
    "attribute of the file": (_attribute("/", "created_by", np.bytes_(b"other")), "/"),
    "attribute added": (_attribute("cells/cloud", "note", 1), "/cells/cloud"),
    "attribute removed": (
        lambda file: file["cells/cloud"].attrs.__delitem__("step"),
        "/cells/cloud",
    ),
    "type of an attribute": (_retype, "/cells/cloud"),
    "metric": (_change_metric, "/metrics"),
    "links in another order": (_order_links, "/inputs"),
    "dataset added": (lambda file: file.__setitem__("cells/cloud/notes", 3), "/cells/cloud/notes"),
    "group added": (lambda file: file.create_group("notes"), "/notes"),
    "file added": (lambda file: file.__setitem__("files/x", np.zeros(3, "u1")), "/files/x"),
    "product added": (lambda file: file.create_group("products/x"), "/products/x"),
    "log removed": (lambda file: file.__delitem__("cells/cloud/log"), "/cells/cloud/log"),
    "cell added": (lambda file: file.copy("cells/ortho", "cells/ortho2"), "/cells/ortho2"),
    "content digest": (_attribute("/", "content_sha256", np.bytes_(b"0" * 64)), "/"),
}


@pytest.mark.parametrize("is_sealed_again", [False, True])
@pytest.mark.parametrize(("change", "place"), OBJECTS.values(), ids=OBJECTS)
def test_what_the_document_does_not_say_is_found_even_when_sealed(
    tmp_path: Path, change: Callable[[h5py.File], object], place: str, *, is_sealed_again: bool
) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        change(file)
        if is_sealed_again:
            hostile.seal(file)
    findings = verify_record(path)
    assert place in {found.place for found in findings if found.code == "object"}, findings
    assert is_sealed_again or "seal" in {found.code for found in findings}
    assert place in {found.place for found in verify_record(path, with_arrays=False)}


@pytest.mark.parametrize(
    "change",
    [
        lambda file: file.__delitem__("seal"),
        lambda file: h5py.h5o.set_comment(file["cells"].id, b"a note"),
    ],
    ids=["no seal", "comment"],
)
def test_a_broken_seal_is_found(tmp_path: Path, change: Callable[[h5py.File], object]) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        change(file)
    assert "seal" in {found.code for found in verify_record(path)}


@pytest.mark.parametrize("is_sealed_again", [False, True])
def test_arrays_that_are_not_what_their_digest_says_are_not_read(
    tmp_path: Path, *, is_sealed_again: bool
) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        _change_array(file)
        if is_sealed_again:
            hostile.seal(file)
    assert "product" in {found.code for found in verify_record(path)}
    with (
        open_record(path) as opened,
        pytest.raises(RecordFormatError, match="the record states sha256:"),
    ):
        opened.payload(WALL, "walls")


def _set(address: str, **values: object) -> Callable[[hostile.Record], None]:
    return lambda record: record.cell(address).update(values)


def _set_run(**values: object) -> Callable[[hostile.Record], None]:
    return lambda record: record.document.update(values)


CONTRADICTIONS: dict[str, tuple[Callable[[hostile.Record], object], str, str]] = {
    "infinite metric": (
        lambda record: record.cell(WALL)["metrics"][0].update(unit=""),
        "field",
        f"/cells/{WALL}/metrics",
    ),
    "negative time": (_set("cloud", wall_s=-1.0), "field", "/cells/cloud@wall_s"),
    "key": (_set("cloud", key="f" * 64), "key", "/cells/cloud@key"),
    "no key": (_set("cloud", key=""), "field", "/cells/cloud"),
    "environment": (_set("cloud", environment="x"), "reference", "/cells/cloud@environment"),
    "status of the run": (_set_run(status="ok"), "field", "/@status"),
    "impossible status": (_set("cloud", status="fine"), "document", "/document"),
    "no run id": (_set_run(run_id=""), "field", "/"),
    "seed": (_set_run(seed="seven"), "document", "/document"),
    "repeat": (_set("cloud", repeat=True), "document", "/document"),
    "unknown field": (_set("cloud", colour="blue"), "document", "/document"),
    "missing field": (lambda record: record.cell("cloud").pop("log"), "document", "/document"),
    "parameters": (_set("cloud", params=[]), "document", "/document"),
    "input differs from its source": (
        lambda record: record.cell(WALL)["inputs"]["cloud"].update(digest="sha256:" + "0" * 64),
        "reference",
        f"/cells/{WALL}/inputs/cloud",
    ),
    "digest": (
        lambda record: record.cell("cloud")["outputs"]["cloud"].update(digest="md5:0"),
        "reference",
        "/cells/cloud/outputs/cloud",
    ),
    "resolved workflow": (_set_run(workflow_resolved="{'seed': 7}"), "field", "/document"),
    "folder of an input file": (
        lambda record: record.document["inputs"][0]["files"][0].update(name="/home/a.laz"),
        "name",
        "/inputs/scan",
    ),
}


@pytest.mark.parametrize(("change", "code", "place"), CONTRADICTIONS.values(), ids=CONTRADICTIONS)
def test_records_that_contradict_themselves_are_found_even_when_sealed(
    tmp_path: Path, change: Callable[[hostile.Record], object], code: str, place: str
) -> None:
    path, _, _ = write_sample(tmp_path)
    hostile.reseal(path, change)
    found = {(finding.code, finding.place) for finding in verify_record(path)}
    assert (code, place) in found
    assert "seal" not in {code for code, _ in found}


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "[" * 50_000, '{"run_id": NaN}'], ids=lambda text: text[:9] or "empty"
)
def test_a_document_of_another_form_is_found(tmp_path: Path, text: str) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        hostile.rewrite(file, text)
    assert "document" in {finding.code for finding in verify_record(path)}
    with pytest.raises(RecordFormatError):
        read_record(path)


def test_seal_and_digests_are_those_that_the_specification_describes(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path) as file:
        text = file["document"][()]
        offset = file["seal"].id.get_offset()
        seal = file["seal"][()].decode()
        assert file.attrs["content_sha256"].decode() == hashlib.sha256(text).hexdigest()
    content = path.read_bytes()
    zeros = content[:offset] + b"0" * 64 + content[offset + 64 :]
    assert seal == hashlib.sha256(zeros).hexdigest()
    document = json.loads(text)
    (figure,) = document["cells"][1]["figures"]
    with h5py.File(path) as file:
        assert (
            hashlib.sha256(file["files"][figure["data"]][()].tobytes()).hexdigest()
            == figure["data"]
        )


# --- input files in the record --------------------------------------------------------------------

CONTENTS = (b"first photo", b"", b"first photo", bytes(range(256)) * 300)


def recorded(name: str, content: bytes) -> RecordedFile:
    return RecordedFile(
        name=name, size_bytes=len(content), sha256=hashlib.sha256(content).hexdigest()
    )


def record_with(inputs: tuple[RecordedInput, ...]) -> RunRecord:
    """The sample without its products, which these tests do not need."""
    record = sample_record("sha256:" + "a" * 64, "sha256:" + "b" * 64)
    [failed] = record.cells[2:]
    return dataclasses.replace(record, cells=(failed,), environments=(), inputs=inputs)


def write_embedded(folder: Path, contents: tuple[bytes, ...], name: str = "photo.jpg") -> Path:
    files = tuple(recorded(name, content) for content in contents)
    shelf = folder / "shelf"
    shelf.mkdir(parents=True)
    for file, content in zip(files, contents, strict=True):
        (shelf / file.sha256).write_bytes(content)
    path = folder / "run.h5"
    record = record_with((RecordedInput(name="photos", files=files, embedded=True),))
    write_record(path, record, lambda _: None, input_file=shelf.joinpath)
    assert read_record(path) == record
    return path


@settings(max_examples=15)
@given(st.lists(st.binary(max_size=5000), max_size=4).map(tuple))
def test_any_files_come_back_with_their_bytes(
    tmp_path_factory: pytest.TempPathFactory, contents: tuple[bytes, ...]
) -> None:
    folder = tmp_path_factory.mktemp("embedded")
    path = write_embedded(folder, contents)
    assert verify_record(path) == ()
    taken = extract_files(path, read_record(path).inputs, folder / "out")
    assert tuple(file.read_bytes() for file in taken["photos"]) == contents
    assert {file.name for file in taken["photos"]} <= {"photo.jpg"}


def test_a_changed_byte_is_named_and_not_taken_out(tmp_path: Path) -> None:
    path = write_embedded(tmp_path, CONTENTS)
    with h5py.File(path, "r+") as file:
        dataset = file[f"files/{hashlib.sha256(CONTENTS[3]).hexdigest()}"]
        dataset[700] = dataset[700] ^ 1
        hostile.seal(file)
    [finding] = verify_record(path)
    assert finding.code == "file"
    with pytest.raises(RecordFormatError, match=r"has the SHA-256 .* the record states"):
        extract_files(path, read_record(path).inputs, tmp_path / "out")


def test_a_file_that_changed_or_is_gone_is_not_embedded(tmp_path: Path) -> None:
    changed = tmp_path / "photo.jpg"
    changed.write_bytes(b"newer photo")
    entry = RecordedInput(
        name="photos", files=(recorded("photo.jpg", b"older photo"),), embedded=True
    )
    record = record_with((entry,))
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for find, sentence in (
        (lambda _: pipe, "but it was changed since it was digested"),
        (lambda _: tmp_path / "gone", "but it was changed since it was digested"),
        (lambda _: changed, "but it was changed since it was digested"),
        (lambda _: None, "is to be embedded, but there is none with its SHA-256"),
    ):
        with pytest.raises(InputFileError, match=sentence):
            write_record(tmp_path / "run.h5", record, lambda _: None, input_file=find)
    assert not (tmp_path / "run.h5").exists()


@pytest.mark.parametrize("path", ["../ortho.tif", "/etc/passwd", "products//ortho.tif", ""])
def test_published_files_lie_below_the_folder_of_the_record(tmp_path: Path, path: str) -> None:
    published = PublishedFile(path=path, size_bytes=1, sha256="0" * 64)
    record = dataclasses.replace(record_with(()), published=(published,))
    write_record(tmp_path / "run.h5", record, lambda _: None)
    [finding] = verify_record(tmp_path / "run.h5")
    assert finding.place == "/published"
