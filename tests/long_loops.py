"""What `.ci/run --long` adds: more of the same, or what needs the machine for itself."""

import os
from typing import Any

import pytest

# `.ci/run --long` sets it.
IS_LONG = os.environ.get("ORTHOFLOW_LONG_TESTS") == "1"


# Any: whatever a test takes.
def long_only(*values: Any) -> list[Any]:
    """Return values of a parameter that only the long run tries; of several, each a tuple."""
    return [
        pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.long)
        for value in values
    ]


def seeds(count: int) -> list[Any]:
    """Return seeds of one property: the first, and those that only the long run tries."""
    return [0, *long_only(*range(1, count))]
