"""Print the size of an installation: megabytes of each distribution that orthoflow installs.

python benchmarks/install_size.py [--without open3d-cpu]

With `--without`, only the distributions that nothing but the given one needs are listed.
"""

from __future__ import annotations

import argparse
from importlib import metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def needed(root: str, without: str = "") -> set[str]:
    """Return the distributions that one needs, including itself, if another one is missing."""
    found: set[str] = set()
    waiting = [root]
    while waiting:
        name = canonicalize_name(waiting.pop())
        if name in found or name == without:
            continue
        try:
            required = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        found.add(name)
        wanted = [Requirement(text) for text in required]
        waiting += [
            item.name for item in wanted if not item.marker or item.marker.evaluate({"extra": ""})
        ]
    return found


def megabytes(name: str) -> float:
    """Return the size of the files of a distribution."""
    paths = [file.locate() for file in metadata.files(name) or []]
    return sum(path.stat().st_size for path in paths if path.exists()) / 1e6  # type: ignore[attr-defined]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--without", default="open3d-cpu")
    without = canonicalize_name(parser.parse_args().without)
    everything = needed("orthoflow-tls")
    rest = needed("orthoflow-tls", without)
    sizes = {name: megabytes(name) for name in everything}
    print(f"{len(everything)} distributions, {sum(sizes.values()):.0f} MB")
    print(f"without {without}: {len(rest)}, {sum(sizes[name] for name in rest):.0f} MB")
    for name in sorted(sizes, key=lambda name: -sizes[name])[:20]:
        print(f"{name}: {sizes[name]:.0f} MB" + ("" if name in rest else f" (for {without})"))


if __name__ == "__main__":
    main()
