"""Exit codes of errors, which scripts ask for, and names that a misspelt one may stand for."""

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


@pytest.mark.parametrize(("n_letters", "is_compared"), [(200, True), (201, False)])
def test_names_of_two_hundred_letters_are_compared_and_no_longer_ones(
    n_letters: int, is_compared: bool
) -> None:
    name = "x" * n_letters
    assert errors.nearest(name, [name]) == (name if is_compared else "")
