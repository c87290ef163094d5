"""Fetch the public scans and photos that tests and measurements use: `docs/real-data.md`.

    python benchmarks/fetch_real_data.py [FOLDER]

Downloads what is missing into FOLDER (by default `../shared/data`, where the tests look), from
fixed commits of the repositories that published it, and compares every file with its checksum.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Final
from urllib.parse import quote

ROOT: Final = Path(__file__).resolve().parents[1]
DATA: Final = ROOT.parent / "shared" / "data"
LISTING: Final = ROOT / "benchmarks" / "real_data.json"
_HOST: Final = "https://raw.githubusercontent.com"
_TIMEOUT_S: Final = 120


def download(url: str) -> bytes:
    """Return what stands at an address."""
    with urllib.request.urlopen(url, timeout=_TIMEOUT_S) as answer:
        return bytes(answer.read())


def fetch(folder: Path, get: Callable[[str], bytes] = download) -> list[str]:
    """Download what is missing or differs.

    Returns:
        What could not be fetched, and why.
    """
    problems = []
    for name, item in json.loads(LISTING.read_text("utf-8")).items():
        for local, file in item["files"].items():
            target = folder / name / local
            if target.is_file() and _digest(target.read_bytes()) == file["sha256"]:
                continue
            url = quote(f"{_HOST}/{item['repository']}/{item['commit']}/{file['source']}", ":/")
            try:
                content = get(url)
            except OSError as error:
                problems.append(f"{url}: {error}")
                continue
            if _digest(content) != file["sha256"]:
                problems.append(f"{url}: its content is not what was published")
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
            sys.stdout.write(f"{target} ({item['licence']})\n")
    return problems


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def arguments() -> argparse.ArgumentParser:
    """Return what the command takes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=DATA)
    return parser


if __name__ == "__main__":
    failed = fetch(arguments().parse_args().folder)
    sys.exit("\n".join(failed) if failed else 0)
