"""A file from a stranger reads nothing outside itself and never becomes larger than it is."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from operator import add
from pathlib import Path

import h5py
import numpy as np
import pytest
from orthoflow_provenance.document import (
    FORMAT_VERSION,
    RUN_FORMAT,
    LockedFileError,
    RecordFormatError,
)
from orthoflow_provenance.hdf5 import read_whole, safe_open, set_attributes
from orthoflow_provenance.verify import verify_record

SECRET = np.arange(5.0)
# Of files that do not say that they are records, nothing else is said.
NAMED = {"format": RUN_FORMAT, "format_version": FORMAT_VERSION}


def external_link(file: h5py.File) -> None:
    # Asked for `b/c/a`, h5py says "hard link" unless every part of the way is looked at.
    file.create_group("b/c")["a"] = h5py.ExternalLink("secret.h5", "/")


def soft_link(file: h5py.File) -> None:
    file["numbers"] = SECRET
    file["a"] = h5py.SoftLink("/numbers")


def hard_link_cycle(file: h5py.File) -> None:
    group = file.create_group("a")
    group["b"] = group


def named_type(file: h5py.File) -> None:
    file["a"] = np.dtype("f8")


def external_storage(file: h5py.File) -> None:
    file.create_dataset("a", (5,), "f8", external=[("secret.raw", 0, h5py.h5f.UNLIMITED)])


def virtual_dataset(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((5,), "f8")
    layout[:] = h5py.VirtualSource("secret.h5", "secret", shape=(5,))
    file.create_virtual_dataset("a", layout)


def dataset_without_data(file: h5py.File) -> None:
    file.create_dataset("a", (10**12,), "f8", chunks=(1 << 20,), compression="gzip")


def gzip_twice(file: h5py.File) -> None:
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((1 << 16,))
    properties.set_deflate(9)
    properties.set_deflate(9)
    space = h5py.h5s.create_simple((1 << 16,))
    h5py.h5d.create(file.id, b"a", h5py.h5t.NATIVE_DOUBLE, space, dcpl=properties)


def other_filter(file: h5py.File) -> None:
    file.create_dataset("a", data=np.arange(4096), compression="lzf")


def text_of_variable_length(file: h5py.File) -> None:
    file["a"] = "text"


def reference(file: h5py.File) -> None:
    file.create_dataset("a", data=file.ref, dtype=h5py.ref_dtype)


def nested_compound(file: h5py.File) -> None:
    file.create_dataset("a", (2,), np.dtype([("b", np.dtype([("c", "f8")]))]))


def text_of_variable_length_in_an_attribute(file: h5py.File) -> None:
    file.create_group("b").attrs["a"] = "text"


def way_up(file: h5py.File) -> None:
    file.create_group("a")
    file.id.links.move(b"a", file.id, b"..")


FORBIDDEN: list[tuple[Callable[[h5py.File], None], str]] = [
    (external_link, ":/b/c/a is a link into another file: the file is not opened"),
    (soft_link, ":/a is a soft link; only hard links are allowed"),
    (hard_link_cycle, ":/a/b refers to an object that also has another path"),
    (named_type, ":/a is neither a group nor a dataset"),
    (external_storage, ":/a stores its data in another file"),
    (virtual_dataset, ":/a is a virtual dataset"),
    (dataset_without_data, "declares 8000000000000 bytes, but the file contains 0"),
    (gzip_twice, "must use no filters other than shuffle, gzip, fletcher32, and each at most once"),
    (
        other_filter,
        "must use no filters other than shuffle, gzip, fletcher32, and each at most once",
    ),
    (text_of_variable_length, ":/a has a type outside the format"),
    (reference, ":/a has a type outside the format"),
    (nested_compound, ":/a has a type outside the format"),
    (text_of_variable_length_in_an_attribute, ":/b@a has a type outside the format"),
    (way_up, ":/.. is not a valid path in a record: the object '..' cannot be a name"),
]


@pytest.mark.parametrize(
    ("make", "message"), [pytest.param(*case, id=case[0].__name__) for case in FORBIDDEN]
)
def test_forbidden_files_are_refused_with_a_sentence(
    tmp_path: Path, make: Callable[[h5py.File], None], message: str
) -> None:
    with h5py.File(tmp_path / "secret.h5", "w") as secret:
        secret["secret"] = SECRET
    SECRET.tofile(tmp_path / "secret.raw")
    path = tmp_path / "stranger.h5"
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        make(file)
        set_attributes(file, **NAMED)
    with pytest.raises(RecordFormatError) as refusal, safe_open(path, RUN_FORMAT):
        pass
    assert str(refusal.value).startswith("stranger.h5")
    assert message in str(refusal.value)
    (finding,) = verify_record(path)
    assert finding.problem == str(refusal.value)


def test_well_packed_data_of_any_size_is_allowed(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "a", data=np.zeros(80 << 20, dtype=np.uint8), chunks=(1 << 20,), compression=9
        )
        set_attributes(file, **NAMED)
        assert file["a"].nbytes > 500 * file["a"].id.get_storage_size()
    with safe_open(path, RUN_FORMAT) as file:
        assert file["a"].shape == (80 << 20,)


def test_more_objects_than_any_record_has_are_refused_in_all_that_was_not_checked_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with h5py.File(path := tmp_path / "a.h5", "w") as file:
        for index in range(10):
            file.create_group(str(index)).attrs["a"] = index
        set_attributes(file, **NAMED)

    def check(objects_most: int) -> None:
        monkeypatch.setattr("orthoflow_provenance.hdf5.MAX_OBJECTS", objects_most)
        with safe_open(path, RUN_FORMAT):
            pass

    refused = "the limit of 22 groups, datasets and"
    check(23)
    with pytest.raises(RecordFormatError, match=refused):
        check(22)  # it could have changed within a tick of the clock
    monkeypatch.setattr("time.time_ns", partial(add, 10**11, time.time_ns()))
    check(23)
    check(22)
    path.touch()
    with pytest.raises(RecordFormatError, match=refused):
        check(22)


def test_tables_and_texts_that_unpack_to_much_are_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    rows = np.zeros(5 << 20, dtype=[("text", "S1")])
    with h5py.File(path, "w") as file:
        file.create_dataset("packed", data=rows, chunks=(1 << 20,), compression=9)
        file.create_dataset("plain", data=rows[:1000], chunks=(1000,), compression=9)
        set_attributes(file, **NAMED)
    with safe_open(path, RUN_FORMAT) as file:
        with pytest.raises(
            RecordFormatError, match=r"/packed has 5242880 bytes when decompressed: strings, ta"
        ):
            read_whole(file["packed"])
        assert np.shape(read_whole(file["plain"])) == (1000,)


MIB = 1 << 20


def groups(file: h5py.File, over: int) -> None:
    file.create_group("/".join("g" * (32 + over)))


def attribute(file: h5py.File, over: int) -> None:
    file.attrs["a"] = np.zeros(MIB + over, np.uint8)


def chunk(file: h5py.File, over: int) -> None:
    chunks = (64 * MIB + over,)
    file.create_dataset("a", data=np.zeros(1, "u1"), maxshape=(None,), chunks=chunks, compression=1)


@pytest.mark.parametrize("make", [groups, attribute, chunk])
def test_a_file_is_refused_from_just_beyond_each_limit_on(
    tmp_path: Path, make: Callable[[h5py.File, int], None]
) -> None:
    path = tmp_path / "a.h5"
    for over in (0, 1):
        with h5py.File(path, "w", libver=("v110", "v110")) as file:
            make(file, over)
            set_attributes(file, **NAMED)
        if over:
            with pytest.raises(RecordFormatError), safe_open(path, RUN_FORMAT):
                pass
        else:
            with safe_open(path, RUN_FORMAT):
                pass


def test_a_file_open_for_writing_or_left_so_is_locked_and_not_damaged(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        file["a"] = 1
        for state in ("open", "left"):
            if state == "left":
                content = path.read_bytes()
            with (
                pytest.raises(LockedFileError, match=r"h5clear -s run\.h5"),
                safe_open(path, RUN_FORMAT),
            ):
                pass
            file.flush()
    path.write_bytes(content)
    (finding,) = verify_record(path)
    assert finding.code == "locked"
