"""Test cases, each of which runs one check on one method and reports a failure in one sentence."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.catalog.distributions import package_path
from orthoflow.errors import ArgumentError
from orthoflow.products import InputFiles, Product
from orthoflow.sdk import Method
from orthoflow.sdk.lines import describe_error
from orthoflow.testing.checks import CHECKS, Check
from orthoflow.testing.examples import ExampleError, example_inputs
from orthoflow.testing.subjects import Subject
from orthoflow.testing.trials import Trial

Inputs = Mapping[str, Product | InputFiles]


class ConformanceError(AssertionError):
    """A method breaks a rule; the message contains the method, the rule and the problem."""


@dataclass(frozen=True, kw_only=True)
class ConformanceCase:
    """One check of one method.

    Attributes:
        method_id: id of the method.
        check: the check.
        subject: returns the method with its runs, which all cases of the method share.
        expected_failure: the reason why the check is expected to fail; empty if it must pass.
    """

    method_id: str
    check: Check
    subject: Callable[[], Subject]
    expected_failure: str = ""

    def __str__(self) -> str:
        return f"{self.method_id}-{self.check.name}"

    def run(self) -> None:
        """Run the check.

        Raises:
            ConformanceError: the method breaks the rule, or it passes although a failure is
                expected.
        """
        problem = self.problem()
        if self.expected_failure and not problem:
            raise ConformanceError(
                f"{self}: the check passes, although it was expected to fail "
                f"({self.expected_failure}): remove it from expected_failures"
            )
        if problem and not self.expected_failure:
            raise ConformanceError(f"{self}: {problem}")

    def problem(self) -> str:
        """Run the check and return the problem in one sentence; empty if there is none."""
        try:
            self.check.run(self.subject())
        except (AssertionError, ExampleError) as error:
            return str(error)
        except Exception as error:  # noqa: BLE001 - a third-party method may raise anything
            return f"on the suite's inputs the method raised {_described(error, self.subject())}"
        return ""


def _described(error: Exception, subject: Subject) -> str:
    own = package_path(subject.method.__module__)
    frames = traceback.extract_tb(error.__traceback__)
    within = [one for one in frames if own and Path(one.filename).resolve().is_relative_to(own)]
    where = f" ({Path(within[-1].filename).name}:{within[-1].lineno})" if within else ""
    return f"{describe_error(error)}{where}"


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
        method_id: id of an installed method, e.g. `plane.flat`.
        inputs: products by port, for the ports without a suitable example in the suite; or a
            function that returns this mapping and is called by the first case.
        params: parameters that differ from the defaults, for a fast run.
        expected_failures: reasons why the method cannot pass certain checks, by name of the check.
        golden: file with golden results, which must be reproduced as long as `result_version` is
            unchanged; the first run adds missing results. Keep the file next to the tests under
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
    def subject() -> Subject:
        given = inputs() if callable(inputs) else inputs or {}
        filled = {**example_inputs(method, besides=given), **given}
        trial = Trial(method=method, inputs=filled, params=dict(params or {}))
        return Subject(trial, golden)

    return tuple(
        ConformanceCase(
            method_id=method_id,
            check=check,
            subject=subject,
            expected_failure=expected.get(check.name, ""),
        )
        for check in CHECKS
        if check.applies(method) and (golden is not None or check.name != "golden-digest-holds")
    )
