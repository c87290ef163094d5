"""The fuzzing notices what a reader must not do, and gives the same cases again."""

from __future__ import annotations

import ctypes
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
import pytest

from orthoflow.errors import InputError
from tests.fuzz.e57_pages import crc32c, e57_of, logical_of
from tests.fuzz.harness import IS_FUZZED, Outcome, Target, fuzz, write_case
from tests.fuzz.mutation import (
    Mutate,
    mutate_bytes,
    mutate_e57,
    mutate_json,
    mutate_png,
    mutate_text,
    mutate_yaml,
)
from tests.optional import skip_unless
from tests.photo_files import picture, png
from tests.scan_files import read_points, write_e57

pytestmark = skip_unless(IS_FUZZED, "long", "the fuzzing itself")
_SEED = b'{"a": [1, 2.5, true], "b": {"c": "text"}}'


def _seeds(folder: Path) -> None:
    (folder / "a.json").write_bytes(_SEED)


def _unless_seed(act: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda path: None if path.read_bytes() == _SEED else act(path)


def _refuse(path: Path) -> None:
    raise InputError(f"{path.name} cannot be read")


def _hang(path: Path) -> None:
    while path:
        pass


def _stray_by_folder(path: Path) -> None:
    folder = os.open(path.parents[1], os.O_RDONLY)
    os.mkdir("s", dir_fd=folder)  # as writers do who follow no link
    os.close(folder)


def _link(path: Path) -> None:
    """Make and remove a link to what lies outside: both are done to the link."""
    link = path.with_name("link")
    link.symlink_to("../../elsewhere")
    link.rename(link.with_name("other")).unlink()


GOOD = Target(seeds=_seeds, read=Path.read_bytes)
REFUSES = Target(seeds=_seeds, read=_unless_seed(_refuse))
RAISES = Target(seeds=_seeds, read=_unless_seed(lambda path: {}[path]))
CRASHES = Target(seeds=_seeds, read=_unless_seed(lambda path: ctypes.string_at(0)))
HANGS = Target(seeds=_seeds, read=_unless_seed(_hang), max_cpu_s=0.2)
EATS = Target(seeds=_seeds, read=_unless_seed(lambda path: np.ones(20_000_000)), max_mib=150.0)
STRAYS = Target(seeds=_seeds, read=_unless_seed(lambda path: (path.parents[1] / "s").mkdir()))


STRAYS_BY_FOLDER = Target(seeds=_seeds, read=_unless_seed(_stray_by_folder))
LINKS = Target(seeds=_seeds, read=_link)


def _fuzz(name: str, folder: Path, most_cases: int = 4) -> Outcome:
    # Of this seed no case is what the targets take for the whole file.
    target = f"tests.fuzz.test_harness:{name}"
    return fuzz(target, folder, seed=1, budget_s=60.0, most_cases=most_cases)


@pytest.mark.parametrize(("name", "n_refused"), [("GOOD", 0), ("REFUSES", 4), ("LINKS", 0)])
def test_reading_and_refusing_are_no_findings(name: str, n_refused: int, tmp_path: Path) -> None:
    outcome = _fuzz(name, tmp_path)
    assert (outcome.n_cases, outcome.findings) == (4, [])
    assert outcome.n_refused == n_refused


@pytest.mark.parametrize(
    ("name", "kind", "words"),
    [
        ("RAISES", "traceback", "KeyError at test_harness.py"),
        ("CRASHES", "crash", "SIGSEGV"),
        ("HANGS", "hang", "processor time < test_harness.py"),
        ("EATS", "memory", "MiB"),
        ("STRAYS", "write", "os.mkdir"),
        ("STRAYS_BY_FOLDER", "write", "os.mkdir"),
    ],
)
def test_what_a_reader_must_not_do_is_found(
    name: str, kind: str, words: str, tmp_path: Path
) -> None:
    outcome = _fuzz(name, tmp_path)
    assert outcome.n_cases == 4  # it goes on behind a case that ended the process
    first = outcome.findings[0]
    assert (first.kind, first.case) == (kind, 0)
    assert words in first.text
    assert first.file.read_bytes() != _SEED
    assert "ORTHOFLOW_FUZZ_CASE=0" in outcome.report()


def test_a_case_is_the_same_whenever_it_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "seeds").mkdir()
    _seeds(tmp_path / "seeds")

    def content(seed: int, case: int) -> bytes:
        name = "tests.fuzz.test_harness:GOOD"
        return write_case(name, seed, case, tmp_path / "seeds", tmp_path).read_bytes()

    first = [content(3, case) for case in range(20)]
    assert first == [content(3, case) for case in range(20)]
    assert len(set(first)) > 15
    assert first != [content(4, case) for case in range(20)]


@pytest.mark.parametrize("mutate", [mutate_bytes, mutate_text, mutate_json, mutate_yaml])
def test_most_cases_differ_from_the_seed(mutate: Mutate) -> None:
    cases = [mutate(_SEED, Random(seed), [_SEED]) for seed in range(100)]
    assert sum(case != _SEED for case in cases) > 80
    assert len(set(cases)) > 70


def test_damage_lies_behind_the_checksums_of_png_and_e57(tmp_path: Path) -> None:
    encoded = png(picture(), b"II*\0\x08\0\0\0\0\0\0\0\0\0")
    cases = [mutate_png(encoded, Random(seed), [encoded]) for seed in range(40)]
    assert sum(case != encoded and _has_png_checksums(case) for case in cases) > 15
    axes = {f"cartesian{axis}": np.arange(1.0, 10.0) for axis in "XYZ"}
    path = write_e57(tmp_path / "a.e57", [{"fields": axes}])
    encoded = path.read_bytes()
    cases = [mutate_e57(encoded, Random(seed), [encoded]) for seed in range(40)]
    assert sum(case != encoded and _has_e57_checksums(case) for case in cases) > 25
    parts = logical_of(encoded)
    path.write_bytes(e57_of(parts.binary, parts.xml))
    np.testing.assert_allclose(read_points(path)[:, 0], np.arange(1.0, 10.0))


def _has_png_checksums(content: bytes) -> bool:
    at = 8
    while at < len(content):
        length = int.from_bytes(content[at : at + 4], "big")
        end = at + 8 + length
        if zlib.crc32(content[at + 4 : end]) != int.from_bytes(content[end : end + 4], "big"):
            return False
        at = end + 4
    return True


def _has_e57_checksums(content: bytes) -> bool:
    pages = [content[at : at + 1024] for at in range(0, len(content), 1024)]
    return all(crc32c(page[:1020]) == int.from_bytes(page[1020:], "big") for page in pages)
