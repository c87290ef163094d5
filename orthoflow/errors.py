"""Every error that orthoflow raises on purpose, in one page.

A message is one sentence: what was given, what was expected, where, and the way out if there is
one. The command line turns the class into an exit code (`exit_code`) and never shows a traceback
unless `--debug` is given.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Final


class OrthoflowError(Exception):
    """Root of all errors that orthoflow raises on purpose.

    Attributes:
        exit_code: process exit code when this error ends a command.
    """

    exit_code: ClassVar[int] = 1


class InputError(OrthoflowError, ValueError):
    """A file or value that the user gave cannot be used: unreadable, empty, of the wrong kind."""

    exit_code = 2


class WorkflowError(OrthoflowError, ValueError):
    """A workflow file is invalid; the message lists every problem found, one per line."""

    exit_code = 2


class ArgumentError(OrthoflowError, ValueError):
    """A command-line argument or a function argument is invalid."""

    exit_code = 2


class GeometryError(OrthoflowError, ValueError):
    """A geometric construction has no solution, e.g. a plane through three points on a line."""


class ProductError(OrthoflowError, ValueError):
    """A product breaks its own rules: shapes that disagree, values out of range, unknown type."""


class MethodError(OrthoflowError, RuntimeError):
    """A method cannot give a result for these inputs, e.g. no plane has enough points."""


class StepFailedError(OrthoflowError, RuntimeError):
    """A step ended without a result: crashed, killed, out of memory, or past its timeout."""


class ClusterError(OrthoflowError, RuntimeError):
    """The scheduler of a run was lost, or its workers; the same command goes on."""


class CancelledStepError(OrthoflowError, RuntimeError):
    """A step was asked to stop and did."""

    exit_code = 130


class PluginError(OrthoflowError, ImportError):
    """A plugin, a method or a library that a plugin needs is missing, broken or claimed twice."""

    exit_code = 4


class StoreError(OrthoflowError, OSError):
    """The store or a run folder cannot be read or written: full disk, no permission, damage."""


class DamageError(StoreError):
    """The store does not hold any more what was put into it; what is computed again heals it."""


class RecordError(OrthoflowError, ValueError):
    """A record is damaged, differs from its seal, or has a format this version cannot read."""

    exit_code = 3


# Comparing takes some microseconds for each, for every name that is misspelt.
_MOST_CANDIDATES: Final = 1000
_LONGEST_NAME: Final = 200


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name most like another, or nothing when none is near.

    >>> nearest("hugh2d", ["hough2d", "ransac"])
    'hough2d'
    """
    import difflib  # noqa: PLC0415 - for a mistake only

    candidates = sorted(known)
    if len(candidates) > _MOST_CANDIDATES or len(name) > _LONGEST_NAME:
        return ""
    matches = difflib.get_close_matches(name, candidates, n=1, cutoff=0.6)
    return matches[0] if matches else ""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ` (did you mean X?)` for the nearest known name, or nothing when none is near.

    >>> did_you_mean("gsd", ["gsd_m", "buffer_m"])
    ' (did you mean gsd_m?)'
    >>> did_you_mean("colour", ["gsd_m", "buffer_m"])
    ''
    """
    near = nearest(name, known)
    return f" (did you mean {near}?)" if near else ""
