"""Defaults and bounds of all parameters are the recorded ones."""

from __future__ import annotations

import pytest

from orthoflow.catalog.discovery import discover_catalog
from tests.parameter_record import RECORD, parameters

METHODS = [
    method_id
    for method_id, entry in sorted(discover_catalog().methods.items())
    if entry.distribution.name == "orthoflow-tls"
]


@pytest.mark.parametrize("method_id", METHODS)
def test_parameters_of_a_method_are_the_recorded_ones(method_id: str) -> None:
    """Moved on purpose: write the record anew with `python tests/parameter_record.py`."""

    def of_method(lines: list[str]) -> list[str]:
        return [line for line in lines if line.startswith(f"{method_id} ")]

    assert of_method(parameters()) == of_method(RECORD.read_text(encoding="utf-8").splitlines())


def test_the_record_knows_no_method_that_is_gone() -> None:
    recorded = {line.split()[0] for line in RECORD.read_text(encoding="utf-8").splitlines()}
    assert recorded <= set(METHODS)
