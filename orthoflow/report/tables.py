"""Tables for pages and publications, including tables of the detected planes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from orthoflow.geometry import omega_phi_deg
from orthoflow.products import Planes
from orthoflow.records.runs import Run
from orthoflow.report.pictures import products_of
from orthoflow.report.rankings import number
from orthoflow.untrusted_text import Value, csv_text, shown

_LATEX: Final = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
}


def escaped_latex(text: str) -> str:
    """Escape text for use in LaTeX."""
    return "".join(_LATEX.get(sign, sign) for sign in shown(text))


class Column(NamedTuple):
    """A column of a table.

    Attributes:
        label: heading on pages, which may contain the unit, and which values are better.
        name: heading in CSV files.
        is_numeric: whether the column is right-aligned and sorted numerically.
        digits: number of significant digits.
    """

    label: str
    name: str = ""
    is_numeric: bool = True
    digits: int = 4


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table that is shown on pages and written as CSV, LaTeX and Markdown.

    Attributes:
        name: name of the table's files, without suffix.
        caption: caption, as one sentence.
        columns: columns in order.
        rows: rows of values; a value is None if the field is empty.
    """

    name: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Value, ...], ...]

    def text(self, value: Value, column: Column, missing: str = "-") -> str:
        """Format a value."""
        if isinstance(value, float):
            return number(value, significant=column.digits)
        return missing if value is None else str(value)

    def only(self, *names: str) -> Table:
        """Return the table with only the given columns."""
        places = [place for place, column in enumerate(self.columns) if column.name in names]
        return replace(
            self,
            columns=tuple(self.columns[place] for place in places),
            rows=tuple(tuple(row[place] for place in places) for row in self.rows),
        )

    def csv(self) -> str:
        """Return the table as CSV, with all digits of its numbers."""
        return csv_text([[column.name for column in self.columns], *self.rows])

    def latex(self) -> str:
        """Return the table as LaTeX code, which uses the package booktabs."""
        head, *rows = (" & ".join(map(escaped_latex, row)) + r" \\" for row in self._texts())
        return "\n".join(
            (
                r"\begin{table}",
                r"\centering",
                rf"\caption{{{escaped_latex(self.caption)}}}",
                rf"\label{{tab:{self.name}}}",
                rf"\begin{{tabular}}{{{''.join('lr'[one.is_numeric] for one in self.columns)}}}",
                *(r"\toprule", head, r"\midrule", *rows, r"\bottomrule"),
                *(r"\end{tabular}", r"\end{table}", ""),
            )
        )

    def markdown(self) -> str:
        """Return the table as Markdown, with right-aligned numbers."""
        head, *rows = self._texts()
        rule = ["---:" if column.is_numeric else "---" for column in self.columns]
        lines = [f"| {' | '.join(map(_markdown, row))} |" for row in (head, rule, *rows)]
        return "\n".join((*lines, "", f"{_markdown(self.caption)}", ""))

    def _texts(self) -> Iterator[Sequence[str]]:
        yield [column.label for column in self.columns]
        for row in self.rows:
            yield [self.text(*place, "--") for place in zip(row, self.columns, strict=True)]


def _markdown(text: str) -> str:
    return shown(text).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")


@dataclass(frozen=True, kw_only=True)
class PlaneTables:
    """Tables of the planes from one cell.

    Attributes:
        cell: address of the cell.
        viewpoint: description of how the viewing side of each plane was determined.
        planes: table with one row per plane.
        materials: table of the thickness of the point cloud by position and material.
        before: addresses of all cells upstream of `cell`.
    """

    cell: str
    viewpoint: str
    planes: Table
    materials: Table
    before: frozenset[str] = frozenset()

    def taken_further(self, tables: Iterable[PlaneTables]) -> bool:
        """Return whether one of `tables` shows planes that another step derived from these."""
        return any(self.cell in table.before for table in tables)


def plane_tables(run: Run) -> tuple[PlaneTables, ...]:
    """Return the tables of all cells with detected planes; identical planes only once."""
    found = []
    for address, planes in products_of(run, Planes):
        # Source of the viewing side -> number of planes.
        counts = Counter(planes.side_source(index) for index in range(len(planes)))
        sources = [f"{source} ({count})" for source, count in counts.items()]
        found.append(
            PlaneTables(
                cell=address,
                viewpoint=", ".join(sources)
                if planes.side_from
                else planes.viewpoint.replace("_", " "),
                planes=_plane_table(planes),
                materials=_material_table(planes),
                before=frozenset(cell.address for cell in run.upstream(address)) - {address},
            )
        )
    return tuple(found)


def _plane_table(planes: Planes) -> Table:
    rows = []
    for index, name in enumerate(planes.names):
        omega, phi = omega_phi_deg(planes.normal[index], planes.up)
        first, second, _, last = planes.corners[index]
        wide_m, high_m = np.linalg.norm(last - first), np.linalg.norm(second - first)
        # Planes that were read from input files have no thickness.
        thickness = planes.thickness[index] if planes.thickness else None
        spread = (None, None) if thickness is None else (thickness.sigma_m, thickness.scan_step_m)
        rows.append(
            (
                *(name, f"{omega:.3f}", f"{phi:.3f}", f"{planes.offset[index]:.4f}"),
                *(f"{1000 * planes.sigma_offset_m(index):.2g}", f"{wide_m:.2f} x {high_m:.2f} m"),
                *(f"{planes.n_points[index]:,}", f"{1000 * planes.rms_m[index]:.2f}"),
                *("-" if value is None else f"{1000 * value:.2f}" for value in spread),
            )
        )
    return Table(
        name="planes",
        caption="planes",
        columns=tuple(
            Column(label, is_numeric=label not in ("plane", "rectangle"))
            for label in (
                *("plane", "omega / deg", "phi / deg", "offset / m", "sigma at centre / mm"),
                *("rectangle", "points", "RMS / mm", "thickness / mm", "point spacing / mm"),
            )
        ),
        rows=tuple(rows),
    )


def _material_table(planes: Planes) -> Table:
    places = [
        (name, thickness.material)
        for name, thickness in zip(planes.names, planes.thickness, strict=False)
        if thickness is not None
    ]
    if (row := planes.scan_row) is not None:
        places.append((f"row {row.row} of scan {row.scan}, {planes.names[0]}", row.material))
    return Table(
        name="materials",
        caption="thickness of the cloud by material",
        columns=(
            *(Column(label, is_numeric=False) for label in ("on", "material")),
            *(Column(label) for label in ("points of the sample", "thickness / mm")),
        ),
        rows=tuple(
            (place, str(one.name), f"{one.n_points:,}", f"{1000 * one.sigma_m:.2f}")
            for place, spreads in places
            for one in spreads
        ),
    )
