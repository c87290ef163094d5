"""`walls.json`: which orthoimages of a run to deliver, and why not the others."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow_provenance.document import RecordedCell

from orthoflow.engine.journal import cell_file_name
from orthoflow.errors import InputError
from orthoflow.files.sidecars import read_sidecar, write_json
from orthoflow.products import PAINTED_STATES, JsonValue
from orthoflow.untrusted_text import parse_json

WALLS_FILE: Final = "walls.json"
_WALLS_LARGEST_BYTES: Final = 1 << 22
_ORTHO: Final = re.compile(r"(?:[a-z]+_)?wall_(\d{1,5})_ortho\.json")
_DEPTH: Final = re.compile(r"(?:[a-z]+_)?wall_(\d{1,5})_depth\.json")
# An image with a smaller painted share is not a view of its wall.
_LEAST_PAINTED_SHARE: Final = 0.5


@dataclass(frozen=True, kw_only=True)
class DeliveredWall:
    """A wall, and whether its orthoimage should be delivered.

    Attributes:
        name: of the wall, with its number.
        kind: `wall`, `floor`, `ceiling`, or its method's own name for it.
        recommended: its orthoimage should be delivered.
        reason: why, or why not, in words.
        area_m2: of the image; None without one.
        painted_share: of the cells of the image; None without one.
        expected_mm: expected error of a point measured in the image, median; None if it was not
            checked.
    """

    name: str
    kind: str
    recommended: bool
    reason: str
    area_m2: float | None
    painted_share: float | None
    expected_mm: float | None


def delivered_walls(products: Path) -> tuple[DeliveredWall, ...]:
    """Read `walls.json` of a run; empty if it is missing or unreadable."""
    path = products / WALLS_FILE
    try:
        if path.is_symlink() or path.stat().st_size > _WALLS_LARGEST_BYTES:
            return ()
        found = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ()
    rows = found.get("walls") if isinstance(found, dict) else None
    return tuple(
        DeliveredWall(
            name=str(row.get("name", "")),
            kind=str(row.get("kind", "")),
            recommended=row.get("recommended") is True,
            reason=str(row.get("reason", "")),
            area_m2=_number(row.get("area_m2")),
            painted_share=_number(row.get("painted_share")),
            expected_mm=_number(row.get("expected_mm_median")),
        )
        for row in (rows if isinstance(rows, list) else ())
        if isinstance(row, dict)
    )


def _number(value: object) -> float | None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(str(value)) if is_number and math.isfinite(float(str(value))) else None


def write_walls_json(products: Path, cells: Sequence[RecordedCell]) -> None:
    """Write `walls.json` into the products of a run; nothing without orthoimages.

    With several combinations the last one is used, as for drawings.

    Args:
        products: folder with the files of all cells.
        cells: of the run, in order.
    """
    pictured = [
        cell
        for cell in cells
        if cell.status == "ok"
        and cell.inputs
        and any(output.type_name == "orthoimages" for output in cell.outputs.values())
    ]
    if not pictured:
        return
    folder = products / cell_file_name(pictured[-1].address)
    images = {number: content for number, _, content in _sidecars(folder, _ORTHO)}
    paths = {number: path for number, path, _ in _sidecars(folder, _ORTHO)}
    walls: list[dict[str, JsonValue]] = []
    for number, content in images.items():
        image = paths[number].with_suffix(".tif").relative_to(products).as_posix()
        error = paths[number].with_name(paths[number].name.replace("_ortho.json", "_error.tif"))
        walls.append(_told(number, content, image, is_of_photos=error.exists()))
    walls += _included(products, cells, images)
    walls.sort(key=_rank)
    write_json(products / WALLS_FILE, {"walls": list(walls)})


def _sidecars(
    folder: Path, pattern: re.Pattern[str]
) -> Iterator[tuple[int, Path, dict[str, object]]]:
    for path in sorted(folder.glob("*.json")):
        if found := pattern.fullmatch(path.name):
            try:
                yield int(found[1]), path, read_sidecar(path)
            except InputError:
                continue


def _told(
    number: int, content: Mapping[str, object], image: str, *, is_of_photos: bool
) -> dict[str, JsonValue]:
    """Return the entry of one orthoimage."""
    counts = content.get("mask_counts")
    counts = counts if isinstance(counts, dict) else {}
    total = sum(counts.values()) or 1
    painted = sum(float(counts.get(str(int(state)), 0)) for state in PAINTED_STATES) / total
    accuracy = content.get("accuracy")
    accuracy = accuracy if isinstance(accuracy, dict) else {}
    median = accuracy.get("expected_mm_median")
    reason = f"{painted:.0%} painted"
    if painted < _LEAST_PAINTED_SHARE:
        recommended, reason = False, f"only {reason}"
    elif is_of_photos and not accuracy.get("assessed"):
        recommended, reason = False, f"{reason}, accuracy not checked: no tie lies on this wall"
    else:
        recommended = True
        if isinstance(median, float) and math.isfinite(median):
            reason += f", expected error {median:.1f} mm"
    size_m2 = float(str(content.get("gsd_m", 0.0))) ** 2 * total
    return {
        "number": number,
        "name": str(content.get("name", f"wall {number}")),
        "kind": _kind(str(content.get("name", "wall"))),
        "recommended": recommended,
        "reason": reason,
        "area_m2": round(size_m2, 3),
        "painted_share": round(painted, 4),
        "expected_mm_median": median if isinstance(median, float) else None,
        "n_check_points": accuracy.get("n_check_points", 0),
        "orthoimage": image,
    }


def _included(
    products: Path, cells: Sequence[RecordedCell], images: Mapping[int, object]
) -> Iterator[dict[str, JsonValue]]:
    """Return surfaces that a wall of these images already shows."""
    found: dict[int, int] = {}
    for cell in cells:
        for number, _, content in _sidecars(products / cell_file_name(cell.address), _DEPTH):
            included = content.get("includes_walls")
            if number in images and isinstance(included, list):
                found |= {int(other): number for other in included}
    for number, wall in found.items():
        if number not in images:
            yield {
                "number": number,
                "name": f"wall {number}",
                "kind": "wall",
                "recommended": False,
                "reason": f"already included in wall {wall}",
                "area_m2": None,
                "painted_share": None,
                "expected_mm_median": None,
                "n_check_points": 0,
                "orthoimage": None,
            }


def _kind(name: str) -> str:
    """Return the first word of a wall's name: wall, floor, ceiling, or its method's own."""
    return name.split(" ", maxsplit=1)[0] or "wall"


def _rank(wall: Mapping[str, JsonValue]) -> tuple[bool, float, int]:
    """Sort key: recommended ones first, of these the largest painted area."""
    area, share = wall["area_m2"], wall["painted_share"]
    painted = area * share if isinstance(area, float) and isinstance(share, float) else 0.0
    return not wall["recommended"], -painted, int(str(wall["number"]))
