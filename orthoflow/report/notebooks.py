"""Access to finished runs from Python and notebooks: tables, pictures and arrays."""

from __future__ import annotations

import json
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from orthoflow.errors import ArgumentError, RecordError, did_you_mean
from orthoflow.files.images import cells_webp
from orthoflow.geometry import WallFrame
from orthoflow.geometry.levels import Colours, eight_bits
from orthoflow.products import Orthoimage, Orthoimages, Product, is_shown
from orthoflow.records import RecordedFigure
from orthoflow.records.compare import RunComparison, RunProducts, compare_runs
from orthoflow.records.open import open_run as open_plain_run
from orthoflow.records.runs import Run, cell_metrics, parts_of
from orthoflow.records.tables import RunSet, join_runs
from orthoflow.records.verify import Verification, broken_seal, verify_run
from orthoflow.report.combinations import baseline_cells, combinations_of, unequal_walls
from orthoflow.report.curves import Varied
from orthoflow.report.differences import moved_first
from orthoflow.report.paired import over_datasets, over_table
from orthoflow.report.pictures import data_uri, embedded_products, thumbnail
from orthoflow.report.rendering import environment
from orthoflow.report.summaries import answers
from orthoflow.untrusted_text import first_few, shown

if TYPE_CHECKING:
    import pandas as pd

_THUMBNAIL_PX: Final = 640
_FIGURES_MOST: Final = 24  # shown at once: notebooks store them in their files
_ROWS_MOST: Final = 60  # in a table of differences
_PARAMETERS_MOST: Final = 8


@dataclass(frozen=True, kw_only=True, repr=False)
class OpenedRun(Run):
    """A finished run, with tables, pictures and arrays for interactive use."""

    def metrics(self) -> pd.DataFrame:
        """Return a table with one row for each metric of each cell.

        Returns:
            A table with these columns: `cell`, `step` and `method`; `dataset` if there are several;
            `variant.<step>` for each step with variants (empty if the cell does not depend on it);
            for each step with swept parameters, the method, such as `plane.use`, and the
            parameters, such as `plane.tolerance_m`; and `repeat`, `metric`, `value` and `unit`.
        """
        import pandas as pd  # noqa: PLC0415 - takes a second and is rarely needed

        varied = Varied.of(self)
        rows = [
            (
                cell.address,
                cell.step,
                cell.method,
                *varied.values(cell.assignment),
                cell.repeat,
                row.metric,
                row.value,
                row.unit,
            )
            for cell in self.record.cells
            for row in cell_metrics(cell)
        ]
        first, last = ("cell", "step", "method"), ("repeat", "metric", "value", "unit")
        columns = [*first, *varied.names, *last]
        return pd.DataFrame(rows, columns=columns)

    def statistics(self) -> pd.DataFrame:
        """Return the report's table of statistics over all datasets; empty for a single dataset.

        Returns:
            A table with one row for each metric and combination of variants. It contains the
            median, the difference from `reference`, the confidence interval of the difference, the
            p-value before and after Holm's correction, and the effect; NaN if unknown. `partly` is
            the number of datasets on which only some repeats have a value, `apart` the number that
            cannot be paired because the environments or the numbers of photos differ.
        """
        import pandas as pd  # noqa: PLC0415 - takes a second and is rarely needed

        table = over_table(over_datasets(parts_of(self)))
        frame = pd.DataFrame(table.rows, columns=[column.name for column in table.columns])
        numeric = [column.name for column in table.columns if column.is_numeric]
        return frame.astype({name: float for name in numeric if frame[name].dtype == object})

    @cached_property
    def figures(self) -> Figures:
        """Return all figures that the methods drew, by `step/name`; notebooks display them."""
        return Figures(
            {
                f"{cell.address}/{figure.name}": ShownFigure(**vars(figure))
                for cell in self.record.cells
                for figure in cell.figures
            }
        )

    def product(
        self,
        address: str,
        port: str,
        *,
        store: str | Path = ".orthoflow",
        repeat: int = 0,
        **variants: str,
    ) -> Product:
        """Return an output as an object of its product class.

        Args:
            address: address of the cell; if `variants` are given, the name of the step suffices.
            port: name of the output.
            store: folder of the store, for products that the record references but does not
                contain.
            repeat: number of the repeat, from 0.
            variants: step -> variant, and `data` -> dataset.

        Raises:
            ArgumentError: the run has no such cell, or the cell has no such output.
            RecordError: neither the record nor the store contains the output, or the record is
                damaged.
            PluginError: no installed plugin defines the type of the product.
            DamageError: the stored output is damaged.
        """
        from orthoflow.catalog.discovery import discover_catalog  # noqa: PLC0415 - loads plugins
        from orthoflow.engine.store import stores_at  # noqa: PLC0415 - rarely needed

        cell = self.cell(address, repeat=repeat, **variants)
        address, output = cell.address, cell.outputs.get(port)
        if output is None or output.embedded:
            return super().product(address, port)
        cls = discover_catalog().product_class(output.type_name)
        payload = RunProducts(run=self, stores=stores_at(store)).payload(address, port, cls)
        if payload is None:
            raise RecordError(
                f"{self.path} contains only the digest of {address}.{port}, and the store {store} "
                "does not contain it: pass the store of the run, as store='FOLDER/.orthoflow'"
            )
        return cls.from_payload(payload)

    def verify(self) -> Verification:
        """Check the record and the published files, as `orthoflow verify` does."""
        return verify_run(self.path)

    def orthoimage(
        self, number: int | None = None, *, cell: str | None = None, data: str | None = None
    ) -> WallImage:
        """Return the orthoimage of a wall as an array with its frame.

        Args:
            number: number of the wall, as in the names of its files; None for the first one.
            cell: address of the cell that created the orthoimage. If None, a cell of the baseline
                is used, or a cell of another combination, with a warning, if the baseline has no
                orthoimage.
            data: name of the dataset, if the run has several; None for the first one.

        Raises:
            ArgumentError: the run has no such orthoimage; the message lists the available
                orthoimages.
        """
        part = self if data is None else self._part(data)
        places = dict(embedded_products(part, "orthoimages"))
        baseline = [one.address for one in baseline_cells(part) if one.address in places]
        chosen = cell or next(iter([*baseline, *places]), "")
        if chosen not in places:
            lacks = f"the run {self.record.run_id} has no orthoimages"
            if places:
                raise ArgumentError(f"{lacks} of {cell}, only of {', '.join(places)}")
            raise ArgumentError(f"{self.with_failure(lacks)}{self._way_to_logs()}")
        if not (cell or baseline):
            warnings.warn(f"the baseline has no orthoimages; showing {chosen}", stacklevel=2)
        images = Orthoimages.from_payload(self.payload(chosen, places[chosen])).images
        image = next((image for image in images if number in (None, image.number)), None)
        if image is None:
            numbers = ", ".join(str(image.number) for image in images)
            raise ArgumentError(f"{chosen} has no orthoimage of wall {number}; walls: {numbers}")
        name = f"wall_{image.number}_ortho.tif"
        files = [file for file in self.files.get(chosen, ()) if file.name == name]
        return WallImage(image=image, cell=chosen, file=files[0] if files else None)

    def _part(self, data: str) -> Run:
        parts = parts_of(self)
        if data not in parts:
            raise ArgumentError(
                f"the run {self.record.run_id} has no dataset {data}"
                f"{did_you_mean(data, parts)}; it has {', '.join(parts) or 'none'}"
            )
        return parts[data]

    def compare(
        self, other: str | Path | Run, *, store: str | Path = ".orthoflow"
    ) -> ShownComparison:
        """Compare this run with another one; see `RunComparison`.

        Args:
            other: the other run, as an object or as the path of its folder or record.
            store: folder of the store, for products that the records reference but do not contain.

        Raises:
            ArgumentError: the other run does not exist.
            RecordError: a record is damaged.
        """
        from orthoflow.engine.store import stores_at  # noqa: PLC0415 - rarely needed

        opened = other if isinstance(other, Run) else open_run(other)
        return ShownComparison(**vars(compare_runs(self, opened, stores=stores_at(store))))

    def _way_to_logs(self) -> str:
        failed = [cell for cell in self.record.cells if cell.status == "failed"]
        if not failed or not failed[0].log:
            return ""
        return f"; its log is run.cell({failed[0].address!r}).log"

    def _repr_html_(self) -> str:
        made = {cell.address for cell in baseline_cells(self)}
        counts = Counter(cell.status for cell in self.record.cells)
        counts_text = ", ".join(f"{count} {status}" for status, count in counts.items()) or "none"
        return _html(
            "run",
            self.record,
            f"{self.with_failure(f'steps: {counts_text}')}{self._way_to_logs()}",
            unequal_walls(combinations_of(self)),
            thumbnail(self, made, longest_side_px=_THUMBNAIL_PX),
            answers(self),
        )


def open_run(path: str | Path) -> OpenedRun:
    """Open a finished run; warn if the seal of its record is broken.

    Large arrays are verified when they are read; `OpenedRun.verify` checks everything.

    Args:
        path: a run folder, or the `run.h5` in this folder.

    Raises:
        ArgumentError: the path does not exist, or the folder does not contain a finished run.
        RecordError: the file is damaged, not a record, or has a newer format.
    """
    plain = open_plain_run(path)
    if doubt := broken_seal(plain):
        warnings.warn(f"{doubt}; do not rely on this output", stacklevel=2)
    return OpenedRun(path=plain.path, record=plain.record)


def open_runs(paths: Sequence[str | Path]) -> RunSet:
    """Open several runs, whose metrics are joined into one table; see `RunSet.metrics`.

    Args:
        paths: run folders, or their `run.h5` files.

    Raises:
        ArgumentError: a path does not exist, or no paths are given.
        RecordError: a file is damaged, not a record, or has another version.
    """
    return join_runs([open_run(path) for path in paths])


@dataclass(frozen=True, kw_only=True, repr=False)
class ShownComparison(RunComparison):
    """A comparison of two runs, which notebooks can display."""

    def _repr_html_(self) -> str:
        parameters = [
            f"{row.cell}.{row.name}: {' -> '.join(json.dumps(side.value) for side in sides)}"
            for row in self.shared(self.parameters)
            if row.is_shared and not row.is_same
            if (sides := [one for one in (row.left, row.right) if one is not None])
        ]
        differing = [row for row in self.measured if row.is_shared and row.is_moved]
        moved = [(row.cell, row.name) for row in moved_first(differing, self.step_of)]
        table = ""
        if moved:
            numbers = self.metric_table().set_index(["cell", "metric"])
            table = numbers.loc[moved[:_ROWS_MOST]].reset_index().to_html(index=False)
        return _html(
            "comparison",
            repr(self),
            first_few(parameters, most=_PARAMETERS_MOST) if parameters else "",
            sum(row.is_shared for row in self.measured),
            Markup(table),
            max(0, len(moved) - _ROWS_MOST),
        )


class Figures(dict[str, "ShownFigure"]):
    """Mapping from names to figures, which notebooks can display."""

    def __missing__(self, name: str) -> ShownFigure:
        raise ArgumentError(
            f"the run has no figure {name}{did_you_mean(name, self)}; it has "
            f"{first_few(list(self), most=_FIGURES_MOST) or 'none'}"
        )

    def __repr__(self) -> str:
        return "\n".join(shown(f"{name}: {one.caption}") for name, one in self.items())

    def _repr_html_(self) -> str:
        named = list(self.items())
        pictures = [
            (data_uri(one.data, one.media_type), f"{name}: {one.caption}")
            for name, one in named[:_FIGURES_MOST]
        ]
        return _html("figures", pictures, [name for name, _ in named[_FIGURES_MOST:]])


@dataclass(frozen=True, kw_only=True)
class ShownFigure(RecordedFigure):
    """A figure that notebooks can display."""

    def save(self, path: str | Path) -> None:
        """Write the figure to a file."""
        Path(path).write_bytes(self.data)

    def _repr_html_(self) -> str:
        return _html("picture", data_uri(self.data, self.media_type), self.caption)


@dataclass(frozen=True, kw_only=True, repr=False)
class WallImage:
    """An orthoimage that can be used as an array; `numpy.asarray` returns its `rgb`.

    Attributes:
        image: the orthoimage with its colours, mask, sources and frame.
        cell: address of the cell that created the orthoimage.
        file: path of the GeoTIFF; None if the files of the run are not next to the record.
    """

    image: Orthoimage
    cell: str
    file: Path | None

    @property
    def rgb(self) -> Colours:
        """Colours (rows, columns, 3), uint8, or uint16 from 16-bit photos; 0 in empty cells."""
        return self.image.rgb

    @property
    def is_shown(self) -> NDArray[np.bool_]:
        """Mask (rows, columns), which is True for cells with a colour, including filled cells."""
        return is_shown(self.image.mask)

    @property
    def frame(self) -> WallFrame:
        """Frame that defines the positions of the cells; `frame.world_from_wall` returns metres."""
        return self.image.frame

    def __array__(
        self, dtype: np.dtype[Any] | None = None, *, copy: bool | None = None
    ) -> NDArray[Any]:
        return np.array(self.rgb, dtype=dtype, copy=copy)

    def __repr__(self) -> str:
        frame = self.frame
        return (
            f"<WallImage {shown(self.image.name)} of {shown(self.cell)}: {frame.height} rows, "
            f"{frame.width} columns of {1e3 * frame.gsd_m:g} mm>"
        )

    def _repr_html_(self) -> str:
        picture = cells_webp(
            self.image.mask.shape,
            lambda part: (eight_bits(self.rgb[part]), is_shown(self.image.mask[part])),
            longest_side_px=_THUMBNAIL_PX,
            least_px=_THUMBNAIL_PX // 2,
        )
        return _html("picture", data_uri(picture, "image/webp"), repr(self))


# The type is `Any` because it depends on the macro.
def _html(macro: str, *values: Any) -> str:
    """Render a macro of the notebook template; the template escapes text from records."""
    return str(getattr(environment().get_template("notebook.html.j2").module, macro)(*values))
