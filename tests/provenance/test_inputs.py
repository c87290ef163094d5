"""Input files that lie in a record: every byte comes back, and no name leads out of the folder."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from pathlib import Path

import h5py
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from orthoflow_provenance.errors import InputFileError, RecordFormatError
from orthoflow_provenance.input_files import extract_files
from orthoflow_provenance.model import PublishedFile, RecordedFile, RecordedInput, RunRecord
from orthoflow_provenance.reader import read_record
from orthoflow_provenance.seal import seal_file
from orthoflow_provenance.verify import verify_record
from orthoflow_provenance.writer import write_record

from tests.provenance_records import sample_record

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
        dataset = file["inputs/photos/content/0003"]
        dataset[700] = dataset[700] ^ 1
        del file["seal"]
        seal_file(file)
    [finding] = verify_record(path)
    assert finding.place == "/inputs/photos/content/0003"
    assert finding.problem == "does not hold the bytes of photo.jpg"
    with pytest.raises(RecordFormatError, match=r"0003 has the SHA-256 .* the record says"):
        extract_files(path, read_record(path).inputs, tmp_path / "out")


@pytest.mark.parametrize("name", ["../out.txt", "..", "/etc/passwd", "nul", "a\x1b[2Jb", "x" * 256])
def test_a_name_that_leads_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    path = write_embedded(tmp_path, CONTENTS[:1])
    inputs = (RecordedInput(name="photos", files=(recorded(name, CONTENTS[0]),), embedded=True),)
    with pytest.raises(RecordFormatError, match="so it cannot be the name of a file"):
        extract_files(path, inputs, tmp_path / "out")
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert not list(tmp_path.glob("**/out.txt"))


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
