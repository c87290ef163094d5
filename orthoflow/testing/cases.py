"""Test cases, each a method and a check; a failure is reported in one sentence."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from pydantic import ValidationError

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.catalog.distributions import package_path
from orthoflow.errors import ArgumentError
from orthoflow.products import InputFiles, Product
from orthoflow.sdk import Method
from orthoflow.sdk.lines import describe_error
from orthoflow.testing.checks import CHECKS, Check
from orthoflow.testing.examples import ExampleError, example_inputs
from orthoflow.testing.trials import Trial
from orthoflow.testing.witnesses import Subject, Witness

Inputs = Mapping[str, Product | InputFiles]


class ConformanceError(AssertionError):
    """A method breaks a rule; the message contains the method, the rule and the problem."""


@dataclass(frozen=True, kw_only=True)
class ConformanceCase:
    """One check of one method.

    Attributes:
        method_id: id of the method.
        check: the check.
        witness: returns the runs of the method, which are shared by its cases.
        expected_failure: why the check is expected to fail; empty if it must pass.
        golden: file with golden results; None if there is none.
    """

    method_id: str
    check: Check
    witness: Callable[[], Witness]
    expected_failure: str = ""
    golden: Path | None = None

    def __str__(self) -> str:
        return f"{self.method_id}-{self.check.name}"

    def run(self) -> None:
        """Run the check.

        Raises:
            ConformanceError: the method breaks the rule, or an expected failure did not occur.
        """
        problem = self.problem()
        if self.expected_failure and not problem:
            raise ConformanceError(
                f"{self}: passes, although it was expected to fail ({self.expected_failure}): "
                "remove it from expected_failures"
            )
        if problem and not self.expected_failure:
            raise ConformanceError(f"{self}: {problem}")

    def problem(self) -> str:
        """Run the check and return the problem in one sentence; empty if there is none."""
        with TemporaryDirectory(prefix="orthoflow-conformance-") as folder:
            try:
                subject = Subject(witness=self.witness(), folder=Path(folder), golden=self.golden)
                self.check.run(subject)
            except AssertionError as error:
                # If the example inputs already make it fail, the reason is not the rule about
                # unusual inputs.
                return (error.__cause__ is not None and self._what_stops()) or str(error)
            except Exception as error:  # noqa: BLE001 - a third-party method may raise anything
                return _failure(error, self.witness)
        return ""

    def _what_stops(self) -> str:
        """Return the error of a run on the example inputs; empty if it succeeds."""
        try:
            _ = self.witness().first
        except Exception as error:  # noqa: BLE001 - as above
            return _failure(error, self.witness)
        return ""


def _failure(error: Exception, witness: Callable[[], Witness]) -> str:
    """Return a sentence with the error of a run and the line where it was raised."""
    if isinstance(error, ExampleError):
        return str(error)
    trial = witness().trial
    if isinstance(error, ValidationError) and error.title == trial.method.Params.__name__:
        return "; ".join(
            f"parameter {'.'.join(map(str, one['loc']))} "
            + ("has no default" if one["type"] == "missing" else f"cannot be: {one['msg']}")
            for one in error.errors(include_url=False)
        )
    own = package_path(trial.method.__module__)
    frames = traceback.extract_tb(error.__traceback__)
    within = [one for one in frames if own and Path(one.filename).resolve().is_relative_to(own)]
    where = f" ({Path(within[-1].filename).name}:{within[-1].lineno})" if within else ""
    where = "" if str(error).endswith(where) else where
    return f"on the suite's inputs the method raised {describe_error(error)}{where}"


def conformance_cases(
    method_id: str,
    *,
    inputs: Inputs | Callable[[], Inputs] | None = None,
    params: Mapping[str, object] | None = None,
    expected_failures: Mapping[str, str] | None = None,
    golden: Path | None = None,
) -> tuple[ConformanceCase, ...]:
    """Return all checks that apply to an installed method.

    Args:
        method_id: id of a method in the installed entry points, e.g. `plane.flat`.
        inputs: port -> product, for ports for which the suite has no suitable example, or a
            function that returns this mapping, called by the first case.
        params: parameters that differ from the defaults, for a fast run.
        expected_failures: name of a check -> why the method cannot pass it.
        golden: file with golden results, which must be reproduced as long as `result_version` is
            unchanged; missing results are added by the first run. Keep it with the tests, under
            version control.

    Raises:
        ArgumentError: `expected_failures` contains an unknown check or an empty reason.
        WorkflowError: no installed plugin provides the method.
        PluginError: the method cannot be loaded.
    """
    expected = dict(expected_failures or {})
    method: type[Method] = discover_catalog().method(method_id).load()
    for name, reason in expected.items():
        if name not in {check.name for check in CHECKS} or not reason.strip():
            raise ArgumentError(
                f"expected_failures needs the name of a check and a reason, got {name!r}: "
                f"{reason!r}; the checks are {', '.join(check.name for check in CHECKS)}"
            )

    @cache
    def witness() -> Witness:
        given = inputs() if callable(inputs) else inputs or {}
        filled = {**example_inputs(method, besides=given), **given}
        return Witness(Trial(method=method, inputs=filled, params=dict(params or {})))

    return tuple(
        ConformanceCase(
            method_id=method_id,
            check=check,
            witness=witness,
            expected_failure=expected.get(check.name, ""),
            golden=golden,
        )
        for check in CHECKS
        if check.applies(method) and (golden is not None or check.name != "golden-digest-holds")
    )
