"""Whether another installation computes what a plan says: versions of methods, libraries, code.

    python -m orthoflow.engine.method_versions plane.hough2d ortho.dsm-backward

prints what decides the results of methods here, as JSON behind a line break.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Final

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine.environment import python_path
from orthoflow.engine.keys import MethodFacts, method_facts
from orthoflow.errors import OrthoflowError
from orthoflow.products.product import JsonValue

_TIMEOUT_S: Final = 300.0


def methods_text(methods: Mapping[str, MethodFacts]) -> str:
    """What decides the results of methods, as text that can be compared."""
    return json.dumps({name: _facts(facts) for name, facts in methods.items()}, sort_keys=True)


def misfit(methods: str) -> str:
    """State in what the methods installed here differ from those of a plan; empty if nowhere."""
    planned = json.loads(methods)
    try:
        here = json.loads(_methods_here(tuple(planned)))
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        return f"its methods cannot be loaded ({type(error).__name__})"
    return next(
        (said for name in planned if (said := _difference(name, planned[name], here[name]))), ""
    )


@cache
def _methods_here(names: tuple[str, ...]) -> str:
    """Ask another process, so that this one loads none of them."""
    asked = subprocess.run(
        [sys.executable, "-P", "-m", "orthoflow.engine.method_versions", *names],
        capture_output=True,
        text=True,
        check=True,
        timeout=_TIMEOUT_S,
        env={**os.environ, "PYTHONPATH": python_path()},
    )
    return asked.stdout.rpartition("\n")[2]


def _facts(facts: MethodFacts) -> dict[str, JsonValue]:
    return {
        "distribution": f"{facts.distribution} {facts.distribution_version}",
        "result version": facts.result_version,
        "code": dict(facts.code),
        "libraries": dict(facts.tools),
    }


# Any: JSON that `_facts` gave, here and in the process of a worker.
def _difference(name: str, planned: dict[str, Any], here: dict[str, Any] | str) -> str:
    if isinstance(here, str):
        return here
    for library in sorted(planned["libraries"].keys() | here["libraries"].keys()):
        versions = [facts["libraries"].get(library, "none") for facts in (planned, here)]
        if versions[0] != versions[1]:
            return f"{name} has {library} {versions[1]} there, {versions[0]} in the plan"
    for what in ("distribution", "result version"):
        if planned[what] != here[what]:
            return f"{name} has the {what} {here[what]} there, {planned[what]} in the plan"
    return "" if planned["code"] == here["code"] else f"{name} has other code there"


def _print_facts(names: Sequence[str]) -> None:
    catalog = discover_catalog()
    found: dict[str, JsonValue] = {}
    for name in names:
        try:
            found[name] = _facts(method_facts(name, catalog))
        except OrthoflowError as error:
            found[name] = str(error)
    sys.stdout.write("\n" + json.dumps(found))


if __name__ == "__main__":
    _print_facts(sys.argv[1:])
