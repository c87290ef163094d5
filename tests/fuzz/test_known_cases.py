"""Small files that once took minutes, gigabytes or a traceback: each is refused, or read, at once.

Each is built here, or lies in `corpus/<target>/`.
"""

from __future__ import annotations

import json
import re
import shutil
import struct
import tempfile
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from orthoflow.errors import InputError, OrthoflowError
from orthoflow.files.images import encode_png
from orthoflow.files.sidecars import frame_json
from tests import scan_files
from tests.fuzz import readers
from tests.fuzz.harness import MAX_CPU_S, Target
from tests.fuzz.mutation import LogicalE57, e57_of, logical_of

_CORPUS: Final = Path(__file__).parent / "corpus"
_STEPS: Final = "orthoflow: 1\nsteps:\n  room: {use: simulate.room}\n"
_RANSAC: Final = "{use: plane.ransac, in: {cloud: room.cloud}, repeat: "
_REPEATED: Final = "v1: {use: plane.ransac, repeat: 9999}"
_LENS: Final = "{width: 64, height: 48, fx: 60, fy: 60, cx: 31.5, cy: 23.5}"


def _variants(n_steps: int, n_variants: int) -> str:
    """A comparison of detectors whose planes all go into one raster."""
    calls = "".join(f"      v{j}: {{use: plane.hough2d}}\n" for j in range(n_variants))
    steps = [
        f"  p{i}:\n    in: {{cloud: room.cloud}}\n    variants:\n{calls}" for i in range(n_steps)
    ]
    planes = ", ".join(f"p{i}.planes" for i in range(n_steps))
    wall = f"  wall: {{use: raster.grid, in: {{cloud: room.cloud, planes: [{planes}]}}}}\n"
    return _STEPS + "".join(steps) + wall + "compare: {design: product}\n"


def _sidecar(**changed: object) -> bytes:
    return json.dumps({**frame_json(readers.wall_frame()), **changed}).encode()


def _sound_e57(folder: Path) -> bytes:
    fields = scan_files.cartesian(np.arange(12.0).reshape(4, 3))
    return scan_files.write_e57(folder / "a.e57", [{"fields": fields}]).read_bytes()


def _e57(change: Callable[[LogicalE57], bytes]) -> Callable[[Path], bytes]:
    return lambda folder: change(logical_of(_sound_e57(folder)))


def _with_xml(old: bytes, new: bytes) -> Callable[[Path], bytes]:
    return _e57(lambda parts: e57_of(parts.binary, parts.xml.replace(old, new, 1)))


def _wrong_checksum(folder: Path) -> bytes:
    content = bytearray(_sound_e57(folder))
    content[1022] ^= 1
    return bytes(content)


def _large_png(folder: Path) -> bytes:
    """A PNG file of 30,000 x 30,000 black pixels, which pack to a thousandth."""
    side, packing = 30_000, zlib.compressobj(9)
    row = bytes(1 + 3 * side)
    packed = b"".join(packing.compress(row) for _ in range(100)) + packing.flush()
    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    return encode_png(np.zeros((1, 1), np.uint8))[:8] + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in ((b"IHDR", head), (b"IDAT", packed), (b"IEND", b""))
    )


def _las(change: Callable[[bytearray], None]) -> Callable[[Path], bytes]:
    def content(folder: Path) -> bytes:
        points = np.arange(120.0).reshape(40, 3)
        changed = bytearray(scan_files.write_las(folder / "a.las", points).read_bytes())
        change(changed)
        return bytes(changed)

    return content


_XYZ: Final = ("property float x", "property float y", "property float z")


def _ply(*lines: str, data: bytes = b"") -> bytes:
    head = ["ply", "format binary_little_endian 1.0", *lines, "end_header", ""]
    return "\n".join(head).encode() + data


# Name -> target in `readers`, name of the file, its content or what makes it in a folder that may
# be written to, and a pattern of the refusal.
KNOWN: Final = {
    # Workflows.
    "a billion repeats": ("WORKFLOW", "w.yaml", f"{_STEPS}  p: {_RANSAC}1000000000}}\n",
        "input should be less than or equal to 10000, got 1000000000"),
    "cells by the million": ("WORKFLOW", "w.yaml", _variants(12, 10),
        "20000 step runs or more"),
    "cells by repeats": ("WORKFLOW", "w.yaml",
        _variants(2, 3).replace("v1: {use: plane.hough2d}", _REPEATED),
        "20000 step runs or more"),
    "brackets": ("WORKFLOW", "w.yaml", "orthoflow: 1\nsteps: " + "[" * 50_000,
        "nested deeper than 60 levels"),
    "aliases within aliases": ("WORKFLOW", "w.yaml",
        "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
            f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in pairwise("abcdefghij")),
        "more than 10000 values once aliases are expanded"),
    "a hundred unknown names": ("WORKFLOW", "w.yaml",
        _STEPS + "".join(f"  s{i}: {{use: plane.hugh, in: {{a: r{i}.x}}}}\n" for i in range(300)),
        "more than 100 problems; correct those above"),
    "thousands of combinations left out": ("WORKFLOW", "w.yaml",
        _variants(1, 2).replace("product}", f"product, exclude: [{'{p0: v1}, ' * 2000}]}}"),
        "should have at most 500 items"),
    "a hexadecimal seed": ("WORKFLOW", "w.yaml", f"{_STEPS}seed: 0x{'f' * 5000}",
        "is not a valid int"),
    "a seed that no record can keep": ("WORKFLOW", "w.yaml", f"{_STEPS}seed: 1{'0' * 120}",
        "input should be less than or equal to 1"),
    # Calibrations and check points.
    "40,000 cameras": ("CALIBRATION", "c.yaml",
        f"cameras:\n  a: &a {_LENS}\n" + "".join(f"  {i}: *a\n" for i in range(40_000)),
        r"has \d+ bytes, .* at most 400000|more than 20000 values"),
    "2,000 cameras": ("CALIBRATION", "c.yaml",
        "cameras:\n  a: &a {width: 1}\n" + "".join(f'  "{i}": *a\n' for i in range(2000)),
        "expected at most 1000 entries, got 2001"),
    "a merge loop": ("CALIBRATION", "c.yaml", "cameras:\n  a: &a\n    <<: *a\n    width: 1\n",
        "contains itself"),
    "100,001 check points": ("POINTS", "p.csv", "a,1,2,3\n" * 100_001,
        "more than 100000 points; split it"),
    # Sidecars.
    "deep JSON": ("SIDECAR", "wall.json", "[" * 50_000, "not valid JSON, it is nested"),
    "a number of 5,000 digits": ("SIDECAR", "wall.json", f'{{"wall": {"9" * 5000}}}',
        r"wall\.json: not valid JSON"),
    "wall: true": ("SIDECAR", "wall.json", _sidecar(wall=True), "from 0 to 32000, got True"),
    "a wall beyond 16 bits": ("SIDECAR", "wall.json", _sidecar(wall=10**30), "to 32000, got 1000"),
    # Pictures.
    "30,000 x 30,000 pixels": ("PNG", "a.png", _large_png, "a.png is too large: 30000 x"),
    "another format": ("FIGURE", "a.bmp", b"BM" + bytes(200), "BMP, which is not supported:"),
    # Scans as text.
    "a line of 60 MB": ("TEXT", "a.xyz", "1 2 3 " * 10_000_000,
        "line 1: the line has more than 10000 bytes"),
    "a long line later": ("TEXT", "a.xyz", "1 2 3\n" * 25_000 + "1 " * 10_000_000,
        "line 25001: the line has more than 10000 bytes"),
    "a long line in a PTX file": ("PTX", "a.ptx", "1" * 60_000_000,
        "line 1: expected the ten header lines"),
    # Scans with headers.
    "PLY of a billion points": ("PLY", "a.ply", _ply("element vertex 1000000000", *_XYZ),
        r"declares 1000000000 points, but its \d+ bytes"),
    "PLY that steps back for ever": ("PLY", "a.ply",
        _ply("element face 4000000000", "property list char char vertex_indices",
             "element vertex 1", *_XYZ, data=b"\xff" * 12),
        "its data contains 12 bytes, but its header declares 4000000003 values"),
    "PLY with a property of brackets": ("PLY", "p.ply",
        _ply("element vertex 2", f"property float {'[' * 50_000}", *_XYZ[1:]), ""),
    "PLY with a negative count": ("PLY", "a.ply",
        _ply("element face -5", "element vertex 1", *_XYZ, data=bytes(12)),
        "element face has -5 entries"),
    "PLY of 60,000 properties": ("PLY", "a.ply",
        _ply("element vertex 1", *_XYZ, *["property int a"] * 60_000),
        "element vertex has more than 1000 properties"),
    "PCD whose rows are wider than it has points": ("PCD", "a.pcd",
        ("FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 18446744073709551616\nHEIGHT 5\n"
         "POINTS 1\nDATA ascii\n1 2 3\n"),
        "5 rows of 18446744073709551616 points, but 1 points"),
    "PCD of a billion fields": ("PCD", "a.pcd",
        ("VERSION 0.7\nFIELDS x y z a\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1000000000\n"
         "WIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3 4\n"),
        "a point has more than 1000 fields"),
    "LAS of a billion points": ("LAS", "a.las",
        _las(lambda raw: struct.pack_into("<Q", raw, 247, 10**9)),
        "declares 1000000000 points, but its"),
    "LAS with extended records outside": ("LAS", "a.las",
        _las(lambda raw: struct.pack_into("<QI", raw, 235, len(raw), 0xFFFFFFFF)),
        "records at its end are missing"),
    # E57.
    "E57 with a wrong checksum": ("E57", "a.e57", _wrong_checksum, "cannot be read as E57"),
    "E57 with an entity that names a file": ("E57", "a.e57",
        _with_xml(b"<e57Root",
            b'<!DOCTYPE e57Root [<!ENTITY a SYSTEM "file:///etc/passwd">]><e57Root'),
        "declares a document type or entities"),
    "E57 with 60,000 elements in a structure": ("E57", "a.e57",
        _with_xml(b"</e57Root>",
            b"".join(b'<b%d type="Integer"/>' % i for i in range(60_000)) + b"</e57Root>"),
        "elements have more than 500 different names"),
    # The engine's own files.
    "a journal of brackets": ("JOURNAL_FILE", "journal.jsonl", "[" * 50_000 + "\n", "damaged"),
    "a resolved workflow of brackets": ("RESOLVED", "r.json", "[" * 50_000,
        "recursion limit exceeded"),
}  # fmt: skip


# Readers whose libraries are loaded.
_LOADED: Final = set[Target]()


def _read(target: Target, path: Path) -> float:
    """Read a file; gives the processor time, also when it is refused, with libraries loaded."""
    if target not in _LOADED:
        _LOADED.add(target)
        with tempfile.TemporaryDirectory() as folder, suppress(OrthoflowError):
            target.read(Path(shutil.copy(path, folder)))
    began = time.process_time()
    try:
        target.read(path)
    finally:
        spent_s = time.process_time() - began
        assert spent_s < MAX_CPU_S
    return spent_s


@pytest.mark.parametrize("case", KNOWN)
def test_a_small_file_costs_little_and_is_refused_with_the_reason(
    case: str, tmp_path: Path
) -> None:
    name, file, content, words = KNOWN[case]
    if callable(content):
        content = content(_made(tmp_path))
    path = tmp_path / "read" / file
    path.parent.mkdir()
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(OrthoflowError, match=re.compile(words, re.DOTALL)) as refused:
        _read(getattr(readers, name), path)
    assert len(str(refused.value)) < 50_000


def _made(folder: Path) -> Path:
    (folder / "made").mkdir()
    return folder / "made"


@pytest.mark.parametrize("path", sorted(_CORPUS.glob("*/*")), ids=lambda path: path.stem)
def test_what_once_failed_is_refused(path: Path, tmp_path: Path) -> None:
    target: Target = getattr(readers, path.parent.name.upper())
    copied = tmp_path / path.name
    copied.write_bytes(path.read_bytes())
    with pytest.raises(InputError):
        _read(target, copied)


@pytest.mark.parametrize("n_bytes", [10, 2**63])
def test_records_behind_the_points_of_a_las_file_are_not_read(n_bytes: int, tmp_path: Path) -> None:
    made = _made(tmp_path)
    content = bytearray(_las(lambda raw: None)(made))
    struct.pack_into("<QI", content, 235, len(content), 1)
    content += struct.pack("<H16sHQ32s", 0, b"orthoflow", 1, n_bytes, b"") + bytes(10)
    (tmp_path / "a.las").write_bytes(content)
    assert len(scan_files.read_points(tmp_path / "a.las")) == 40


def test_pictures_that_an_e57_only_claims_to_hold_are_not_read(tmp_path: Path) -> None:
    made = _made(tmp_path)
    image = (
        b'<images2D type="Vector" allowHeterogeneousChildren="1"><vectorChild type="Structure">'
        b'<pinholeRepresentation type="Structure"><jpegImage type="Blob" fileOffset="48" '
        b'length="999999999999999"/></pinholeRepresentation></vectorChild></images2D>'
    )
    seed = _e57(lambda parts: parts.xml)(made)
    (old,) = re.findall(rb"<images2D[^>]*/>|<images2D.*</images2D>", seed, re.DOTALL)
    (tmp_path / "a.e57").write_bytes(_with_xml(old, image)(made))
    assert _read(readers.E57, tmp_path / "a.e57") < MAX_CPU_S


def test_the_results_of_a_store_full_of_brackets_are_no_results(tmp_path: Path) -> None:
    for name in ("result.json", "object.json"):
        (tmp_path / name).write_bytes(b"[" * 50_000)
        readers.STORED.read(tmp_path / name)
