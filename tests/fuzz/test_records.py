"""Whatever a record or a crate holds, commands end with one sentence and write where they may."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz import record_exports, records
from tests.fuzz.harness import IS_FUZZED, N_CASES, fuzz
from tests.optional import skip_unless

pytestmark = skip_unless(IS_FUZZED, "long", "damaged records for every command")

MODULES = {name: module.__name__ for module in (records, record_exports) for name in module.NAMES}

# A case is two commands, and takes as long as thirty files.
MOST_CASES = N_CASES // 6


@pytest.mark.parametrize("name", MODULES, ids=str.lower)
def test_a_damaged_record_is_taken_or_refused_and_nothing_is_written_elsewhere(
    name: str, tmp_path: Path
) -> None:
    outcome = fuzz(f"{MODULES[name]}:{name}", tmp_path, most_cases=MOST_CASES)
    assert outcome.n_cases > 0
    assert not outcome.findings, outcome.report()
