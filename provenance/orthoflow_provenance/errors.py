"""The errors this package raises on purpose."""

from __future__ import annotations


class RecordFormatError(ValueError):
    """A file or a value does not fit the record format: damaged, forbidden, newer or incomplete.

    The message is one sentence: what was found, what was expected, where, and the way out if there
    is one.
    """


class ForeignFormatError(RecordFormatError):
    """The file is of another program, or of a later version of the format: it cannot be checked."""


class InputFileError(RecordFormatError):
    """An input file that is to be embedded is missing, or not the one that was digested."""


class UnsafeFileError(RecordFormatError):
    """A name leads elsewhere than to a file in its folder, or no regular file stands there."""
