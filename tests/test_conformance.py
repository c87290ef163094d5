"""Our own methods pass the conformance suite, through the same door as a stranger's."""

from __future__ import annotations

import pytest

from orthoflow.catalog import discover_catalog
from orthoflow.testing import ConformanceCase, conformance_cases

# Parameters that make a method quick on the suite's small examples; results stay meaningful.
QUICK: dict[str, dict[str, object]] = {
    "simulate.room": {"scan_step_m": 0.1},
    "raster.grid": {"gsd_m": 0.05},
}


def cases() -> list[ConformanceCase]:
    return [
        case
        for method_id, entry in sorted(discover_catalog().methods.items())
        if entry.distribution.name == "orthoflow-tls"
        for case in conformance_cases(method_id, params=QUICK.get(method_id))
    ]


@pytest.mark.parametrize("case", cases(), ids=str)
def test_our_methods_conform(case: ConformanceCase) -> None:
    case.run()
