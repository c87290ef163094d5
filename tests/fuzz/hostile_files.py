"""Damage to records: bytes that flip, and structures that are changed and sealed again."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import h5py
import numpy as np
from orthoflow_provenance.document import RecordFormatError
from orthoflow_provenance.hdf5 import fixed_text, write_array

from tests import hostile_records as hostile
from tests.fuzz.mutation import mutate_bytes

TEXTS = (
    *("", ".", "..", "../../x", "/etc/passwd", "C:\\x", "nul"),
    *("a\x1b[2J", "a\u202eb", "\n", 300 * "x"),
    *("=1+1", "<script>alert(1)</script>", "ok", "failed", "sha256:" + "0" * 64, "0" * 64, "1e999"),
    *("inputs.number", "inputs.", "survey.planes", "{}", "[]", "null", "[" * 2000, "-1", "NaN"),
)
NUMBERS = (0, -1, 1, 2**31, 2**62, -(2**62), float("nan"), float("inf"), -0.0, 1e308)
NAMES = (b"..", b"a\x1b", b"\xff\xfe", b"x" * 300, b"nul", b" ", b"0001", b"a=b@c")


# What the library raises for what it cannot do to a damaged file.
REFUSALS = (RecordFormatError, ValueError, KeyError, TypeError, RuntimeError, OSError)


def damage_bytes(path: Path, random: Random) -> None:
    content = path.read_bytes()
    path.write_bytes(mutate_bytes(content, random, [content]))


def damage_structure(path: Path, random: Random) -> None:
    """Change a few things in a record, and seal it again where it still can be sealed."""
    with suppress(*REFUSALS), h5py.File(path, "r+") as file:
        for _ in range(random.choice((1, 1, 1, 2, 4))):
            with suppress(*REFUSALS):
                random.choice(CHANGES)(file, random)
        if sum(item.nbytes for item in objects(file, h5py.Dataset)) > 1 << 30:
            # Digesting what is not there would take longer than all else; nobody opens it.
            return
        hostile.seal(file)


def objects(file: h5py.File, kind: type = object) -> list[Any]:
    found: list[Any] = [file]
    file.visititems(lambda _, item: found.append(item))
    return [item for item in found if isinstance(item, kind)]


def change_attribute(file: h5py.File, random: Random) -> None:
    item = random.choice([item for item in objects(file) if len(item.attrs)])
    name = random.choice(sorted(item.attrs))
    del item.attrs[name]
    values = (
        np.bytes_(random.choice(TEXTS).encode()),
        np.asarray(random.choice(NUMBERS)),
        np.zeros(random.choice(((0,), (3,), (2, 2)))),
        np.bytes_(random.randbytes(8)),
        None,
    )
    value = random.choice(values)
    if value is not None:
        item.attrs[name] = value


def change_dataset(file: h5py.File, random: Random) -> None:
    item = random.choice(objects(file, h5py.Dataset))
    parent, name, attributes = item.parent, item.name.rpartition("/")[2], dict(item.attrs)
    content = item[()]
    del parent[name]
    kind = random.randrange(7)
    if kind == 0:
        return
    if kind == 1:
        write_array(parent, name, fixed_text(random.choice(TEXTS)))
    elif kind == 2:
        shape = random.choice(((0,), (1 << 22,), (1 << 26,), (1 << 16, 1 << 10), (1 << 40,)))
        chunks = tuple(min(4096, length) or 1 for length in shape)
        parent.create_dataset(name, shape, np.uint8, chunks=chunks, compression="gzip")
    elif kind == 3:
        count, type_code = random.choice((0, 3, 100_000)), random.choice(("<f4", "S7", "?", "<i8"))
        parent.create_dataset(name, data=np.zeros(count, type_code))
    elif kind == 4 and isinstance(content, bytes):
        write_array(parent, name, fixed_text(changed_json(content, random)))
    elif kind == 5 and isinstance(content, np.ndarray) and content.dtype.names and content.size:
        column = random.choice(content.dtype.names)
        is_text = content.dtype[column].kind == "S"
        value = random.choice(TEXTS).encode() if is_text else random.choice(NUMBERS[:6])
        content[column][random.randrange(content.size)] = value
        parent.create_dataset(name, data=content)
    else:
        parent.create_dataset(name, data=np.atleast_1d(np.asarray(content))[:-1])
    for key, value in attributes.items():
        parent[name].attrs[key] = value


def changed_json(content: bytes, random: Random) -> str:
    """Exchange something deep inside for something else."""
    try:
        value = json.loads(content)
    except ValueError:
        return random.choice(TEXTS)
    inner = value
    while isinstance(inner, dict | list) and inner:
        key = random.choice(sorted(inner) if isinstance(inner, dict) else range(len(inner)))
        if random.random() < 0.4 or not isinstance(inner[key], dict | list):
            inner[key] = random.choice((*TEXTS, *NUMBERS[:6], None, [], {}, True))
            break
        inner = inner[key]
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def rename(file: h5py.File, random: Random) -> None:
    group = random.choice([item for item in objects(file, h5py.Group) if len(item)])
    name = random.choice(sorted(group)).encode()
    group.id.links.move(name, group.id, random.choice(NAMES))


def remove(file: h5py.File, random: Random) -> None:
    del file[random.choice(objects(file)[1:]).name]


def change_document(file: h5py.File, random: Random) -> None:
    """Exchange something in the document, and let what repeats it fit where it can."""
    hostile.rewrite(file, changed_json(file["document"][()], random))


def flood(file: h5py.File, random: Random) -> None:
    """Many small things that unpack to much."""
    for index in range(40):
        data = file["files"].create_dataset(
            f"{index:064}", (1 << 24,), np.uint8, chunks=(1 << 20,), compression="gzip"
        )
        if index % 8 == 0:
            data[: 1 << 20] = np.uint8(random.randrange(1, 9))


def publish(file: h5py.File, random: Random) -> None:
    document = json.loads(file["document"][()])
    document["published"] = [
        {"path": random.choice(TEXTS), "size_bytes": random.choice((0, -1, 7)), "sha256": "0" * 64}
        for _ in range(3)
    ]
    hostile.rewrite(file, json.dumps(document))


CHANGES: tuple[Callable[[h5py.File, Random], None], ...] = (
    *(change_attribute,) * 4,
    *(change_dataset,) * 5,
    *(rename, remove),
    *(change_document,) * 8,
    publish,
    flood,
)
