"""Records come back as they were written, and no change of one byte stays unseen."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from orthoflow_provenance.digests import payload_digest, sha256_text
from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.model import (
    Metric,
    PublishedFile,
    RecordedCell,
    RecordedEnvironment,
    RecordedFigure,
    RecordedFile,
    RecordedInput,
    RecordedProduct,
    RunRecord,
)
from orthoflow_provenance.reader import open_record, read_record
from orthoflow_provenance.safe import safe_open
from orthoflow_provenance.seal import seal_file
from orthoflow_provenance.verify import verify_record
from orthoflow_provenance.writer import write_record

from tests.provenance_records import WORKFLOW, cloud_payload, walls_payload, write_sample

WALL = "wall@plane=hough2d,orient=pnp#2"

TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)
NAME = st.text(st.characters(categories=["L", "N", "P"], exclude_characters="/"), min_size=1).map(
    lambda text: f"n{text}"
)
NUMBER = st.floats(allow_nan=False)
SHORT = st.integers(-(2**62), 2**62)
JSON_OBJECT = st.dictionaries(
    TEXT, st.none() | st.booleans() | st.integers() | TEXT | st.lists(TEXT, max_size=3), max_size=3
)
PRODUCTS = st.dictionaries(
    NAME,
    st.builds(RecordedProduct, type_name=TEXT, encoding_version=SHORT, digest=TEXT, source=TEXT),
    max_size=3,
)
CELL = st.builds(
    RecordedCell,
    address=NAME,
    step=TEXT,
    method=TEXT,
    status=st.sampled_from(["ok", "failed", "skipped"]),
    assignment=st.dictionaries(TEXT, TEXT, max_size=3),
    repeat=SHORT,
    distribution=TEXT,
    distribution_version=TEXT,
    result_version=SHORT,
    determinism=TEXT,
    error_type=TEXT,
    error_message=TEXT,
    params=JSON_OBJECT,
    params_set=JSON_OBJECT,
    key=TEXT,
    key_preimage=TEXT,
    seed=st.none() | st.integers(),
    started=TEXT,
    ended=TEXT,
    wall_s=NUMBER,
    cpu_s=NUMBER,
    peak_rss_mib=NUMBER,
    stored_mib=st.none() | NUMBER,
    compile_s=st.none() | NUMBER,
    environment=TEXT,
    cached_from=TEXT,
    metrics=st.lists(
        st.builds(Metric, name=TEXT, value=NUMBER, unit=TEXT, words=TEXT, good=TEXT), max_size=3
    ).map(tuple),
    figures=st.lists(
        st.builds(
            RecordedFigure, name=TEXT, caption=TEXT, media_type=TEXT, data=st.binary(max_size=20)
        ),
        max_size=3,
    ).map(tuple),
    warnings=st.lists(TEXT, max_size=3).map(tuple),
    citations=st.lists(TEXT, max_size=3).map(tuple),
    log=TEXT,
    inputs=PRODUCTS,
    outputs=PRODUCTS,
)
RECORD = st.builds(
    RunRecord,
    run_id=TEXT,
    name=TEXT,
    created_by=TEXT,
    status=st.sampled_from(["ok", "failed"]),
    started=TEXT,
    ended=TEXT,
    seed=st.integers(),
    workflow_source=TEXT,
    workflow_resolved=TEXT,
    overrides=st.lists(TEXT, max_size=3).map(tuple),
    inputs=st.lists(
        st.builds(
            RecordedInput,
            name=NAME,
            files=st.lists(
                st.builds(
                    RecordedFile,
                    name=TEXT.map(lambda text: text.replace("/", "")),
                    size_bytes=SHORT,
                    sha256=TEXT,
                ),
                max_size=3,
            ).map(tuple),
        ),
        max_size=3,
        unique_by=lambda entry: entry.name,
    ).map(tuple),
    environments=st.lists(
        st.builds(
            RecordedEnvironment,
            id=NAME,
            python=TEXT,
            os=TEXT,
            cpu=TEXT,
            cores=SHORT,
            threads=SHORT,
            git_commit=TEXT,
            packages=st.dictionaries(TEXT, TEXT, max_size=3),
        ),
        max_size=2,
        unique_by=lambda entry: entry.id,
    ).map(tuple),
    cells=st.lists(CELL, max_size=3, unique_by=lambda cell: cell.address).map(tuple),
    published=st.lists(
        st.builds(PublishedFile, path=TEXT, size_bytes=SHORT, sha256=TEXT), max_size=3
    ).map(tuple),
)


@settings(max_examples=25)
@given(RECORD)
def test_any_record_comes_back_as_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, record: RunRecord
) -> None:
    path = tmp_path_factory.mktemp("record") / "run.h5"
    write_record(path, record, lambda _: None, keep_folders=True)
    read = read_record(path)
    assert read == record
    for cell, written in zip(read.cells, record.cells, strict=True):
        assert list(cell.assignment) == list(written.assignment)


def test_the_sample_record_is_whole(tmp_path: Path) -> None:
    path, record, _ = write_sample(tmp_path)
    assert read_record(path) == record
    assert verify_record(path) == ()
    assert sorted(entry.name for entry in tmp_path.glob("*run*")) == ["run.h5"]
    timed: list[str] = []

    def look(name: str, entry: h5py.Group | h5py.Dataset) -> None:
        if entry.id.get_create_plist().get_obj_track_times():
            timed.append(name)

    # When it was written is no part of a record.
    with safe_open(path) as file:
        file.visititems(look)
    assert timed == []


def test_equal_runs_give_equal_files(tmp_path: Path) -> None:
    path, record, shelf = write_sample(tmp_path)
    seal = write_record(tmp_path / "again.h5", record, shelf.find)
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()
    with safe_open(path) as file:
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
    path, record, _ = write_sample(tmp_path)
    before = path.read_bytes()
    with pytest.raises(RecordFormatError, match="is not in the store any more: run the workflow"):
        write_record(path, record, lambda _: None)
    assert path.read_bytes() == before
    assert sorted(tmp_path.glob(".*")) == []


def test_a_product_file_that_holds_another_product_is_not_embedded(tmp_path: Path) -> None:
    path, record, shelf = write_sample(tmp_path)
    other = shelf.put(cloud_payload(5))
    with pytest.raises(RecordFormatError, match=r"product-2\.h5 must hold the product sha256:"):
        write_record(path, record, lambda _: shelf.find(other))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda record: dataclasses.replace(record, cells=record.cells[:1] * 2),
            "the cell 'cloud' is given twice",
        ),
        (
            lambda record: dataclasses.replace(
                record, cells=(dataclasses.replace(record.cells[0], address="a/b"),)
            ),
            "the cell 'a/b' cannot be a name in a record",
        ),
        (
            lambda record: dataclasses.replace(
                record,
                inputs=(
                    RecordedInput(
                        name="scan",
                        files=(RecordedFile(name="/home/jane/a.laz", size_bytes=1, sha256=""),),
                    ),
                ),
            ),
            "'/home/jane/a.laz' of the input scan must be named without its folder",
        ),
    ],
)
def test_impossible_records_are_refused(
    tmp_path: Path, change: Callable[[RunRecord], RunRecord], message: str
) -> None:
    _, record, shelf = write_sample(tmp_path)
    with pytest.raises(RecordFormatError, match=message):
        write_record(tmp_path / "other.h5", change(record), shelf.find)
    assert not (tmp_path / "other.h5").exists()


def test_text_is_kept_but_for_what_hdf5_cannot_hold(tmp_path: Path) -> None:
    _, record, shelf = write_sample(tmp_path)
    cell = dataclasses.replace(record.cells[0], log="a\0b\r\n\ud800c\0")
    path = tmp_path / "run.h5"
    write_record(path, dataclasses.replace(record, cells=(cell,)), shelf.find)
    assert read_record(path).cells[0].log == "ab\r\n?c"


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


def test_columns_of_a_later_version_are_written_where_they_say_something(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        cells = file["cells"]
        titles = {name: cells[name]["metrics"].dtype.names for name in cells}
        said = [name for name, found in titles.items() if found != ("name", "value", "unit")]
        assert [titles[name] for name in said] == [("name", "value", "unit", "words", "good")]
        table = cells[said[0]]["metrics"][()]
        _replace(cells[said[0]], "metrics", table[["name", "value", "unit"]].copy())
    found = {cell.address: cell for cell in read_record(path).cells}[said[0]].metrics
    assert [(one.name, one.words, one.good) for one in found] == [
        ("rms_mm", "", ""),
        ("cells", "", ""),
    ]


def test_a_newer_format_is_refused_with_a_sentence(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = np.bytes_(b"2.0")
    message = r"run\.h5 has format version 2\.0, this program reads version 1\.4: use a newer"
    with pytest.raises(RecordFormatError, match=message):
        read_record(path)
    (finding,) = verify_record(path)
    assert "use a newer orthoflow" in finding.problem


def test_a_newer_minor_version_with_more_in_it_is_read(tmp_path: Path) -> None:
    path, record, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = np.bytes_(b"1.7")
        file["cells/cloud"].attrs["colour"] = np.bytes_(b"blue")
        file["cells/cloud"]["more"] = np.arange(3)
        _seal_again(file)
    assert read_record(path) == record
    assert verify_record(path) == ()


def test_a_file_of_another_kind_is_no_record(tmp_path: Path) -> None:
    _, _, shelf = write_sample(tmp_path)
    (product,) = [shelf.files[digest] for digest in list(shelf.files)[:1]]
    with pytest.raises(
        RecordFormatError, match="must be of format orthoflow-run, got 'orthoflow-p"
    ):
        read_record(product)


def test_a_missing_file_is_a_finding_and_an_error_of_the_operating_system(tmp_path: Path) -> None:
    (finding,) = verify_record(tmp_path / "run.h5")
    assert "No such file" in finding.problem
    with pytest.raises(FileNotFoundError):
        read_record(tmp_path / "run.h5")


# --- one byte -------------------------------------------------------------------------------------


def stored_spans(path: Path) -> Iterator[tuple[str, int, int]]:
    """Give (path of the dataset, first byte, number of bytes) of all raw data in the file."""
    found: list[tuple[str, int, int]] = []

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        if item.chunks is None:
            if item.id.get_offset() is not None:
                found.append((f"/{name}", item.id.get_offset(), item.id.get_storage_size()))
            return
        for index in range(item.id.get_num_chunks()):
            chunk = item.id.get_chunk_info(index)
            found.append((f"/{name}", chunk.byte_offset, chunk.size))

    with h5py.File(path) as file:
        file.visititems(visit)
    yield from found


def test_one_flipped_byte_in_any_dataset_is_found(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path, embed=True)
    content = path.read_bytes()
    spans = list(stored_spans(path))
    assert {"/workflow/source", "/seal", f"/cells/{WALL}/metrics"} <= {span[0] for span in spans}
    assert f"/cells/{WALL}/out/walls/arrays/walls/0/depth_m" in {span[0] for span in spans}
    for place, start, length in spans:
        for offset in {start + length // 2, start + length - 1 if length > 200 else start}:
            flipped = bytearray(content)
            flipped[offset] ^= 0x01
            path.write_bytes(flipped)
            findings = verify_record(path)
            assert findings, f"byte {offset - start} of {place}"
            if place != "/seal":
                assert any(finding.place.startswith(place) for finding in findings), findings


def test_a_flipped_byte_is_named_by_what_it_breaks(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    content = path.read_bytes()
    cases = {
        b"# caf": ("/workflow/source", "the workflow's text has the SHA-256"),
        b'{"id":"raster.grid"': (
            f"/cells/{WALL}@key",
            "the key is not the SHA-256 of its preimage",
        ),
        b"rms_mm": (f"/cells/{WALL}/metrics", "changed after the record was sealed"),
    }
    for text, (place, problem) in cases.items():
        assert content.count(text) == 1
        flipped = bytearray(content)
        flipped[content.index(text) + 2] ^= 0x01
        path.write_bytes(flipped)
        assert any(
            finding.place == place and problem in finding.problem for finding in verify_record(path)
        )


def test_any_byte_of_the_file_may_flip_without_an_exception(tmp_path: Path) -> None:
    path, record, _ = write_sample(tmp_path, embed=True)
    content = path.read_bytes()
    rng = np.random.default_rng(11)
    for offset in rng.integers(0, len(content), 50):
        flipped = bytearray(content)
        flipped[offset] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        # No finding means that nothing in the record depends on the byte: padding, free space.
        if verify_record(path) == ():
            with open_record(path) as opened:
                assert opened.payload(WALL, "walls").digest == payload_digest(walls_payload())
                assert opened.record.workflow_source == record.workflow_source


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.999])
def test_a_truncated_record_is_a_finding(tmp_path: Path, share: float) -> None:
    path, _, _ = write_sample(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    (finding,) = verify_record(path)
    assert finding.problem.startswith("run.h5")
    with pytest.raises(RecordFormatError, match=r"^run\.h5"):
        read_record(path)


# --- changes made with a program ------------------------------------------------------------------


def _set_attribute(place: str, name: str, value: object) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[place].attrs[name] = value

    return change


def _change_metric(value: float) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        table = file[f"cells/{WALL}/metrics"][()]
        table["value"][0] = value
        file[f"cells/{WALL}/metrics"][...] = table

    return change


def _delete(place: str) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file[place]

    return change


def _change_array(file: h5py.File) -> None:
    file[f"cells/{WALL}/out/walls/arrays/walls/0/mask"][3, 4] ^= 1


def _change_workflow(file: h5py.File) -> None:
    text = WORKFLOW.replace("seed: 7", "seed: 8")
    file["workflow/source"][()] = np.bytes_(text.encode())


def _add_cell(file: h5py.File) -> None:
    file.copy("cells/ortho", "cells/ortho2")


CHANGES = {
    "attribute of a cell": (
        _set_attribute("cells/cloud", "wall_s", 0.5),
        "/cells/cloud",
        "changed after the record was sealed",
    ),
    "attribute of the file": (
        _set_attribute("/", "created_by", np.bytes_(b"other")),
        "/",
        "changed after the record was sealed",
    ),
    "attribute added": (
        _set_attribute("cells/cloud", "note", 1),
        "/cells/cloud",
        "changed after the record was sealed",
    ),
    "metric": (_change_metric(1.26), f"/cells/{WALL}/metrics", "changed after"),
    "array": (
        _change_array,
        f"/cells/{WALL}/out/walls/arrays/walls/0/mask",
        "changed after the record was sealed",
    ),
    "workflow": (_change_workflow, "/workflow/source", "the workflow's text has the SHA-256"),
    "log deleted": (_delete("cells/cloud/log"), "/cells/cloud/log", "not in the file any more"),
    "cell added": (_add_cell, "/cells/ortho2", "in the file, but not sealed"),
    "seal deleted": (_delete("seal"), "/seal", "the seal is broken: / lacks the dataset seal"),
    "content digest": (
        _set_attribute("/", "content_sha256", np.bytes_(b"0" * 64)),
        "/@content_sha256",
        "the content digest is 0000",
    ),
}


@pytest.mark.parametrize(("change", "place", "problem"), CHANGES.values(), ids=CHANGES)
def test_changes_after_sealing_are_found(
    tmp_path: Path, change: Callable[[h5py.File], None], place: str, problem: str
) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        change(file)
    findings = verify_record(path)
    assert any(found.place == place and problem in found.problem for found in findings), findings


def _seal_again(file: h5py.File) -> None:
    del file["seal"]
    del file.attrs["content_sha256"]
    seal_file(file)


@pytest.mark.parametrize("is_sealed_again", [False, True], ids=["as it was sealed", "sealed again"])
def test_arrays_that_are_not_what_their_digest_says_are_not_read(
    tmp_path: Path, *, is_sealed_again: bool
) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        _change_array(file)
        if is_sealed_again:
            _seal_again(file)
    with (
        open_record(path) as opened,
        pytest.raises(RecordFormatError, match=r"out/walls has the digest .* record says sha256:"),
    ):
        opened.payload(WALL, "walls")


SEALED_CHANGES = {
    "array and seal": (
        _change_array,
        f"/cells/{WALL}/out/walls",
        "has the digest sha256:.*, the record says sha256:",
    ),
    "infinite metric": (
        _change_metric(math.inf),
        f"/cells/{WALL}/metrics",
        "the metric 'rms_mm' must be a finite number with a unit, got inf 'mm'",
    ),
    "NaN time": (_set_attribute("cells/cloud", "wall_s", math.nan), "/cells/cloud@wall_s", "nan"),
    "key": (
        _set_attribute("cells/cloud", "key", np.bytes_(b"f" * 64)),
        "/cells/cloud@key",
        "the key is not the SHA-256 of its preimage",
    ),
    "no key": (
        _set_attribute("cells/cloud", "key", np.bytes_(b"")),
        "/cells/cloud",
        r"key must not be empty \(ok cell\)",
    ),
    "environment": (
        _set_attribute("cells/cloud", "environment", np.bytes_(b"x")),
        "/cells/cloud@environment",
        "there is no environment x",
    ),
    "status of the run": (
        _set_attribute("/", "status", np.bytes_(b"ok")),
        "/@status",
        "the run is ok, which does not fit the status of its cells",
    ),
    "impossible status": (
        _set_attribute("cells/cloud", "status", np.bytes_(b"fine")),
        "/",
        "/cells/cloud@status must be ok, failed or skipped, got 'fine'",
    ),
    "no run id": (
        _set_attribute("/", "run_id", np.bytes_(b"")),
        "/",
        "run_id must not be empty",
    ),
    "seed": (
        _set_attribute("/", "seed", np.bytes_(b"seven")),
        "/",
        "/@seed must be a whole number in decimal digits, got 'seven'",
    ),
    "type of an attribute": (
        _set_attribute("cells/cloud", "repeat", np.bytes_(b"0")),
        "/",
        "/cells/cloud@repeat must be a whole number, got bytes",
    ),
    "input differs from its source": (
        _set_attribute(f"cells/{WALL}/in/cloud", "digest", np.bytes_(b"sha256:" + b"0" * 64)),
        f"/cells/{WALL}/in/cloud",
        "but its source cloud.cloud gave sha256:",
    ),
    "digest": (
        _set_attribute("cells/cloud/out/cloud", "digest", np.bytes_(b"md5:0")),
        "/cells/cloud/out/cloud",
        "'md5:0' is no SHA-256 digest",
    ),
    "log": (_delete("cells/cloud/log"), "/", "/cells/cloud lacks the dataset log"),
    "attribute": (
        lambda file: file["cells/cloud"].attrs.__delitem__("method"),
        "/",
        "/cells/cloud lacks the attribute method",
    ),
    "metadata": (
        _delete(f"cells/{WALL}/out/walls/metadata"),
        f"/cells/{WALL}/out/walls",
        "lacks the dataset metadata",
    ),
    "resolved workflow": (
        lambda file: _replace_text(file["workflow"], "resolved", "{'seed': 7}"),
        "/workflow/resolved",
        "/workflow/resolved must hold JSON",
    ),
    "parameters": (
        lambda file: _replace_text(file["cells/cloud"], "params", "[NaN]"),
        "/",
        "/cells/cloud/params must hold JSON: NaN is no JSON",
    ),
    "parameters that are a list": (
        lambda file: _replace_text(file["cells/cloud"], "params", "[]"),
        "/",
        "/cells/cloud/params must hold a JSON object",
    ),
    "text that is not UTF-8": (
        lambda file: _replace_text(file["cells/cloud"], "log", b"\xff"),
        "/",
        "/cells/cloud/log must be UTF-8 text",
    ),
    "table without a column": (
        lambda file: _replace(file["cells/cloud"], "metrics", np.zeros(1, [("name", "S1")])),
        "/",
        "/cells/cloud/metrics lacks the column value",
    ),
    "table with a wrong column": (
        lambda file: _replace(
            file["cells/cloud"],
            "metrics",
            np.zeros(1, [("name", "S1"), ("value", "S1"), ("unit", "S1")]),
        ),
        "/",
        "/cells/cloud/metrics:value must hold float values",
    ),
    "no table": (
        lambda file: _replace(file["cells/cloud"], "metrics", np.zeros(3)),
        "/",
        "/cells/cloud/metrics must be a table with one row per entry",
    ),
    "number for text": (
        lambda file: _replace(file["cells/cloud"], "log", np.zeros(3)),
        "/",
        "/cells/cloud/log must be one text, got float64",
    ),
    "folder of an input file": (
        lambda file: _replace(
            file["inputs/scan"],
            "files",
            np.array(
                [(b"/home/a.laz", 3, b"0" * 64)],
                [("name", "S20"), ("size_bytes", "i8"), ("sha256", "S64")],
            ),
        ),
        "/inputs/scan",
        "'/home/a.laz' holds / or a backslash",
    ),
}


def _replace(group: h5py.Group, name: str, value: np.ndarray) -> None:
    del group[name]
    group[name] = value


def _replace_text(group: h5py.Group, name: str, text: str | bytes) -> None:
    data = text if isinstance(text, bytes) else text.encode()
    _replace(group, name, np.array(data, dtype=h5py.string_dtype("utf-8", len(data))))


@pytest.mark.parametrize(
    ("change", "place", "problem"), SEALED_CHANGES.values(), ids=SEALED_CHANGES
)
def test_records_that_contradict_themselves_are_found_even_when_sealed(
    tmp_path: Path, change: Callable[[h5py.File], None], place: str, problem: str
) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        change(file)
        _seal_again(file)
    findings = verify_record(path)
    fitting = [found for found in findings if re.search(problem, found.problem)]
    assert place in {found.place for found in fitting}, findings


def test_notes_lie_outside_the_seal(tmp_path: Path) -> None:
    path, record, _ = write_sample(tmp_path)
    with h5py.File(path, "r+") as file:
        file["notes/first"] = "the scan of the court yard was repeated in May"
    assert verify_record(path) == ()
    assert read_record(path) == record


def test_repacking_does_not_break_the_seal(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    name = f"cells/{WALL}/out/walls/arrays/walls/0/mask"
    with h5py.File(path, "r+") as file:
        values = file[name][()]
        del file[name]
        file.create_dataset(name, data=values)
    assert verify_record(path) == ()


def test_the_seal_is_the_one_that_the_specification_describes(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    with h5py.File(path) as file:
        lines = file["seal"][()].decode()
        sealed = {line[66:]: line[:64] for line in lines.splitlines()}
        text = file["workflow/source"][()]
        assert file.attrs["content_sha256"].decode() == sha256_text(lines)
        assert file.attrs["workflow_sha256"].decode() == sha256_text(text.decode())
    data = [f"utf8[{len(text)}]", [], sha256_text(text.decode())]
    content = json.dumps({"attributes": {}, "data": data}, separators=(",", ":"))
    assert sealed["/workflow/source"] == sha256_text(content)
    index = ["<i8", [], hashlib.sha256((0).to_bytes(8, "little")).hexdigest()]
    content = json.dumps({"attributes": {"index": index}}, separators=(",", ":"))
    assert sealed["/inputs/scan"] == sha256_text(content)
