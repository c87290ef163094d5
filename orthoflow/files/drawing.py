"""Charts and pictures as wide as a journal column (85 mm), with text of at least 6 points."""

from __future__ import annotations

import colorsys
import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.frames import RasterAxes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

# Each of the two columns of a journal page is 85 mm wide.
COLUMN_INCHES: Final = 85.0 / 25.4
DPI: Final = 300
# A taller picture would not leave room for its caption on a page.
_MAX_HEIGHT_INCHES: Final = 6.0
# A column cannot show more pixels than this along a picture's longer side.
_MAX_SIDE_PX: Final = 1000
_MISSING: Final = "#8a949e"
# Axis labels for X and Y of a wall's raster, as in its files.
_AXES: Final[Mapping[RasterAxes, tuple[str, str]]] = {
    "wall": ("along the wall [m]", "height [m]"),
    "level": ("x [m]", "y [m]"),
    "map": ("east [m]", "north [m]"),
    "plane": ("across [m]", "up [m]"),
}
_Scale = Callable[[ArrayLike], NDArray[np.float64]]
# Height of the tick labels and the axis label below a picture.
_AXIS_INCHES: Final = 0.25
# Any: matplotlib's own types list every setting by name.
_STYLE: Final[Mapping[Any, Any]] = {
    "font.family": "DejaVu Sans",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#d4d9de",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.0,
    "errorbar.capsize": 2.0,
    "legend.frameon": False,
    "legend.fontsize": 7.0,
    "savefig.dpi": DPI,
    # Identical data give identical bytes, and text in PDF files can be searched.
    "svg.hashsalt": "orthoflow",
    "pdf.fonttype": 42,
    "text.parse_math": False,
}
# Settings for figures with several panels and for pictures with axes.
_PANELS: Final[Mapping[Any, Any]] = {
    "figure.dpi": DPI,
    "font.size": 7.0,
    "axes.titlesize": 7.0,
    "axes.linewidth": 0.6,
    "axes.labelpad": 2.0,
    "axes.titlepad": 3.0,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "legend.fontsize": 6.5,
    "legend.handlelength": 1.2,
    "legend.columnspacing": 1.0,
    "legend.borderaxespad": 0.2,
    "lines.linewidth": 1.0,
}


@contextmanager
def styled(settings: Mapping[Any, Any]) -> Iterator[None]:
    """Draw in the style of all charts, regardless of the user's matplotlib settings.

    Args:
        settings: additional matplotlib settings.
    """
    import matplotlib as mpl

    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update({**_STYLE, **settings})
        yield


@contextmanager
def in_column_style() -> Iterator[None]:
    """Use the style for several panels or for pictures with axes; also works as a decorator."""
    with styled(_PANELS):
        yield


def column_figure(height_inches: float) -> Figure:
    """Return an empty figure of column width; call it within `in_column_style`."""
    from matplotlib.figure import Figure

    return Figure(figsize=(COLUMN_INCHES, height_inches), layout="constrained")


def picture_figure(
    picture: NDArray[np.uint8], *, extra_inches: float = 0.0, frame: WallFrame | None = None
) -> tuple[Figure, Axes]:
    """Return a figure that shows a picture, and the axes of the figure.

    Without a frame, coordinates on the axes are pixels of the picture. With a frame, they are
    columns and rows of the wall's raster, and labels are in metres as in its files.

    Args:
        picture: (rows, cols) grey or (rows, cols, 3) RGB.
        extra_inches: additional height for a legend or a colour bar.
        frame: frame of the wall that the picture shows; it may have more cells than the picture
            has pixels.
    """
    rows, columns = picture.shape[:2] if frame is None else frame.shape
    height = min(COLUMN_INCHES * rows / columns, _MAX_HEIGHT_INCHES)
    figure = column_figure(height + extra_inches + (_AXIS_INCHES if frame else 0.0))
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.set_anchor("N")
    extent = (0.0, float(columns), float(rows), 0.0)
    axes.imshow(picture, cmap="gray", vmin=0, vmax=255, extent=extent)
    # Arrows that extend beyond the picture must not change the limits of the axes.
    axes.autoscale(enable=False)
    if frame is not None:
        _label_in_metres(axes, frame)
    return figure, axes


def _label_in_metres(axes: Axes, frame: WallFrame) -> None:
    from matplotlib.ticker import MaxNLocator

    def line(start_m: float, step_m: float) -> tuple[_Scale, _Scale]:
        return (
            lambda cells: start_m + step_m * np.asarray(cells, dtype=np.float64),
            lambda metres: (np.asarray(metres, dtype=np.float64) - start_m) / step_m,
        )

    left_m, top_m = frame.raster_corner_m
    axes.set_axis_on()
    axes.spines[:].set_visible(False)
    axes.tick_params(left=False, bottom=False, labelleft=False, labelbottom=False)
    along = axes.secondary_xaxis("bottom", functions=line(left_m, frame.gsd_m))
    up = axes.secondary_yaxis("left", functions=line(top_m, frame.raster_down * frame.gsd_m))
    for axis, label in zip((along.xaxis, up.yaxis), _AXES[frame.raster_axes], strict=True):
        axis.set_label_text(label)
        axis.set_major_locator(MaxNLocator(5, steps=(1, 2, 5, 10)))


def map_chart(
    values: NDArray[np.floating],
    label: str,
    frame: WallFrame,
    *,
    low: float,
    high: float,
    cmap: str = "inferno",
) -> bytes:
    """Return a map of wall values (rows, cols) with a colour bar, as WebP; NaN is grey."""
    import matplotlib as mpl

    with in_column_style():
        small = _shrunk(values)
        colours: Colormap = mpl.colormaps[cmap].with_extremes(bad=_MISSING)
        scale = mpl.colors.Normalize(low, high)
        rgb = colours(scale(np.ma.masked_invalid(small)), bytes=True)[..., :3]
        figure, axes = picture_figure(rgb, extra_inches=0.45, frame=frame)
        figure.colorbar(
            mpl.cm.ScalarMappable(scale, colours),
            ax=axes,
            label=label,
            location="bottom",
            aspect=40,
            extend="both" if low < 0.0 else "max",
        )
        return encode_chart(figure)


def encode_chart(figure: Figure) -> bytes:
    """Encode a figure as WebP, which for photos is a tenth of the size of PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, format="webp", pil_kwargs={"quality": 90})
    return stream.getvalue()


def round_scale(value: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten, so that similar runs share a scale.

    >>> round_scale(0.34), round_scale(7.0)
    (0.5, 10.0)
    """
    if not value > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    step = next(step for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power * (1.0 + 1e-9))
    return float(f"{step * power:.6g}")


# Successive hues differ by the golden ratio, and have these saturations and values in turn. This
# separates the first twenty colours best.
_HUE_STEP: Final = 0.618033988749895
_SHADES: Final = ((0.9, 0.8), (0.8, 0.55), (0.45, 0.9))


def plane_ink(index: int) -> tuple[float, float, float]:
    """Return the colour (red, green, blue), 0..1, of a plane or photo in all charts.

    The hue is that of `plane_colour`, the colour of the plane's points in clouds.

    >>> tuple(round(value, 2) for value in plane_ink(0))
    (0.8, 0.08, 0.08)
    """
    return colorsys.hsv_to_rgb(index * _HUE_STEP % 1.0, *_SHADES[index % len(_SHADES)])


def _shrunk(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return values averaged to the pixels that a column can show, ignoring NaN."""
    import cv2

    shown = np.asarray(values, dtype=np.float64)
    scale = _MAX_SIDE_PX / max(shown.shape)
    if scale >= 1.0:
        return shown
    size = (max(1, round(shown.shape[1] * scale)), max(1, round(shown.shape[0] * scale)))
    known = np.isfinite(shown)
    share = cv2.resize(known.astype(np.float64), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(np.where(known, shown, 0.0), size, interpolation=cv2.INTER_AREA)
    small = np.full(share.shape, np.nan)
    return np.asarray(np.divide(total, share, out=small, where=share >= 0.5))
