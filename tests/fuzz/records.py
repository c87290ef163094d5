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
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from random import Random
from typing import Final

import pytest

from tests.fuzz.harness import Target
from tests.fuzz.hostile_files import TEXTS, changed_json, damage_bytes, damage_structure
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
        done = studio("export", "first", "--to", "ro-crate", "-o", "crate")
        assert done.exit_code == 0, done.output
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


RECORDS: Final = (
    Target(
        seeds=_write_archives,
        read=_read_damaged,
        mutate=with_damage,
        refusals=(RefusedError,),
        max_cpu_s=3 * MAX_CPU_S,
    ),
)
