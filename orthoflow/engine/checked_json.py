"""JSON files that carry the digest of their own text: one that is damaged is never believed."""

from __future__ import annotations

import hashlib
import re
from typing import Final

_DIGEST: Final = re.compile(r'\{"sha256":"([0-9a-f]{64})",')


def with_digest(text: str) -> str:
    """Put the SHA-256 of a JSON object's text into it as its first entry.

    >>> with_digest('{"a":1}')[:24]
    '{"sha256":"015abd7f5cc57'
    """
    return f'{{"sha256":"{_sha256(text)}",{text[1:]}'


def is_checked(text: str) -> bool:
    """Whether a text has the digest that it begins with; one that begins with none has not."""
    found = _DIGEST.match(text)
    return found is not None and found[1] == _sha256(f"{{{text[found.end() :]}")


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
