"""Records and crates as targets of the fuzzing: a case is damage to one, and two commands on it.

A case's file is an archive of the sound folder with a line behind its end that says how it is
damaged: links, pipes and files of a terabyte would be in no archive.
"""

from __future__ import annotations

import json
import os
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, Final

import h5py
import numpy as np
import pytest
from orthoflow_provenance.document import RecordFormatError
from orthoflow_provenance.hdf5 import fixed_text, write_array

from tests import hostile_records as hostile
from tests.fuzz.harness import Target
from tests.fuzz.mutation import mutate_bytes
from tests.studios import Studio, open_studio
from tests.workshop_runs import WORKSHOP

Command = tuple[str, ...]

MAX_CPU_S: Final = 5.0  # of a command
RECORD_COMMANDS: Final[Sequence[Command]] = (
    ("show",),
    ("show", "--json"),
    ("compare", "ORIGINAL"),
    ("report", "-o", "out/report.html"),
    ("export", "--to", "csv", "-o", "out/csv"),
    ("export", "--to", "figures", "-o", "out/figures"),
    ("export", "--to", "ro-crate", "-o", "out/crate"),
    ("export", "--embed", "-o", "out/embedded"),
    ("replay", "-o", "out/again"),
)
CRATE_COMMANDS: Final[Sequence[Command]] = (
    *(command for command in RECORD_COMMANDS if {"show", "compare", "ro-crate"} & {*command}),
    ("export", "--to", "ro-crate", "--embed", "-o", "out/embedded"),
    ("replay", "-o", "out/again"),
)
SECRET: Final = "what lies outside"
MARK: Final = b"\ndamage "


class RefusedError(Exception):
    """A command said that it does not take the record."""


# Archives -----------------------------------------------------------------------------------------


def _pack(folder: Path, archive: Path) -> None:
    with tarfile.open(archive, "w") as stream:
        stream.add(folder, ".")


def _write_archives(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as made, pytest.MonkeyPatch.context() as patch:
        studio = open_studio(Path(made), patch)
        (studio.folder / "n.txt").write_text("1.5")
        studio.run("first", "--input", "number=n.txt", "--embed")
        studio("export", "first", "--to", "ro-crate", "-o", "crate", code=0)
        _pack(studio.folder / "first", folder / "record.tar")
        _pack(studio.folder / "crate", folder / "crate.tar")


def with_damage(content: bytes, random: Random, _: Sequence[bytes]) -> bytes:
    return content + MARK + str(random.getrandbits(64)).encode()


# Cases --------------------------------------------------------------------------------------------


def _read_damaged(path: Path) -> None:
    """Unpack, damage, and run two commands; all of them on what is sound."""
    _install_workshop()
    is_crate = path.name == "crate.tar"
    commands = CRATE_COMMANDS if is_crate else RECORD_COMMANDS
    folder = path.parent
    _, mark, number = path.read_bytes().rpartition(MARK)
    run, original = folder / "out" / "run", folder / "first"
    for target in (run, original):
        with tarfile.open(path) as archive:
            # Our own archive; before 3.11.4 there was no filter to ask for.
            archive.extraction_filter = getattr(tarfile, "data_filter", None)
            archive.extractall(target)
    (folder / "secret.txt").write_text(SECRET)
    random = Random(number)
    if mark:
        if is_crate:
            _damage_crate(run, random)
        else:
            random.choice((damage_bytes, damage_structure))(run / "run.h5", random)
        commands = (random.choice(commands),)
    before = surroundings(folder)
    codes = [check_command(Studio(folder), command, run) for command in (("verify",), *commands)]
    check_made(folder / "out", run)
    assert surroundings(folder) == before
    if any(codes):
        raise RefusedError


@cache
def _install_workshop() -> None:
    # Here and not above: other tests of the process that gives the cases must not see it.
    sys.path.insert(0, str(WORKSHOP))


def check_command(
    studio: Studio, command: Command, run: Path, *, max_cpu_s: float = MAX_CPU_S
) -> int:
    """Run a command on a record, look at how it ends, give its exit code."""
    words = [str(studio.folder / "first") if word == "ORIGINAL" else word for word in command[1:]]
    before = time.process_time()
    done = studio(command[0], run, *words)
    took_s = time.process_time() - before
    description = f"{' '.join(command)}: {done.output[-2000:]}"
    if done.exception and not isinstance(done.exception, SystemExit):
        raise AssertionError(description) from done.exception
    # 4: a record may name methods that are not there.
    assert done.exit_code in ({0, 1, 2, 3, 4} if command[0] == "replay" else {0, 1, 2, 3}), (
        description
    )
    assert "itself failed" not in done.output, description
    assert "Traceback" not in done.output, description
    if done.exit_code and "--json" not in command:
        assert "error: " in done.stderr, description
    assert not {"\x1b", "\x9b", "\u202e"} & set(done.output), description
    assert took_s < max_cpu_s, f"{description}: {took_s} s"
    return done.exit_code


def check_made(out: Path, run: Path) -> None:
    """What was made is files, nothing from outside, and what was text stays text."""
    for path in out.rglob("*"):
        if path.is_relative_to(run):
            continue
        assert not path.is_symlink(), path
        assert path.is_file() or path.is_dir(), path
        if path.is_file():
            content = path.read_bytes()
            assert SECRET.encode() not in content, path
            if path.suffix == ".html":
                assert b"<script>alert" not in content
            elif path.suffix in (".json", ".geojson"):
                json.loads(content)


def surroundings(folder: Path) -> dict[Path, int]:
    """Everything but the folder in which commands may write, and the store."""
    allowed = (folder / "out", folder / ".orthoflow")
    return {
        path: path.lstat().st_mtime_ns
        for path in folder.rglob("*")
        if not path.is_relative_to(allowed[0]) and not path.is_relative_to(allowed[1])
    }


# Damage -------------------------------------------------------------------------------------------


def _damage_crate(crate: Path, random: Random) -> None:
    """Change what it says, exchange files for links and pipes, or damage its record."""
    files = sorted(path for path in crate.rglob("*") if path.is_file() and path.name != "run.h5")
    for _ in range(random.choice((1, 2, 4))):
        path, kind = random.choice(files), random.randrange(8)
        if kind == 0:
            damage_structure(crate / "run.h5", random)
        elif kind == 1:
            damage_bytes(crate / "run.h5", random)
        elif kind == 2:
            metadata = crate / "ro-crate-metadata.json"
            is_plain = metadata.is_file() and not metadata.is_symlink()
            if is_plain and metadata.stat().st_size < 1 << 20:
                metadata.write_text(changed_json(metadata.read_bytes(), random))
        elif kind == 3 and path.is_file() and not path.is_symlink():
            os.truncate(path, random.choice((0, 1, 1 << 40)))
        elif kind == 4:
            name = random.choice([text for text in TEXTS if text and "/" not in text])
            _put_link(path.parent / name[:200], random)
        else:
            path.unlink(missing_ok=True)
            if kind == 5:
                os.mkfifo(path)
            else:
                _put_link(path, random)


def _put_link(path: Path, random: Random) -> None:
    if not os.path.lexists(path):
        targets = ("/dev/zero", "../../../../secret.txt", "../../../..", str(path), "/dev/tty")
        path.symlink_to(random.choice(targets))


# Bytes that flip, and structures that are changed and sealed again --------------------------------


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


RECORDS: Final = (
    Target(
        seeds=_write_archives,
        read=_read_damaged,
        mutate=with_damage,
        refusals=(RefusedError,),
        max_cpu_s=3 * MAX_CPU_S,
    ),
)
