"""Meaning of a point's fields: one table of field names for all formats."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, permutations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.scan_file import PointField, Scan
from orthoflow.files.points.units import unit_of_word

IGNORED: Final = "_"
_COLOURS: Final = ("r", "g", "b")
_NORMALS: Final = ("nx", "ny", "nz")
_READ: Final = ("x", "y", "z", *_COLOURS, "rgb", "intensity", "row", "column")
# Meaning by field name, the most reliable names first: in `N X Y Z`, for instance, `N` is not the
# northing.
_MEANINGS: Final = {
    alias: name
    for name, text in {
        "x": "x xcoord xcoordinate cartesianx pointx coordx posx positionx easting east este est "
        "rechtswert ostwert e",
        "y": "y ycoord ycoordinate cartesiany pointy coordy posy positiony northing north norte "
        "nord hochwert nordwert n",
        "z": "z zcoord zcoordinate cartesianz pointz coordz posz positionz elevation elev height "
        "altitude alt hohe hoehe hauteur altura quota cota h",
        "r": "red colorred colourred diffusered rf colorr rot rouge rojo rosso r",
        "g": "green colorgreen colourgreen diffusegreen gf colorg grun gruen vert verde g",
        "b": "blue colorblue colourblue diffuseblue bf colorb blau bleu azul blu b",
        "rgb": "rgb rgba packedrgb",
        "intensity": "intensity intensities scalarintensity intensitat intensitaet intensite "
        "intensidad intensita int i scalarfield scalarscalarfield",
        "row": "row rowindex",
        "column": "column columnindex col",
        "nx": "nx normalx xnormal normals0 n0",
        "ny": "ny normaly ynormal normals1 n1",
        "nz": "nz normalz znormal normals2 n2",
        "number": "number no nr id index pointid objectid fid name pointname point pt",
        "scan": "scan scanid scannumber scanindex scanname source sourceid pointsourceid",
    }.items()
    for alias in text.split()
}
_PLACES: Final = {alias: place for place, alias in enumerate(_MEANINGS)}
# Fields that can replace a missing intensity, most suitable first.
_STAND_INS: Final = (
    *("reflectance", "reflectivity", "scalarreflectance", "amplitude", "scalaramplitude"),
    *("remission", "scalarremission", "intensity16", "returnintensity", "signalstrength"),
    "laserintensity",
)
_INTENSITY_PARTS: Final = re.compile(
    "intens|reflect|amplitud|remission|signal|echo|power|grey|gray|luminance|bright"
)
# The length is limited because the search for brackets takes quadratic time.
_LONGEST_NAME: Final = 200


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Meaning of the columns of a table, or of the fields of a point.

    Attributes:
        names: meaning of each column, `_` for an unused one.
        labels: column names in the file; empty if the file does not name its columns.
        unit: unit of the coordinates, if the column names include a unit (`X [ft]`).
    """

    names: tuple[str, ...]
    labels: tuple[str, ...] = ()
    unit: str | None = None

    @property
    def places(self) -> dict[str, int]:
        """Indices of the columns to read, by meaning, coordinates first."""
        found = {name: self.names.index(name) for name in _READ if name in self.names}
        has_rgb, has_grid = set(_COLOURS) <= set(found), {"row", "column"} <= set(found)
        idle = {"rgb"} if has_rgb else set(_COLOURS)
        idle |= set() if has_grid else {"row", "column"}
        return {name: place for name, place in found.items() if name not in idle}

    # Any: `more` contains other attributes of `Scan`.
    def scan(self, **more: Any) -> Scan:
        """Return a scan with these fields."""
        places = self.places
        parts: tuple[tuple[PointField, set[str]], ...] = (
            ("intensity", {"intensity"}),
            ("rgb", {"r", "rgb"}),
            ("grid", {"row"}),
        )
        labels = list(enumerate(self.labels or self.names))
        used = set(places.values())
        return Scan(
            fields=frozenset(name for name, any_of in parts if any_of & set(places)),
            fields_used=tuple(label for k, label in labels if k in used),
            fields_not_used=tuple(
                label for k, label in labels if k not in used and not label.startswith(IGNORED)
            ),
            **more,
        )


def plain_name(name: str) -> str:
    """Reduce a field name to its lower-case letters and digits, without parts in brackets."""
    if len(name) > _LONGEST_NAME:
        return ""
    plain = unicodedata.normalize("NFKD", re.sub(r"[\[(].*?[\])]", "", name.lower()))
    return re.sub(r"[^a-z0-9]", "", plain)


def meaning_of(name: str) -> str:
    """Return the meaning of a field name in any format, `_` if it is unknown."""
    base, unit = _split_unit(name)
    known = _MEANINGS.get(plain_name(name))
    return known or (_MEANINGS.get(plain_name(base), IGNORED) if unit else IGNORED)


def _certainty(label: str) -> int:
    """Return the rank of a field name in the table of names; 0 is the most reliable."""
    base = label if plain_name(label) in _MEANINGS else _split_unit(label)[0]
    return _PLACES.get(plain_name(base), 0)


def may_be_intensity(name: str) -> bool:
    """Return whether a field name suggests a measure of the strength of the returned signal."""
    return _INTENSITY_PARTS.search(plain_name(name)) is not None


def columns_of_names(
    labels: Sequence[str], *, intensity_field: str | None = None
) -> Columns | None:
    """Determine the meaning of fields from their names.

    Args:
        labels: field names, in order.
        intensity_field: name of the field to use as intensity; None for the usual names or, if
            none of them exists, the names of reflectance, amplitude and remission.

    Returns:
        The columns, or None if x, y or z is missing.
    """
    plain = [plain_name(label) for label in labels]
    names = [IGNORED] * len(labels)
    # If two fields have the same meaning (`I` and `Intensity`), use the more reliable name.
    for index in sorted(range(len(labels)), key=lambda k: _certainty(labels[k])):
        meaning = meaning_of(labels[index])
        # `I, J, K` are the components of a direction.
        is_direction = plain[index] == "i" and {"j", "k"} <= set(plain)
        if meaning not in names and not is_direction:
            names[index] = meaning
    if not {"x", "y", "z"} <= set(names):
        return None
    wanted: tuple[str, ...] = ()
    if intensity_field is not None:
        wanted = (plain_name(intensity_field),)
    if not set(wanted) & set(plain) and "intensity" not in names:
        wanted = _STAND_INS
    chosen = next((plain.index(name) for name in wanted if name in plain), None)
    if chosen is not None:
        names = [IGNORED if name == "intensity" else name for name in names]
        names[chosen] = "intensity"
    units = {_split_unit(labels[names.index(axis)])[1] for axis in "xyz"}
    unit = units.pop() if len(units) == 1 else None
    return Columns(names=tuple(names), labels=tuple(labels), unit=unit)


def columns_of_user(text: str | Sequence[str]) -> Columns:
    """Return columns as named by the user, e.g. `x y z r g b intensity`; `_` skips a column.

    Raises:
        InputError: a name is unknown or given twice, or x, y, z are incomplete.
    """
    words = text.replace(",", " ").split() if isinstance(text, str) else [str(w) for w in text]
    skipped = ("_", "-", "skip", "")
    names = [
        "intensity"
        if plain_name(word) in _STAND_INS
        else IGNORED
        if word.lower() in skipped
        else meaning_of(word)
        for word in words
    ]
    unknown = any(
        name == IGNORED and word.lower() not in skipped
        for word, name in zip(words, names, strict=True)
    )
    used = [name for name in names if name in _READ]
    if unknown or len(set(used)) != len(used) or not {"x", "y", "z"} <= set(used):
        raise InputError(
            "cloud.columns must name x, y and z once each, and may name r, g, b, intensity, row, "
            f"column, nx, ny, nz or skip a column with {IGNORED}, got {' '.join(words)!r}"
        )
    return Columns(names=tuple(names))


def columns_of_values(
    file_name: str, samples: NDArray[np.float64], first_line: str, *, is_pts: bool
) -> Columns:
    """Infer the meaning of columns without a header from their values, if unambiguous.

    Args:
        file_name: name of the file, for messages.
        samples: (n, columns) numbers in the first lines.
        first_line: the first line, for messages.
        is_pts: whether the file is a PTS file, in which the intensity precedes the colours.

    Raises:
        InputError: the meaning is ambiguous.
    """
    n_columns, first = samples.shape[1], samples[:, 0]
    is_whole = np.isfinite(first).all() and np.all(first == np.round(first))
    counts = is_whole and n_columns > 3 and len(first) >= 5 and np.all(np.diff(first) == 1.0)
    lead = ("number",) if counts else ()
    rest = samples[:, len(lead) + 3 :]
    # Try all orders of intensity, colours and normals that have this number of columns.
    parts = (("intensity",), _COLOURS, _NORMALS)
    orders = [order for count in range(4) for order in permutations(parts, count)]
    readings = [
        names
        for names in (tuple(chain(*order)) for order in orders)
        if len(names) == rest.shape[1]
        and all(
            _fits(name, rest[:, k : k + 3]) for k, name in enumerate(names) if name in ("r", "nx")
        )
    ]
    if len(readings) > 1 and rest.shape[1] == 4 and is_pts:
        readings = [("intensity", *_COLOURS)]
    if len(readings) != 1:
        raise InputError(
            f"{file_name} has {n_columns} columns and no header that names them; its first line is "
            f"{first_line[:80]!r}: name them with cloud.columns, e.g. "
            "--set 'cloud.columns=[x, y, z, r, g, b, intensity]', with _ for columns to skip"
        )
    return Columns(names=(*lead, "x", "y", "z", *readings[0]))


def _fits(name: str, values: NDArray[np.float64]) -> bool:
    """Return whether three columns can be colours (name `r`) or normals (name `nx`)."""
    finite = values[np.isfinite(values).all(axis=1)]
    if not len(finite):
        return False
    lengths = np.linalg.norm(finite, axis=1)
    is_unit = (np.abs(lengths - 1.0) < 0.02) | (lengths == 0.0)
    are_normals = bool(is_unit.mean() > 0.9 and lengths.any())
    if name == "nx":
        return are_normals
    largest = finite.max(axis=0)
    if finite.min() < 0.0 or largest.max() > 65535.0:
        return False
    if (largest > 255.0).any() and not (largest > 255.0).all():
        # The ranges of the columns differ too much for colours: one of them is an intensity.
        return False
    if largest.max() <= 1.0:
        return not are_normals
    return bool(np.all(finite == np.rint(finite)))


def _split_unit(label: str) -> tuple[str, str | None]:
    """Split a name and its unit: `X [ft]`, `y_mm`, `Z(m)`."""
    found = re.fullmatch(
        r"\s*(.+?)\s*(?:\[([^\]]*)\]|\(([^)]*)\)|[_ ]([A-Za-z-]+))\s*", label[:_LONGEST_NAME]
    )
    if found is None:
        return label, None
    unit = unit_of_word(next(part for part in found.groups()[1:] if part is not None))
    return (found[1], unit) if unit else (label, None)
