"""The fuzzing notices what a reader must not do, and gives the same cases again."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np

from orthoflow.errors import InputError
from tests.fuzz.harness import IS_FUZZED, Outcome, Target, fuzz, write_case
from tests.fuzz.mutation import crc32c, mutate_e57
from tests.optional import skip_unless
from tests.scan_files import write_e57

pytestmark = skip_unless(IS_FUZZED, "long", "the fuzzing itself")
_SEED = b'{"a": [1, 2.5, true], "b": {"c": "text"}}'


def _seeds(folder: Path) -> None:
    (folder / "a.json").write_bytes(_SEED)


def _refuse(path: Path) -> None:
    raise InputError(f"{path.name} cannot be read")


def _hang(path: Path) -> None:
    while path:
        pass


def _reading(act: Callable[[Path], object], **limits: float) -> Target:
    """A target that does something to damaged files."""

    def read(path: Path) -> object:
        return None if path.read_bytes() == _SEED else act(path)

    return Target(seeds=_seeds, read=read, **limits)


GOOD = (Target(seeds=_seeds, read=Path.read_bytes), _reading(_refuse))
# The last case of a process is blamed for what lies outside.
BAD = (
    _reading(lambda path: {}[path]),
    _reading(lambda path: np.ones(20_000_000), max_mib=150.0),
    _reading(lambda path: ctypes.string_at(0)),
    _reading(lambda path: (path.parents[1] / "s").mkdir(exist_ok=True)),
    _reading(_hang, max_cpu_s=0.2),
)


def _fuzz(name: str, folder: Path) -> Outcome:
    # Of this seed no case is what the targets take for the whole file.
    return fuzz(f"tests.fuzz.test_harness:{name}", folder, seed=1, budget_s=60.0, most_cases=2)


def test_reading_and_refusing_are_no_findings_and_targets_take_turns(tmp_path: Path) -> None:
    outcome = _fuzz("GOOD", tmp_path)
    assert (outcome.n_cases, outcome.n_refused, outcome.findings) == (4, 2, {})


def test_what_a_reader_must_not_do_is_found(tmp_path: Path) -> None:
    outcome = _fuzz("BAD", tmp_path)
    assert outcome.n_cases == 10  # it goes on behind a case that ended the process
    found = " ".join(outcome.findings)
    for words in (
        "traceback: KeyError at test_harness.py",
        "crash: ended by SIGSEGV",
        "hang: too much processor time < test_harness.py",
        "memory: took",
        "write: left outside its folder",
    ):
        assert words in found
    (first, *_) = outcome.findings.values()
    assert "ORTHOFLOW_FUZZ_SEED=1 ORTHOFLOW_FUZZ_CASE=0 " in first
    assert Path(first.split("file: ")[1].split("\n")[0]).read_bytes() != _SEED


def test_damage_lies_behind_the_checksums_of_e57(tmp_path: Path) -> None:
    axes = {f"cartesian{axis}": np.arange(1.0, 10.0) for axis in "XYZ"}
    path = write_e57(tmp_path / "a.e57", [{"fields": axes}])
    encoded = path.read_bytes()
    cases = [mutate_e57(encoded, Random(seed), [encoded]) for seed in range(20)]
    pages = [[case[at : at + 1024] for at in range(0, len(case), 1024)] for case in cases]
    fits = [all(crc32c(p[:1020]) == int.from_bytes(p[1020:], "big") for p in one) for one in pages]
    assert sum(fits) > 10
    assert encoded not in cases


def test_a_case_is_the_same_whenever_it_is_asked_for(tmp_path: Path) -> None:
    for number in ("0", "1"):
        (tmp_path / "seeds" / number).mkdir(parents=True)
        _seeds(tmp_path / "seeds" / number)

    def contents(seed: int) -> list[bytes]:
        group = "tests.fuzz.test_harness:GOOD"
        return [
            write_case(group, seed, case, tmp_path / "seeds", tmp_path).read_bytes()
            for case in range(20)
        ]

    first = contents(3)
    assert first == contents(3) != contents(4)
    assert len(set(first)) > 15
