"""What tests may need that a machine with nothing but Python lacks: five reasons to skip.

A test skips by what stands here, or by a fixture that does; `.ci/run` fails where one skips for
another reason (`--strict-skips`).
"""

from __future__ import annotations

import shutil
from typing import Final, Never

import pytest

REASONS: Final = {
    "program": "needs a program that Python's packages do not bring",
    "data": "needs the real scans and photos in ../shared/data",
    "right": "needs a right that this user or container lacks",
    "platform": "needs Linux",
    "long": ".ci/run",
}


def skip(what: str, detail: str) -> Never:
    """Skip the running test for one of the five reasons."""
    pytest.skip(f"{REASONS[what]}: {detail}")


def skip_unless(is_here: bool, what: str, detail: str) -> pytest.MarkDecorator:
    """Return a mark that skips a test for one of the five reasons."""
    return pytest.mark.skipif(not is_here, reason=f"{REASONS[what]}: {detail}")


def need_programs(*names: str) -> list[str]:
    """Return where programs are, or skip the running test."""
    found = [(name, shutil.which(name)) for name in names]
    missing = [name for name, path in found if path is None]
    if missing:
        skip("program", ", ".join(missing))
    return [path for _, path in found if path is not None]


def is_allowed(reason: str) -> bool:
    """Whether a test may be skipped for a reason."""
    return any(allowed in reason for allowed in REASONS.values())
