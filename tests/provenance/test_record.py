"""Records come back as they were written, and no change of one byte stays unseen."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from orthoflow_provenance import record as module
from orthoflow_provenance.arrays import payload_digest
from orthoflow_provenance.document import (
    RUN_FORMAT,
    InputFileError,
    Metric,
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


def test_a_record_comes_back_and_equal_runs_give_equal_files(tmp_path: Path) -> None:
    path, record, shelf = write_sample(tmp_path)
    odd = "\t\x1b[2J\u2028 e\u0301 \U0001f469\r\n"
    cell = replace(
        record.cells[1],
        log=odd,
        warnings=("", odd),
        params={odd: [2**70, -0.0, None, {"": "1"}]},
        metrics=(Metric(name=odd, value=5e-324, unit="1"),),
    )
    record = replace(record, cells=(record.cells[0], cell), name=odd, status="ok")
    seal = write_record(path, record, shelf.find)
    assert read_record(path) == record
    assert list(read_record(path).cells[1].assignment) == ["plane", "orient"]
    write_record(tmp_path / "again.h5", record, shelf.find)
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()
    with safe_open(path, RUN_FORMAT) as file:
        assert file.attrs["content_sha256"] == seal.encode()


def test_embedded_products_come_back_and_others_are_named_by_their_digest(tmp_path: Path) -> None:
    path, record, _ = write_sample(tmp_path)
    with open_record(path) as opened:
        stored = opened.payload(WALL, "walls")
        with pytest.raises(RecordFormatError, match="/ lacks the group /products/"):
            opened.payload("cloud", "cloud")
        with pytest.raises(RecordFormatError, match=r"no output nowhere\.walls"):
            opened.payload("nowhere", "walls")
    assert stored.digest == payload_digest(stored) == payload_digest(walls_payload())
    np.testing.assert_array_equal(
        stored.arrays["walls/0/depth_m"], walls_payload().arrays["walls/0/depth_m"]
    )
    write_sample(tmp_path, embed=True)
    assert verify_record(path) == ()
    with open_record(path) as opened:
        stored = opened.payload("cloud", "cloud")
        outputs = [out for cell in opened.record.cells for out in cell.outputs.values()]
    assert all(output.embedded for output in outputs)
    assert not record.cells[0].outputs["cloud"].embedded
    # Mapped arrays outlive the open file.
    assert isinstance(stored.arrays["x"].base, np.memmap)
    assert stored.arrays["x"].flags.aligned
    np.testing.assert_array_equal(stored.arrays["x"], cloud_payload().arrays["x"])


def test_what_cannot_be_written_leaves_the_older_record(tmp_path: Path) -> None:
    path, record, shelf = write_sample(tmp_path)
    before = path.read_bytes()
    cell, name = record.cells[0], "/home/jane/a.laz"
    file = RecordedFile(name=name, size_bytes=1, sha256="")
    other = shelf.put(cloud_payload(5))
    lost, another = (lambda _: None), (lambda _: shelf.find(other))
    for find, change, message in (
        (lost, {}, "is no longer in the store: run the workflow"),
        (another, {}, r"product-2\.h5 must contain the product sha256:"),
        (shelf.find, {"cells": (cell, cell)}, "the cell 'cloud' occurs twice"),
        (shelf.find, {"cells": (replace(cell, address="a/b"),)}, "'a/b' cannot be a name"),
        (
            shelf.find,
            {"inputs": (RecordedInput(name="scan", files=(file,)),)},
            f"'{name}' cannot be",
        ),
    ):
        with pytest.raises(RecordFormatError, match=message):
            write_record(path, replace(record, **change), find)
    assert path.read_bytes() == before
    assert sorted(tmp_path.glob(".*")) == []


def test_folders_stay_out_of_the_record(tmp_path: Path) -> None:
    _, record, shelf = write_sample(tmp_path)
    cell = replace(
        record.cells[2],
        error_message="cannot read /home/jane/scans/hall.e57: it is cut off",
        log='File "/opt/python/numpy.py", see https://example.org/a/b; 3 m/s, ../a/b, and/or',
        warnings=(f"{Path.home()}/My Scans/x.las",),
    )
    altered = replace(
        record,
        cells=(cell,),
        overrides=("--input scan=/home/jane/scans/hall.e57",),
        workflow_resolved='{"files":["/home/jane/scans/hall.e57"]}',
    )
    path = tmp_path / "run.h5"
    write_record(path, altered, shelf.find)
    read = read_record(path)
    assert read.cells[0].error_message == "cannot read hall.e57: it is cut off"
    assert read.cells[0].log == (
        'File "numpy.py", see https://example.org/a/b; 3 m/s, ../a/b, and/or'
    )
    assert read.cells[0].warnings == ("My Scans/x.las",)
    assert read.overrides == ("--input scan=hall.e57",)
    assert read.workflow_resolved == '{"files":["hall.e57"]}'
    assert b"jane" not in path.read_bytes()


def test_any_changed_byte_is_found(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    content = path.read_bytes()
    rng = np.random.default_rng(11)
    for offset in rng.integers(0, len(content), 16):
        flipped = bytearray(content)
        flipped[offset] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        assert verify_record(path), offset


def test_a_truncated_record_and_what_is_none_are_findings(tmp_path: Path) -> None:
    path, _, shelf = write_sample(tmp_path)
    content = path.read_bytes()
    for share, code in ((0.0, "foreign"), (0.3, "damaged"), (0.999, "damaged")):
        path.write_bytes(content[: int(len(content) * share)])
        assert [found.code for found in verify_record(path)] == [code]
        with pytest.raises(RecordFormatError, match=r"^run\.h5"):
            read_record(path)
    path.unlink()
    assert "No such file" in verify_record(path)[0].problem
    with pytest.raises(
        RecordFormatError, match="have the format orthoflow-run, got 'orthoflow-product'"
    ):
        read_record(next(iter(shelf.files.values())))


def _order_links(file: h5py.File) -> None:
    properties = h5py.h5p.create(h5py.h5p.GROUP_CREATE)
    properties.set_link_creation_order(h5py.h5p.CRT_ORDER_TRACKED)
    h5py.h5g.create(file.id, b"new", gcpl=properties)
    for name in file["files"]:
        file.copy(f"files/{name}", file["new"])
    del file["files"]
    file.move("new", "files")


def _change_objects(file: h5py.File) -> set[str]:
    """Change objects that repeat the document, each in another way, and name their places."""
    file["cells/cloud"].attrs["wall_s"] = 0.5
    file["cells/ortho"].attrs["note"] = 1
    del file[f"cells/{WALL}"].attrs["step"]
    file.attrs["seed"] = 7
    table = file["metrics"][()]
    table["value"][-1] += 1
    file["metrics"][...] = table
    _order_links(file)
    file["cells/cloud/notes"] = 3
    file.create_group("notes")
    file["files/x"] = np.zeros(3, "u1")
    file.create_group("products/x")
    del file["cells/cloud/log"]
    file["cells/ortho/log"][...] = b"?"
    file.copy("cells/ortho", "cells/ortho2")
    return {
        *("/", "/cells/cloud", "/cells/ortho", f"/cells/{WALL}", "/metrics", "/files"),
        *("/cells/cloud/notes", "/notes", "/files/x", "/products/x"),
        *("/cells/cloud/log", "/cells/ortho/log", "/cells/ortho2"),
    }


@pytest.mark.parametrize("is_sealed_again", [False, True])
def test_what_the_document_does_not_say_is_found_even_when_sealed(
    tmp_path: Path, *, is_sealed_again: bool
) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        changed = _change_objects(file)
        inside = {f"/cells/ortho2/{name}" for name in file["cells/ortho"]}
        if is_sealed_again:
            hostile.seal(file)
    findings = verify_record(path)
    assert {found.place for found in findings if found.code == "object"} == changed | inside
    assert ("seal" in {found.code for found in findings}) is not is_sealed_again
    places = {found.place for found in verify_record(path, with_arrays=False)}
    assert places == changed | inside
    write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        file.attrs["content_sha256"] = np.bytes_(b"0" * 64)
        hostile.seal(file)
    assert [found[:2] for found in verify_record(path)] == [("object", "/")]


def test_a_broken_seal_and_bytes_behind_the_end_are_found(tmp_path: Path) -> None:
    path, record, _ = write_sample(tmp_path)
    content = path.read_bytes()
    with h5py.File(path, "r+") as file:
        offset = file["seal"].id.get_offset()
        h5py.h5o.set_comment(file["cells"].id, b"a note")
    assert [found.code for found in verify_record(path)] == ["seal"]
    path.write_bytes(content + b"more")
    assert [found.code for found in verify_record(path)] == ["appended", "seal"]
    module.seal_file(path, offset)
    assert [found.code for found in verify_record(path)] == ["appended"]
    assert read_record(path) == record
    path.write_bytes(content)
    with h5py.File(path, "r+") as file:
        del file["seal"]
    assert "seal" in {found.code for found in verify_record(path)}


def test_arrays_that_are_not_what_their_digest_says_are_not_read(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        (product,) = file["products"].values()
        product["arrays/walls/0/mask"][3, 4] ^= 1
        hostile.seal(file)
    assert [found.code for found in verify_record(path)] == ["product"]
    refused = pytest.raises(RecordFormatError, match="the record states sha256:")
    with open_record(path) as opened, refused:
        opened.payload(WALL, "walls")


def _contradict(record: hostile.Record) -> None:
    cloud, wall, failed = record.document["cells"]
    cloud.update(wall_s=-1.0, key="f" * 64, environment="x", step="../x")
    cloud["outputs"]["cloud"].update(digest="md5:0")
    wall.update(key="", started="", error_message="")
    wall["metrics"][0].update(unit="")
    failed.update(error_message="", outputs={"..": {**wall["outputs"]["walls"], "source": ""}})
    record.document["inputs"][0]["files"][0].update(name="/home/a.laz", sha256="0")
    record.document.update(run_id="", status="ok", workflow_resolved="{'seed': 7}")
    record.name_published("../ortho.tif", "a", "A")
    record.add_figure(WALL, "Residuals")
    record.add_figure(WALL, "nul")
    record.add_figure("ortho", "depth", "text/html")


def test_records_that_contradict_themselves_are_found_even_when_sealed(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    hostile.reseal(path, _contradict)
    wall = f"/cells/{WALL}"
    assert Counter((found.code, found.place) for found in verify_record(path)) == {
        ("field", "/"): 1,
        ("field", "/@status"): 1,
        ("field", "/document"): 1,
        ("name", "/inputs/scan"): 1,
        ("field", "/inputs/scan"): 1,
        ("name", "/published"): 2,
        ("name", "/cells/cloud@step"): 1,
        ("name", f"{wall}/figures"): 2,
        ("field", "/cells/ortho/figures"): 1,
        ("name", "/cells/ortho/outputs/.."): 1,
        ("key", "/cells/cloud@key"): 1,
        ("reference", "/cells/cloud@environment"): 1,
        ("field", "/cells/cloud@wall_s"): 1,
        ("reference", "/cells/cloud/outputs/cloud"): 1,
        ("field", wall): 2,
        ("field", f"{wall}/metrics"): 1,
        ("reference", f"{wall}/inputs/cloud"): 1,
        ("field", "/cells/ortho"): 1,
    }


FIELDS: tuple[dict[str, object], ...] = (
    *({"status": "fine"}, {"repeat": True}, {"seed": "seven"}, {"params": []}, {"colour": "blue"}),
    {"log": ...},
)


@pytest.mark.parametrize(
    "wrong",
    [*FIELDS, "", "{", "[]", "[" * 50_000, '{"run_id": NaN}'],
    ids=lambda one: f"{one!s:.9}",
)
def test_a_document_of_another_form_is_found(
    tmp_path: Path, wrong: str | dict[str, object]
) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        document = json.loads(file["document"][()])
        cell = document["cells"][0] | (wrong if isinstance(wrong, dict) else {})
        document["cells"][0] = {name: one for name, one in cell.items() if one is not ...}
        hostile.rewrite(file, json.dumps(document) if isinstance(wrong, dict) else wrong)
    assert "document" in {finding.code for finding in verify_record(path)}


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


def with_photos(*contents: bytes) -> RunRecord:
    """A record of embedded files of one name, without products."""
    files = tuple(
        RecordedFile(
            name="photo.jpg", size_bytes=len(content), sha256=hashlib.sha256(content).hexdigest()
        )
        for content in contents
    )
    record = sample_record("sha256:" + "a" * 64, "sha256:" + "b" * 64)
    photos = RecordedInput(name="photos", files=files, embedded=True)
    return replace(record, cells=record.cells[2:], inputs=(photos,))


def test_embedded_files_come_back_with_their_bytes(tmp_path: Path) -> None:
    contents = (b"first photo", b"", b"first photo", bytes(range(256)) * 300)
    record, path = with_photos(*contents), tmp_path / "run.h5"
    for file, content in zip(record.inputs[0].files, contents, strict=True):
        (tmp_path / file.sha256).write_bytes(content)
    write_record(path, record, lambda _: None, input_file=tmp_path.joinpath)
    assert read_record(path) == record
    assert verify_record(path) == ()
    taken = extract_files(path, record.inputs, tmp_path / "out")
    assert tuple(file.read_bytes() for file in taken["photos"]) == contents
    assert {file.name for file in taken["photos"]} == {"photo.jpg"}
    with h5py.File(path, "r+") as opened:
        dataset = opened[f"files/{record.inputs[0].files[3].sha256}"]
        dataset[700] = dataset[700] ^ 1
        hostile.seal(opened)
    assert [finding.code for finding in verify_record(path)] == ["file"]
    with pytest.raises(RecordFormatError, match=r"has the SHA-256 .* the record states"):
        extract_files(path, record.inputs, tmp_path / "out")


def test_a_file_that_changed_or_is_gone_is_not_embedded(tmp_path: Path) -> None:
    changed, pipe = tmp_path / "photo.jpg", tmp_path / "pipe"
    changed.write_bytes(b"newer photo")
    os.mkfifo(pipe)
    for place in (pipe, tmp_path / "gone", changed, None):
        sentence = "has been changed since it was read" if place else "no file has its SHA-256"
        find = {with_photos(b"older photo").inputs[0].files[0].sha256: place}.get
        with pytest.raises(InputFileError, match=sentence):
            write_record(
                tmp_path / "run.h5", with_photos(b"older photo"), lambda _: None, input_file=find
            )
    assert not (tmp_path / "run.h5").exists()
