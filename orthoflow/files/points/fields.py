"""The meaning of the fields of a point, by one table of names for all formats."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    PointBlock,
    PointField,
    short_file_error,
)
from orthoflow.files.points.units import unit_of_word

IGNORED: Final = "_"
COLOURS: Final = ("r", "g", "b")
GRID: Final = ("row", "column")
NORMALS: Final = ("nx", "ny", "nz")
READ: Final = ("x", "y", "z", *COLOURS, "rgb", "intensity", *GRID)
_ALIASES: Final = {
    "x": "x easting east e xcoord xcoordinate cartesianx pointx coordx posx positionx",
    "y": "y northing north n ycoord ycoordinate cartesiany pointy coordy posy positiony",
    "z": "z height elevation alt altitude h zcoord zcoordinate cartesianz pointz coordz posz "
    "positionz",
    "r": "r red rf colorred colourred diffusered colorr",
    "g": "g green gf colorgreen colourgreen diffusegreen colorg",
    "b": "b blue bf colorblue colourblue diffuseblue colorb",
    "rgb": "rgb rgba packedrgb",
    "intensity": "intensity i int intensities scalarintensity scalarfield scalarscalarfield",
    "row": "row rowindex",
    "column": "column columnindex col",
    "nx": "nx normalx xnormal normals0 n0",
    "ny": "ny normaly ynormal normals1 n1",
    "nz": "nz normalz znormal normals2 n2",
    "number": "number no nr id index pointid objectid fid name pointname point pt",
    "scan": "scan scanid scannumber scanindex scanname source sourceid pointsourceid",
}
# Substitutes for an intensity, the best first.
_STAND_INS: Final = (
    *("reflectance", "reflectivity", "scalarreflectance", "amplitude", "scalaramplitude"),
    *("remission", "scalarremission", "intensity16", "returnintensity", "signalstrength"),
    "laserintensity",
)
_INTENSITY_PARTS: Final = re.compile(
    "intens|reflect|amplitud|remission|signal|echo|power|grey|gray|luminance|bright"
)
_MEANINGS: Final = {alias: name for name, text in _ALIASES.items() for alias in text.split()}
# The search for brackets takes quadratic time.
_LONGEST_NAME: Final = 200


@dataclass(frozen=True, kw_only=True)
class Columns:
    """The meaning of the columns of a table, or of the fields of a point.

    Attributes:
        names: meaning of each, `_` for one that is not used.
        labels: their names in the file.
        unit: unit of the coordinates, if their names state it (`X [ft]`).
    """

    names: tuple[str, ...]
    labels: tuple[str, ...] = field(default=())
    unit: str | None = None

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the columns that are read, coordinates first."""
        present = [name for name in READ if name in self.names]
        has_rgb = set(COLOURS) <= set(present)
        has_grid = set(GRID) <= set(present)
        return tuple(
            name
            for name in present
            if (name not in COLOURS or has_rgb)
            and (name not in GRID or has_grid)
            and (name != "rgb" or not has_rgb)
        )

    @property
    def positions(self) -> tuple[int, ...]:
        """Position of each of `used`."""
        return tuple(self.names.index(name) for name in self.used)

    @property
    def fields(self) -> frozenset[PointField]:
        """What the points have besides coordinates."""
        used = self.used
        found: list[PointField] = ["intensity"] if "intensity" in used else []
        found += ["rgb"] if "r" in used or "rgb" in used else []
        found += ["grid"] if "row" in used else []
        return frozenset(found)

    def labels_of(self, *, used: bool) -> tuple[str, ...]:
        """Return the names in the file of the fields that are read, or of the others."""
        labels = self.labels or self.names
        positions = set(self.positions)
        return tuple(
            label for k, label in enumerate(labels) if (k in positions) == used and label != IGNORED
        )


def plain_name(name: str) -> str:
    """Reduce a field's name to its lower-case letters and digits, without bracketed parts."""
    if len(name) > _LONGEST_NAME:
        return ""
    return re.sub(r"[^a-z0-9]", "", re.sub(r"[\[(].*?[\])]", "", name.lower()))


def meaning_of(name: str) -> str:
    """Return the meaning of a field's name in any format, `_` without one."""
    plain = plain_name(name)
    if plain in _MEANINGS:
        return _MEANINGS[plain]
    base, unit = _split_unit(name)
    return _MEANINGS.get(plain_name(base), IGNORED) if unit else IGNORED


def may_be_intensity(name: str) -> bool:
    """Whether a field's name suggests a measure of the returned light."""
    return _INTENSITY_PARTS.search(plain_name(name)) is not None


def columns_of_names(
    labels: Sequence[str], *, intensity_field: str | None = None
) -> Columns | None:
    """Classify fields by their names.

    Args:
        labels: names of the fields, in order.
        intensity_field: name of the field to use as the intensity; None for the usual names, else
            those of reflectance, amplitude and remission.

    Returns:
        None if they do not include x, y and z.
    """
    names = [meaning_of(label) for label in labels]
    # If a meaning occurs twice (`I` and `Intensity`), its first field is used.
    names = [IGNORED if name in names[:index] else name for index, name in enumerate(names)]
    if not {"x", "y", "z"} <= set(names):
        return None
    chosen = None
    plain = [plain_name(label) for label in labels]
    if intensity_field is not None and plain_name(intensity_field) in plain:
        chosen = plain.index(plain_name(intensity_field))
    elif "intensity" not in names:
        chosen = next((plain.index(name) for name in _STAND_INS if name in plain), None)
    if chosen is not None:
        names = [IGNORED if name == "intensity" else name for name in names]
        names[chosen] = "intensity"
    units = {_split_unit(labels[names.index(axis)])[1] for axis in "xyz"}
    return Columns(
        names=tuple(names),
        labels=tuple(labels),
        unit=units.pop() if len(units) == 1 else None,
    )


def columns_of_user(text: str | Sequence[str]) -> Columns:
    """Return columns named by the user, e.g. `x y z r g b intensity`; `_` skips one.

    Raises:
        InputError: a name is unknown or given twice, or x, y, z are incomplete.
    """
    words = text.replace(",", " ").split() if isinstance(text, str) else [str(w) for w in text]
    names = [IGNORED if word.lower() in ("_", "-", "skip", "") else word for word in words]
    known = [IGNORED if name == IGNORED else meaning_of(name) for name in names]
    known = [
        "intensity" if name == IGNORED and plain_name(word) in _STAND_INS else name
        for name, word in zip(known, names, strict=True)
    ]
    unknown = [word for word, name in zip(names, known, strict=True) if word != name == IGNORED]
    used = [name for name in known if name in READ]
    if unknown or len(set(used)) != len(used) or not {"x", "y", "z"} <= set(used):
        raise InputError(
            "cloud.columns must name x, y and z once each, and may name r, g, b, intensity, row, "
            f"column, nx, ny, nz or skip a column with {IGNORED}, got {' '.join(words)!r}"
        )
    return Columns(names=tuple(known))


def columns_of_values(
    file_name: str, samples: NDArray[np.float64], first_line: str, *, is_pts: bool
) -> Columns:
    """Find the meaning of columns without a header from their values, if it is unambiguous.

    Args:
        file_name: for messages.
        samples: (n, columns) numbers of the first lines.
        first_line: for messages.
        is_pts: the file is a PTS file, with the intensity before the colours.

    Raises:
        InputError: the columns are ambiguous.
    """
    n_columns = samples.shape[1]
    lead: tuple[str, ...] = ()
    first = samples[:, 0]
    is_whole = np.isfinite(first).all() and np.all(first == np.round(first))
    counts = is_whole and np.all(np.diff(first) == 1.0)
    if n_columns > 3 and len(samples) >= 5 and counts:
        lead = ("number",)
    rest = samples[:, len(lead) + 3 :]
    readings = [
        reading
        for reading in _readings(rest.shape[1])
        if all(
            _fits(name, rest[:, k : k + 3]) for k, name in enumerate(reading) if name in ("r", "nx")
        )
    ]
    if len(readings) > 1 and rest.shape[1] == 4 and is_pts:
        readings = [("intensity", *COLOURS)]
    if len(readings) != 1:
        raise InputError(
            f"{file_name} has {n_columns} columns and no header that names them; its first line is "
            f"{first_line[:80]!r}: name them with cloud.columns, e.g. "
            "--set 'cloud.columns=[x, y, z, r, g, b, intensity]', with _ for one to skip"
        )
    return Columns(names=(*lead, "x", "y", "z", *readings[0]))


def point_block(
    axes: NDArray[np.float64],
    values: Mapping[str, NDArray[np.generic]],
    *,
    causes: Mapping[str, NDArray[np.bool_]] | None = None,
    scan: int = 0,
) -> PointBlock:
    """Make a block of points from the values in a file.

    Args:
        axes: (3, n) x, y, z; points with all three exactly zero have no return.
        values: (n,) by name: `intensity`, `r`, `g`, `b` or packed `rgb`, `has_rgb`, `row`,
            `column`; in the file's own types.
        causes: (n,) points that are left out, by cause; each counts for the first one.
        scan: index of the scan.
    """
    n_read = axes.shape[1]
    is_void = axes[0] == 0.0
    if is_void.any():
        is_void &= (axes[1] == 0.0) & (axes[2] == 0.0)
    left_out: dict[str, int] = {}
    kept = np.ones(n_read, dtype=np.bool_)
    for cause, is_out in {**(causes or {}), "no_return": is_void}.items():
        if n_out := int(np.count_nonzero(kept & is_out)):
            left_out[cause] = n_out
            kept &= ~is_out
    if left_out:
        axes = axes[:, kept]
        values = {name: array[kept] for name, array in values.items()}
    rgb: NDArray[np.generic] | None = None
    if "r" in values:
        rgb = np.stack([values[name] for name in COLOURS]).T
    elif "rgb" in values:
        rgb = unpacked(values["rgb"])
    has_rgb, intensity = values.get("has_rgb"), values.get("intensity")
    row, column = values.get("row"), values.get("column")
    return PointBlock(
        points=axes.T,
        scan=scan,
        n_read=n_read,
        left_out=left_out,
        intensity=None if intensity is None else intensity.astype(np.float32),
        rgb=rgb,
        has_rgb=None if has_rgb is None else has_rgb.astype(np.bool_),
        row=None if row is None else whole(row),
        column=None if column is None else whole(column),
    )


def block_of_table(
    table: NDArray[np.float64], columns: Columns, packed: np.dtype[np.generic] | None = None
) -> PointBlock:
    """Make a block of a table (n, used columns) of text.

    Args:
        table: as in the text.
        columns: meaning of its columns.
        packed: type of packed colours; None for integers.
    """
    values: dict[str, NDArray[np.generic]] = dict(zip(columns.used, table.T, strict=True))
    axes = np.stack([table[:, axis] for axis in range(3)])
    if "rgb" in values:
        values["rgb"] = whole(values["rgb"]) if packed is None else values["rgb"].astype(packed)
    return point_block(axes, values)


def record_blocks(
    path: Path,
    dtype: np.dtype[np.void],
    columns: Columns,
    *,
    offset: int,
    n_points: int,
    what: str,
) -> Iterator[dict[str, NDArray[np.generic]]]:
    """Yield the used fields of fixed-size records, memory-mapped, a block at a time.

    Args:
        path: the file.
        dtype: of a record; its fields are in the order of the columns.
        columns: their meaning.
        offset: of the first record, bytes.
        n_points: records that the header states.
        what: their name in messages.

    Raises:
        InputError: there are fewer.
    """
    n_present = (path.stat().st_size - offset) // dtype.itemsize
    if n_present < n_points:
        raise short_file_error(path, what, f"{max(n_present, 0)} points", str(n_points))
    records = np.memmap(path, dtype=dtype, mode="r", offset=offset, shape=(n_points,))
    for start in range(0, n_points, BLOCK_POINTS):
        yield used_fields(records[start : start + BLOCK_POINTS], columns)


def used_fields(records: NDArray[np.void], columns: Columns) -> dict[str, NDArray[np.generic]]:
    """Return the used fields of records (n,), by meaning."""
    names = records.dtype.names or ()
    return {
        name: records[names[position]]
        for name, position in zip(columns.used, columns.positions, strict=True)
    }


def axes_of(values: Mapping[str, NDArray[np.generic]]) -> NDArray[np.float64]:
    """Return (3, n) coordinates, axis by axis in memory: later passes run along the axes."""
    axes = np.empty((3, len(values["x"])))
    for place, axis in enumerate("xyz"):
        axes[place] = values[axis]
    return axes


def unpacked(packed: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Return colours (n, 3) from 0x00RRGGBB, stored in an integer or in the bits of a float."""
    if packed.dtype.kind == "f":
        bits = np.ascontiguousarray(packed.astype(np.float32)).view(np.uint32)
    else:
        bits = packed.astype(np.int64).astype(np.uint32)
    return np.column_stack([(bits >> shift) & 255 for shift in (16, 8, 0)]).astype(np.uint8)


def whole(values: NDArray[np.generic]) -> NDArray[np.int64]:
    """Return integers; 0 for values that are not finite."""
    if values.dtype.kind == "f":
        values = np.nan_to_num(values, posinf=0.0, neginf=0.0)
    return values.astype(np.int64)


def _split_unit(label: str) -> tuple[str, str | None]:
    """Split a name from its unit: `X [ft]`, `y_mm`, `Z(m)`."""
    found = re.fullmatch(
        r"\s*(.+?)\s*(?:\[([^\]]*)\]|\(([^)]*)\)|[_ ]([A-Za-z-]+))\s*", label[:200]
    )
    if found is None:
        return label, None
    text = next(part for part in found.groups()[1:] if part is not None)
    unit = unit_of_word(text)
    return (found[1], unit) if unit else (label, None)


def _readings(n_columns: int) -> list[tuple[str, ...]]:
    """Yield all orders of an intensity, colours and normals with this many columns."""
    parts = (("intensity",), COLOURS, NORMALS)
    return [
        tuple(itertools.chain(*order))
        for count in range(len(parts) + 1)
        for order in itertools.permutations(parts, count)
        if sum(map(len, order)) == n_columns
    ]


def _fits(name: str, values: NDArray[np.float64]) -> bool:
    """Whether three columns can be colours (`r`) or normals (`nx`)."""
    finite = values[np.isfinite(values).all(axis=1)]
    if not len(finite):
        return False
    lengths = np.linalg.norm(finite, axis=1)
    unit = (np.abs(lengths - 1.0) < 0.02) | (lengths == 0.0)
    is_unit = bool(unit.mean() > 0.9 and lengths.any())
    if name == "nx":
        return is_unit
    if finite.min() < 0.0 or finite.max() > 65535.0:
        return False
    is_whole = bool(np.all(finite == np.rint(finite)))
    largest = finite.max(axis=0)
    if (largest > 255.0).any() and not (largest > 255.0).all():
        # Channels of different depth: one of them is an intensity.
        return False
    return (is_whole and not (is_unit and finite.max() <= 1.0)) or (
        finite.max() <= 1.0 and not is_unit
    )
