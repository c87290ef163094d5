"""Whatever a file holds, it is read or refused; commands end with one sentence and write no more.

`.ci/run` gives many cases; the plain suite reads what once failed (`test_known_cases.py`).
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.harness import IS_FUZZED, N_CASES, fuzz
from tests.optional import skip_unless

pytestmark = skip_unless(IS_FUZZED, "long", "damaged files for every reader and every command")

# Import string -> share of the cases: a command takes as long as twenty files.
GROUPS = {
    "record_exports:RECORD_EXPORTS": 0.08,
    "records:RECORDS": 0.16,
    **dict.fromkeys(
        ("readers:SCANS", "readers:PICTURES", "readers:WORKFLOWS", "readers:TABLES"), 1.0
    ),
}


@pytest.mark.parametrize("name", GROUPS, ids=lambda name: name.rpartition(":")[2].lower())
def test_damaged_files_are_read_or_refused_and_nothing_else_is_written(
    name: str, tmp_path: Path
) -> None:
    most_cases = N_CASES and max(1, round(GROUPS[name] * N_CASES))
    outcome = fuzz(f"tests.fuzz.{name}", tmp_path, most_cases=most_cases)
    assert outcome.n_cases > 0
    assert not outcome.findings, "\n".join(outcome.findings.values())
