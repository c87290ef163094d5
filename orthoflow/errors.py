"""All errors that orthoflow raises deliberately.

A message is one sentence that states what was given, what was expected, where, and what to do. The
command line derives the exit code from the class (`exit_code`) and shows tracebacks only with
`--debug`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Final


class OrthoflowError(Exception):
    """Base class of all errors that orthoflow raises deliberately.

    Attributes:
        exit_code: exit code of a command that ends with this error.
    """

    exit_code: ClassVar[int] = 1


class InputError(OrthoflowError, ValueError):
    """A given file or value cannot be used: it is unreadable, empty or of the wrong type."""

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
    """A product is invalid: inconsistent shapes, values out of range, or an unknown type."""


class MethodError(OrthoflowError, RuntimeError):
    """A method has no result for these inputs, e.g. because no plane has enough points."""


class StepFailedError(OrthoflowError, RuntimeError):
    """A step ended without a result: it crashed, was killed, or exceeded memory or timeout."""


class ClusterError(OrthoflowError, RuntimeError):
    """The scheduler or the workers of a run were lost; the same command continues the run."""


class CancelledStepError(OrthoflowError, RuntimeError):
    """A step stopped because it was cancelled."""

    exit_code = 130


class PluginError(OrthoflowError, ImportError):
    """A plugin, method or required library is missing, cannot be loaded, or is declared twice."""

    exit_code = 4


class StoreError(OrthoflowError, OSError):
    """The store or a run folder cannot be read or written: full disk, no permission, or damage."""


class DamageError(StoreError):
    """Data in the store is missing or damaged; recomputing it restores it."""


class RecordError(OrthoflowError, ValueError):
    """A record is damaged, does not match its seal, or has an unsupported format."""

    exit_code = 3


# Maximum number of names to compare; each comparison takes several microseconds.
_MOST_CANDIDATES: Final = 1000
_LONGEST_NAME: Final = 200


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name that is most similar; empty if none is similar.

    >>> nearest("hugh2d", ["hough2d", "ransac"])
    'hough2d'
    """
    import difflib  # noqa: PLC0415 - only needed for mistakes

    candidates = sorted(known)
    if len(candidates) > _MOST_CANDIDATES or len(name) > _LONGEST_NAME:
        return ""
    matches = difflib.get_close_matches(name, candidates, n=1, cutoff=0.6)
    return matches[0] if matches else ""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ` (did you mean X?)` with the most similar known name; empty if none is similar.

    >>> did_you_mean("gsd", ["gsd_m", "buffer_m"])
    ' (did you mean gsd_m?)'
    >>> did_you_mean("colour", ["gsd_m", "buffer_m"])
    ''
    """
    near = nearest(name, known)
    return f" (did you mean {near}?)" if near else ""
