"""Units of coordinates, from coordinate systems, comments or column names in files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from orthoflow.errors import InputError

US_SURVEY_FOOT_M: Final = 1200.0 / 3937.0
UNITS_M: Final[dict[str, float]] = {
    "m": 1.0,
    "cm": 0.01,
    "mm": 0.001,
    "ft": 0.3048,
    "us-ft": US_SURVEY_FOOT_M,
    "in": 0.0254,
    "km": 1000.0,
}
_WORDS: Final[dict[str, str]] = {
    r"us[\s_-]*survey[\s_-]*(?:foot|feet|ft)": "us-ft",
    r"survey[\s_-]*(?:foot|feet|ft)|us[\s_-]*(?:ft|foot|feet)|usft|ftus|sft": "us-ft",
    r"(?:international[\s_-]*)?(?:foot|feet|ft|ift)": "ft",
    r"milli(?:metre|meter)s?|mm": "mm",
    r"centi(?:metre|meter)s?|cm": "cm",
    r"kilo(?:metre|meter)s?|km": "km",
    r"(?:metre|meter)s?|m": "m",
    r"inch(?:es)?|in": "in",
    r"degrees?|deg|decimal[\s_-]*degrees": "deg",
}
_UNIT: Final = "|".join(f"(?P<u{k}>{word})" for k, word in enumerate(_WORDS))
_ANY: Final = re.compile(rf"(?:{_UNIT})\b", re.IGNORECASE)
# A unit is accepted only if the comment mentions units, and `in` only directly after the word
# `unit`.
_CONTEXT: Final = re.compile(
    r"\b(?:(?:length|linear|coordinate|xyz|measurement)?[\s_-]*units?(?:[\s_-]*of[\s_-]*\w+)?"
    r"|(?:coordinates?|coords?|xyz|lengths?|distances?|positions?)(?:\s+(?:are|is|given))?\s+in\b)"
    r"(?:\s+(?:are|is|in))?[\s:=\"'\[(]*",
    re.IGNORECASE,
)
_EPSG: Final = re.compile(r"\b(?:EPSG|epsg)(?:\s*[:=]{1,2}\s*|\s+)(\d{4,6})(?:\s*\+\s*(\d{4,6}))?")
_WKT: Final = re.compile(
    r"(?:COMPD_?CS|COMPOUNDCRS|PROJ_?CS|PROJCRS|PROJECTEDCRS|GEOG_?CS|GEOGCRS|GEOGRAPHICCRS"
    r"|GEODCRS|GEOC_?CS|LOCAL_?CS|ENGCRS|ENGINEERINGCRS|BOUNDCRS|VERT_?CS|VERTCRS)\s*[\[(].*",
    re.DOTALL,
)
# GeoTIFF 1.0, 6.2 and 6.3.1.3: keys, and codes of length units.
_MODEL_TYPE, _GEOGRAPHIC = 1024, 2
_GEOGRAPHIC_TYPE, _PROJECTED, _LINEAR_UNITS = 2048, 3072, 3076
_VERTICAL, _VERTICAL_UNITS = 4096, 4099
_GEO_UNITS: Final = {
    9001: 1.0,
    9002: 0.3048,
    9003: US_SURVEY_FOOT_M,
    9036: 1000.0,
    1025: 0.001,
    1033: 0.01,
}
# Longer text is not a coordinate system, and pyproj would take long to parse it.
_LONGEST_CRS: Final = 100_000


@dataclass(frozen=True, kw_only=True)
class StatedUnit:
    """The unit declared by a file.

    Attributes:
        name: a key of `UNITS_M`, or `deg` for geographic coordinates; in a pair such as `us-ft/m`,
            the second unit is for heights.
        metres: length of the unit in metres, along x, y and z.
        source: part of the file that declares the unit.
    """

    name: str
    metres: tuple[float, float, float]
    source: str


def unit_of_name(name: str, source: str) -> StatedUnit:
    """Return the unit with a name from `UNITS_M`, or with the name `deg`."""
    metres = UNITS_M.get(name, float("nan"))
    return StatedUnit(name=name, metres=(metres, metres, metres), source=source)


def unit_of_word(text: str) -> str | None:
    """Return the name of the unit for a word such as `[ft]`; None if the word is not a unit."""
    found = _ANY.fullmatch(text.strip(" []()._-"))
    return None if found is None else _name(found)


def unit_of_comments(comments: Iterable[str], what: str = "comment") -> StatedUnit | None:
    """Return the unit from header comments: from a coordinate system, or from a phrase on units."""
    for comment in comments:
        if len(comment) > _LONGEST_CRS:
            continue
        text = " ".join(comment.split())
        wkt, epsg = _WKT.search(text), _EPSG.search(text)
        crs = "" if epsg is None else "EPSG:" + "+".join(filter(None, epsg.groups()))
        found = unit_of_crs(wkt[0] if wkt else crs, what)
        if found is not None:
            return found
        word = unit_of_word(text)
        for context in _CONTEXT.finditer(text):
            match = _ANY.match(text, context.end())
            word = _name(match) if match else word
        if word is not None:
            return unit_of_name(word, f"{what} {text[:60]!r}")
    return None


def unit_of_crs(text: str, what: str) -> StatedUnit | None:
    """Return the unit of a coordinate system (WKT or `EPSG:nnnn`); None if unknown to pyproj."""
    if not text.strip() or len(text) > _LONGEST_CRS:
        return None
    import pyproj

    try:
        crs = pyproj.CRS.from_user_input(text.strip(" \0\t\r\n"))
    except (pyproj.exceptions.CRSError, ValueError, UnicodeError):
        return None
    source = f"{what} {crs.name[:80]}"
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    axes = [axis for part in parts for axis in part.axis_info]
    level = [axis for axis in axes if axis.direction not in ("up", "down")]
    heights = [axis for axis in axes if axis.direction in ("up", "down")]
    if not level:
        return None
    if crs.is_geographic or any("deg" in axis.unit_name.lower() for axis in level):
        return unit_of_name("deg", source)
    metres = level[0].unit_conversion_factor
    return _unit_of_factors(
        metres, heights[0].unit_conversion_factor if heights else metres, source
    )


def unit_of_geo_keys(keys: Mapping[int, int]) -> StatedUnit | None:
    """Return the unit in GeoTIFF keys; explicit unit keys override the units of coded systems."""
    import pyproj

    factors: dict[str, float] = {}
    names, is_degrees = [], keys.get(_MODEL_TYPE) == _GEOGRAPHIC
    level = _PROJECTED if _PROJECTED in keys else _GEOGRAPHIC_TYPE
    for part, key in (("level", level), ("height", _VERTICAL)):
        # Numbers outside this range are not EPSG codes, and PROJ would search all databases for
        # them.
        if not 1024 < (code := keys.get(key, 0)) < 32767:
            continue
        try:
            crs = pyproj.CRS.from_epsg(code)
        except pyproj.exceptions.CRSError:
            continue
        names.append(crs.name)
        is_degrees = is_degrees or crs.is_geographic
        if crs.axis_info and not crs.is_geographic:
            factors[part] = crs.axis_info[0].unit_conversion_factor
            if crs.is_compound:
                factors["height"] = crs.axis_info[-1].unit_conversion_factor
    for part, key in (("level", _LINEAR_UNITS), ("height", _VERTICAL_UNITS)):
        if keys.get(key) in _GEO_UNITS:
            factors[part] = _GEO_UNITS[keys[key]]
    source = " + ".join(["GeoTIFF keys", *names])
    if is_degrees and not (keys.get(_LINEAR_UNITS) in _GEO_UNITS and _PROJECTED in keys):
        return unit_of_name("deg", source)
    if "level" not in factors:
        return None
    return _unit_of_factors(factors["level"], factors.get("height", factors["level"]), source)


def refuse_degrees(file_name: str, unit: StatedUnit) -> None:
    """Refuse geographic coordinates, in which walls cannot be measured.

    Raises:
        InputError: the unit is degrees.
    """
    if unit.name == "deg":
        raise InputError(
            f"{file_name} has geographic coordinates in degrees ({unit.source}): expected metres "
            "or feet in a projected system. Project it, e.g. with `pdal translate ... "
            "reprojection --filters.reprojection.out_srs=EPSG:nnnn`, or set cloud.unit=m if the "
            "coordinates are actually in metres"
        )


def _unit_of_factors(level_m: float, height_m: float, source: str) -> StatedUnit | None:
    """Build a unit from its factors to metres; None if the factors are not those of lengths."""
    if not (level_m > 0.0 and height_m > 0.0):
        return None
    # The tolerance is tight because international and US survey feet differ in the sixth digit.
    names = [
        next((n for n, unit_m in UNITS_M.items() if abs(m / unit_m - 1.0) < 1e-7), f"{m:.10g} m")
        for m in (level_m, height_m)
    ]
    return StatedUnit(
        name="/".join(dict.fromkeys(names)), metres=(level_m, level_m, height_m), source=source
    )


def _name(match: re.Match[str]) -> str:
    return list(_WORDS.values())[int(str(match.lastgroup)[1:])]
