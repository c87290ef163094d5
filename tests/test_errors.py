"""How a command ends when one of our errors ends it: the numbers that scripts ask for."""

from __future__ import annotations

import pytest

from orthoflow import errors


@pytest.mark.parametrize(
    ("kind", "exit_code"),
    [
        ("OrthoflowError", 1),
        ("InputError", 2),
        ("WorkflowError", 2),
        ("ArgumentError", 2),
        ("GeometryError", 1),
        ("ProductError", 1),
        ("MethodError", 1),
        ("StepFailedError", 1),
        ("ClusterError", 1),
        ("RecordError", 3),
        ("PluginError", 4),
        ("StoreError", 1),
        ("DamageError", 1),
        # As shells have it of what was interrupted: 128 and the number of the signal.
        ("CancelledStepError", 130),
    ],
)
def test_each_error_has_the_exit_code_of_its_kind(kind: str, exit_code: int) -> None:
    error = getattr(errors, kind)
    assert issubclass(error, errors.OrthoflowError)
    assert error("why").exit_code == exit_code
