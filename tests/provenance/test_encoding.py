"""Texts, attributes and tables in HDF5: what was written comes back, all else is a sentence."""

from __future__ import annotations

import math
from collections.abc import Iterator

import h5py
import numpy as np
import pytest
from orthoflow_provenance import encoding
from orthoflow_provenance.errors import RecordFormatError

COLUMNS = (("name", str), ("n", int), ("share", float))


@pytest.fixture
def file() -> Iterator[h5py.File]:
    with h5py.File("memory", "w", driver="core", backing_store=False) as opened:
        yield opened


@pytest.mark.parametrize("text", ["", "a", "zwei\nZeilen", "Fläche \N{GREEK SMALL LETTER OMEGA}"])
def test_texts_come_back(file: h5py.File, text: str) -> None:
    encoding.write_text(file, "text", text)
    assert encoding.read_text(file, "text") == text
    encoding.write_texts(file, "texts", ["x", text])
    assert encoding.read_texts(file, "texts") == ("x", text)
    encoding.set_attributes(file, {"text": text})
    assert encoding.text_attribute(file, "text") == text


def test_what_hdf5_text_cannot_hold_is_left_out_or_replaced(file: h5py.File) -> None:
    assert encoding.storable_text("a\0b\ud800c") == "ab?c"
    encoding.write_text(file, "text", "a\0b\ud800c")
    assert encoding.read_text(file, "text") == "ab?c"


@pytest.mark.parametrize("rows", [[], [("a", 1, 0.5)], [("", -3, 1e300), ("größer", 1 << 40, 2.0)]])
def test_tables_come_back_row_by_row(
    file: h5py.File, rows: list[tuple[encoding.Cell, ...]]
) -> None:
    encoding.write_table(file, "table", COLUMNS, rows)
    found = encoding.read_table(file, "table", COLUMNS)
    assert found == rows
    assert [tuple(map(type, row)) for row in found] == [(str, int, float)] * len(rows)
    assert encoding.column_titles(file, "table") == {"name", "n", "share"}
    # Columns that a reader does not know are passed over, in whatever order it asks for others.
    asked = (("share", float), ("name", str))
    assert encoding.read_table(file, "table", asked) == [(row[2], row[0]) for row in rows]


def test_what_is_no_such_table_is_refused(file: h5py.File) -> None:
    encoding.write_table(file, "table", COLUMNS, [("a", 1, 0.5)])
    file["numbers"] = np.arange(3)
    file["square"] = np.zeros((2, 2), dtype=[("n", "<i8")])
    file["one"] = np.zeros((), dtype=[("n", "<i8")])
    assert encoding.column_titles(file, "numbers") == frozenset()
    for name in ("numbers", "square", "one"):
        with pytest.raises(RecordFormatError, match=f"//?{name} must be a table with one row per"):
            encoding.read_table(file, name, (("n", int),))
    with pytest.raises(RecordFormatError, match="lacks the column more"):
        encoding.read_table(file, "table", (("more", int),))
    for title, kind in (("name", int), ("n", float), ("share", int), ("n", str)):
        with pytest.raises(RecordFormatError, match=f":{title} must hold {kind.__name__} values"):
            encoding.read_table(file, "table", ((title, kind),))
    with pytest.raises(RecordFormatError, match=r"^/ lacks the dataset nothing$"):
        encoding.read_table(file, "nothing", COLUMNS)
    file.create_group("group")
    with pytest.raises(RecordFormatError, match=r"^/ lacks the dataset group$"):
        encoding.read_text(file, "group")


def test_attributes_are_of_the_kind_that_is_asked_for(file: h5py.File) -> None:
    encoding.set_attributes(file, {"text": "a", "whole": 1 << 40, "real": 0.5, "yes": True})
    assert encoding.int_attribute(file, "whole") == 1 << 40
    assert encoding.float_attribute(file, "real") == 0.5
    assert encoding.float_attribute(file, "whole") == float(1 << 40)
    assert encoding.int_attribute(file, "yes") == 1
    for name in ("whole", "real"):
        with pytest.raises(RecordFormatError, match=f"/@{name} must be text, got"):
            encoding.text_attribute(file, name)
    for name in ("text", "real"):
        with pytest.raises(RecordFormatError, match=f"/@{name} must be a whole number, got"):
            encoding.int_attribute(file, name)
    with pytest.raises(RecordFormatError, match=r"/@text must be a number, got bytes"):
        encoding.float_attribute(file, "text")
    encoding.set_attributes(file, {"nothing": math.nan})
    with pytest.raises(RecordFormatError, match=r"a whole number, got NaN$"):
        encoding.int_attribute(file, "nothing")
    assert encoding.has_attribute(file, "text")
    assert not encoding.has_attribute(file, "other")
    for read in (encoding.text_attribute, encoding.int_attribute, encoding.float_attribute):
        with pytest.raises(RecordFormatError, match=r"^/ lacks the attribute other$"):
            read(file, "other")


def test_bytes_that_are_no_utf_8_are_refused(file: h5py.File) -> None:
    file["raw"] = np.array(b"\xff\xfe", dtype="S2")
    file.attrs["raw"] = np.array(b"\xff\xfe", dtype="S2")
    with pytest.raises(RecordFormatError, match="/raw must be UTF-8 text"):
        encoding.read_text(file, "raw")
    with pytest.raises(RecordFormatError, match="@raw must be UTF-8 text"):
        encoding.text_attribute(file, "raw")
    file["numbers"] = np.arange(3)
    with pytest.raises(RecordFormatError, match="/numbers must be one text, got int64"):
        encoding.read_text(file, "numbers")


@pytest.mark.parametrize(
    "text", ["", "{", "NaN", "[1, Infinity]", "-Infinity", "[" * 100_000 + "]" * 100_000]
)
def test_what_is_no_json_is_refused(text: str) -> None:
    with pytest.raises(RecordFormatError, match=r"^here must hold JSON: "):
        encoding.parse_json(text, "here")


def test_an_object_is_asked_for(file: h5py.File) -> None:
    assert encoding.parse_json('[1, null, "a"]', "here") == [1, None, "a"]
    for name, text in (("good", '{"a": [1.5]}'), ("list", "[1]")):
        encoding.write_text(file, name, text)
    assert encoding.read_json(file, "good") == {"a": [1.5]}
    with pytest.raises(RecordFormatError, match=r"/list must hold a JSON object$"):
        encoding.read_json(file, "list")


@pytest.mark.parametrize(("more", "is_packed", "fails"), [(0, True, False), (1, True, True)])
@pytest.mark.parametrize("names", [1, 2])
def test_what_is_read_at_once_is_not_packed(
    file: h5py.File, names: int, *, more: int, is_packed: bool, fails: bool
) -> None:
    for k in range(names):
        packed = {"compression": "gzip"} if is_packed else {}
        shape = ((4 << 20) + more,)
        file.create_dataset(f"data{k}", shape=shape, dtype="u1", chunks=(1 << 20,), **packed)
    dataset = file["data0"]
    dataset[:10] = 7
    if fails:
        with pytest.raises(RecordFormatError, match="must not be packed"):
            encoding.read_whole(dataset)
        return
    found = encoding.read_whole(dataset)
    assert isinstance(found, np.ndarray)
    assert found.sum() == 70


def test_what_is_as_large_in_the_file_is_read_whatever_its_size(file: h5py.File) -> None:
    file["data"] = np.ones((4 << 20) + 1, dtype=np.uint8)
    found = encoding.read_whole(file["data"])
    assert isinstance(found, np.ndarray)
    assert found.size == (4 << 20) + 1


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a\nb", "a\x7f", "\u2028"])
def test_names_that_are_no_link_are_refused(name: str) -> None:
    with pytest.raises(RecordFormatError, match=r"^the port .* cannot be a name in a record"):
        encoding.check_name(name, "the port")


@pytest.mark.parametrize("name", ["a", "...", "a b", "ö", ".a"])
def test_other_names_are_given_back(name: str) -> None:
    assert encoding.check_name(name, "the port") == name


@pytest.mark.parametrize("error", encoding.HDF5_ERRORS)
def test_errors_of_the_library_become_a_sentence(error: type[Exception]) -> None:
    with (
        pytest.raises(RecordFormatError, match=r"^a place cannot be read, .*: bad thing$"),
        encoding.reading("a place"),
    ):
        raise error("bad\n thing") if error is not KeyError else ValueError("bad thing")
    with pytest.raises(RecordFormatError, match=f": {error.__name__}$"), encoding.reading("it"):
        raise error
    own = RecordFormatError("as it is")
    with pytest.raises(RecordFormatError) as caught, encoding.reading("it"):
        raise own
    assert caught.value is own
