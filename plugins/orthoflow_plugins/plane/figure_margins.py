"""Fixed margins of figures: engines that find them out draw everything once more to measure it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Where the panels of a figure lie, in inches.

    Attributes:
        left: from the figure's edge to the panels; right, bottom and top alike.
        right: see left.
        bottom: see left.
        top: see left.
        across: between panels side by side.
        down: between panels one above the other.
    """

    left: float
    right: float
    bottom: float
    top: float
    across: float
    down: float = 0.0


def space_out(figure: Figure, margins: Margins, *, n_rows: int, n_columns: int) -> None:
    """Lay the panels of a figure, which stand in equal rows and columns, within its margins."""
    width, height = figure.get_size_inches()
    gaps_across, gaps_down = (n_columns - 1) * margins.across, (n_rows - 1) * margins.down
    panel_width = (width - margins.left - margins.right - gaps_across) / n_columns
    panel_height = (height - margins.bottom - margins.top - gaps_down) / n_rows
    figure.subplots_adjust(
        left=margins.left / width,
        right=1.0 - margins.right / width,
        bottom=margins.bottom / height,
        top=1.0 - margins.top / height,
        wspace=margins.across / panel_width,
        hspace=margins.down / panel_height,
    )
