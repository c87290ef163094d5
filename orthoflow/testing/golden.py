"""Golden digests: what a method gave when its author last looked, per version and environment."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from orthoflow.sdk import Method


def environment_of(method: type[Method]) -> str:
    """Name what the bits of a result may hang on besides the method: compare like with like."""
    parts = {
        "python": f"{sys.version_info.major}.{sys.version_info.minor}",
        "numpy": np.__version__,
        "machine": platform.machine(),
        **method.tools(),
    }
    return ", ".join(f"{name} {version}" for name, version in parts.items())


def golden_problem(file: Path, method: type[Method], digests: Mapping[str, str]) -> str:
    """Hold a result to the file, or add it where the file knows nothing of it.

    Args:
        file: JSON: method id -> result version -> environment -> port -> digest.
        method: the class.
        digests: port -> digest of what it gave.

    Returns:
        One sentence when the result moved though `result_version` did not; else empty.
    """
    known = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    versions = known.setdefault(method.id, {})
    environments = versions.setdefault(str(method.result_version), {})
    before = environments.setdefault(environment_of(method), dict(digests))
    moved = sorted(name for name in {*before, *digests} if before.get(name) != digests.get(name))
    if moved:
        return (
            f"output {', '.join(moved)} is another one than {file.name} has, but result_version is "
            f"{method.result_version} still: raise it, or find out why the result moved"
        )
    # An older version's results can never come again.
    known[method.id] = {str(method.result_version): environments}
    text = json.dumps(known, indent=2, sort_keys=True) + "\n"
    if not file.is_file() or file.read_text(encoding="utf-8") != text:
        file.write_text(text, encoding="utf-8")
    return ""
