"""Pictures on the page, which are small images of products."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Collection, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.sheet_contents import round_below
from orthoflow.files.images import Part, cells_webp, grey_cells, sampled_rows
from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import count_cells
from orthoflow.geometry.levels import eight_bits
from orthoflow.geometry.threads import in_order
from orthoflow.products import (
    Orthoimage,
    Orthoimages,
    OrthoMask,
    Product,
    SurfaceMask,
    Wall,
    Walls,
    is_shown,
)
from orthoflow.records.runs import Run, published_files
from orthoflow.report.combinations import baseline_cells
from orthoflow.untrusted_text import shown

T = TypeVar("T", bound=Product)
LONGEST_SIDE_PX: Final = 1000
SHORTEST_SIDE_PX: Final = 320
# Number of pictures that a page can contain at full size; if there are more, all are scaled down. A
# picture with a longer side of 1000 px takes about 90 kB.
_FULL_PICTURES: Final = 24
# The baseline's orthoimages are meant for close inspection, so they have as many cells as the size
# limit of a page allows; a cell takes about 0.15 bytes.
_CLOSE_CELLS: Final = 12_000_000

# Maximum number of positions per wall for which the page contains depths; 8000 depths take about 40
# kB.
_PLACES_MOST: Final = 8_000
# Maximum length of the scale bar as a share of the picture's width.
_BAR_SHARE: Final = 0.3
# ColorBrewer's colour map RdBu (Brewer 2003), from blue (behind the plane) through white (on the
# plane) to red (in front of it), which readers with red-green colour blindness can distinguish.
DIVERGING: Final = np.array(
    [[33, 102, 172], [146, 197, 222], [247, 247, 247], [244, 165, 130], [178, 24, 43]],
    dtype=np.float64,
)
_PLACES: Final = np.linspace(-1.0, 1.0, 255)
_DIVERGING_TABLE: Final = np.rint(
    np.column_stack([np.interp(_PLACES, np.linspace(-1, 1, 5), one) for one in DIVERGING.T])
).astype(np.uint8)
# The planes that two methods detect for the same wall usually differ by at most a few centimetres
# and one degree.
_SAME_NORMAL_COSINE: Final = float(np.cos(np.radians(5.0)))
_SAME_PLACE_SHARE: Final = 0.1  # of the longer side, between centres


@dataclass(frozen=True, kw_only=True)
class Picture:
    """An image on the page.

    Attributes:
        uri: data URI of the image.
        title: title of the image.
        caption: description of the image, such as its size and the shares of the cell states.
        file: path of the full-size image relative to the run folder; empty if there is no such
            file.
        cell: address of the cell that created the image.
        wall: index of the wall in the product; -1 if the image is not a raster of a wall.
        number: number of the wall as shown to users, which is the index of its plane in
            `planes.json`.
        name: name of the wall.
        frame: frame of the raster; None if the image is not a raster of a wall.
        id: HTML id; empty if nothing refers to the image.
        depths: for pictures of depth, a coarse grid with its numbers of `columns` and `rows`, and
            the depths in `mm` row by row (None if unknown).
        depth_limit_m: depth in front of the plane that is shown in the last colour of the scale;
            the first colour shows the same distance behind the plane.
        reading: one sentence on how to interpret the image and what indicates a problem.
    """

    uri: str
    title: str
    caption: str
    file: str = ""
    cell: str = ""
    wall: int = -1
    number: int = -1
    name: str = ""
    frame: WallFrame | None = None
    id: str = ""
    depths: Mapping[str, object] | None = None
    depth_limit_m: float | None = None
    reading: str = ""

    @property
    def width_m(self) -> float:
        """Width on the wall in metres; 0 if the image is not a raster of a wall."""
        return self.frame.width * self.frame.gsd_m if self.frame is not None else 0.0

    @property
    def scale(self) -> tuple[str, float]:
        """Length of the scale bar (a round number), and its share of the width in percent."""
        length_m = round_below(_BAR_SHARE * self.width_m)
        words = f"{length_m:g} m" if length_m >= 1.0 else f"{100.0 * length_m:g} cm"
        return words, 100.0 * length_m / self.width_m

    @property
    def layer(self) -> str:
        """Title without the wall, which is the same for all walls of a cell."""
        text = self.title.removeprefix(self.name).strip(" ,")
        return text if text and not text.startswith("(") else f"orthoimage {text}".strip()


def data_uri(content: bytes, media_type: str) -> str:
    """Encode the content of a file as a data URI."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}"


def side_px(n_pictures: float) -> int:
    """Return the longer side in pixels at which this number of pictures fits on a page."""
    share = min(1.0, math.sqrt(_FULL_PICTURES / max(1, n_pictures)))
    return max(SHORTEST_SIDE_PX, round(LONGEST_SIDE_PX * share))


def orthoimage_pictures(run: Run, *, share: float = 1.0) -> Iterator[Picture]:
    """Yield pictures of all orthoimages in the record, without duplicates.

    Args:
        run: the run.
        share: the part of a page's size limit that the pictures may use, from 0 to 1.
    """
    n_products = len(embedded_products(run, "orthoimages"))
    baseline = {cell.address for cell in baseline_cells(run)}
    for address, product in products_of(run, Orthoimages):
        yield from _drawn(
            [_orthoimage(run, address, image) for image in product.images],
            n_products=n_products / share,
            close_cells=share * _CLOSE_CELLS / len(product.images) if address in baseline else 0.0,
        )


def thumbnail(run: Run, addresses: Collection[str], *, longest_side_px: int) -> str:
    """Return a thumbnail of the first orthoimage of cells as a data URI; empty if there is none."""
    places = [cell for cell, _ in embedded_products(run, "orthoimages") if cell in addresses]
    for address, product in products_of(run, Orthoimages, places[-1:]):
        for image in product.images:
            draw, _ = _orthoimage(run, address, image)
            return data_uri(draw(longest_side_px), "image/webp")
    return ""


def wall_pictures(run: Run, *, share: float = 1.0) -> Iterator[Picture]:
    """Yield intensity and depth pictures of all walls in the record, without duplicates.

    Args:
        run: the run.
        share: the part of a page's size limit that the pictures may use, from 0 to 1.
    """
    n_products = len(embedded_products(run, "walls"))
    for address, product in products_of(run, Walls):
        drawings: list[_Drawing] = []
        for index, wall in enumerate(product.walls):
            if wall.intensity is not None:
                source = product.intensity_source
                drawings.append(_intensity(run, address, index, wall, wall.intensity, source))
            drawings.append(_depth(run, address, index, wall))
        yield from _drawn(drawings, n_products=n_products / share)


# A function that encodes the image with a given longer side in pixels, and the picture without
# image data.
_Drawing = tuple[Callable[[int], bytes], Picture]


def _drawn(
    drawings: Sequence[_Drawing], *, n_products: float, close_cells: float = 0.0
) -> Iterator[Picture]:
    """Encode pictures in parallel, because encoding takes most of the time needed for a report.

    Args:
        drawings: pictures of one product.
        n_products: number of products on the page.
        close_cells: minimum number of cells in each picture, unless the raster has fewer.
    """
    small_px = side_px(n_products * len(drawings))

    def content(drawing: _Drawing) -> bytes:
        draw, picture = drawing
        shorter, longer = sorted((frame_of(picture).width, frame_of(picture).height))
        return draw(max(small_px, int(math.sqrt(close_cells * longer / shorter))))

    for (_, picture), data in zip(drawings, in_order(content, drawings), strict=True):
        yield replace(picture, uri=data_uri(data, "image/webp"))


def _orthoimage(run: Run, address: str, image: Orthoimage) -> _Drawing:

    def cells(part: Part) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        return eight_bits(image.rgb[part]), is_shown(image.mask[part])

    return (
        lambda side: cells_webp(image.mask.shape, cells, longest_side_px=side),
        Picture(
            uri="",
            title=_title(image.name, address),
            caption=f"{frame_words(image.frame)}, of which {_states(image)}",
            file=_published(run, address, f"wall_{image.number}_ortho.tif"),
            cell=address,
            wall=image.wall,
            number=image.number,
            name=image.name,
            frame=image.frame,
            reading="Lines of the building should be continuous; doubled or broken lines and blur "
            "indicate wrong orientations or depths. Chequered areas are not visible in any source.",
        ),
    )


def _states(image: Orthoimage) -> str:
    """Describe the shares of the cell states, which add up to 100 %."""
    words = {
        OrthoMask.PAINTED: "covered",
        OrthoMask.CONTRADICTED: "covered by a single photo that contradicts the scan",
        OrthoMask.FILLED: "interpolated from neighbours",
        OrthoMask.NO_SURFACE: "without scan points nearby",
        OrthoMask.OCCLUDED: "hidden in every photo",
        OrthoMask.NONE: "outside all oriented photos",
    }
    shares = {text: count_cells(image.mask, state) for state, text in words.items()}
    texts = [f"{_percent(n / image.mask.size)} {text}" for text, n in shares.items() if n]
    return ", ".join(texts)


def _depth(run: Run, address: str, index: int, wall: Wall) -> _Drawing:
    known = 1.0 - count_cells(wall.mask, SurfaceMask.VOID) / wall.mask.size
    limit_m = _depth_limit_m(sampled_rows(wall.depth_m))
    log = run.cells[address].log

    def cells(part: Part) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        return depth_colours(wall.depth_m[part], limit_m), wall.mask[part] != SurfaceMask.VOID

    return (
        lambda side: cells_webp(wall.mask.shape, cells, longest_side_px=side),
        replace(
            _raster(run, address, index, wall, "depth"),
            caption=f"{_percent(known)} of the depths known"
            + (f"; for the reasons, see the log of {address}" if known < 1.0 and log else ""),
            reading="Relief appears as uniform colours with sharp edges; stripes or a slope across "
            "the wall indicate misaligned scans or a wrong plane.",
            depths=coarse_depths(wall.depth_m),
            depth_limit_m=limit_m,
        ),
    )


def _intensity(
    run: Run, address: str, index: int, wall: Wall, intensity: NDArray[np.float32], source: str
) -> _Drawing:
    return (
        lambda side: cells_webp(intensity.shape, grey_cells(intensity), longest_side_px=side),
        replace(
            _raster(run, address, index, wall, "intensity"),
            caption={
                "laser": "laser intensity",
                "luminance": "grey of the scan's colours, because the scan has no laser intensity",
            }.get(source, source),
            reading="Photos are matched with this picture, which should have texture everywhere: "
            "no ties can be found in uniform grey areas.",
        ),
    )


def _raster(run: Run, address: str, index: int, wall: Wall, what: str) -> Picture:
    return Picture(
        uri="",
        title=_title(f"{wall.name}, {what}", address),
        caption="",
        file=_published(run, address, f"wall_{wall.plane_index}_{what}.tif"),
        cell=address,
        wall=index,
        number=wall.plane_index,
        name=wall.name,
        frame=wall.frame,
    )


def depth_colours(depth_m: NDArray[np.float32], limit_m: float) -> NDArray[np.uint8]:
    """Convert depths to colours from blue (-limit) to red (+limit); 0 and NaN become white."""
    place = np.clip(np.asarray(depth_m, dtype=np.float32) / np.float32(limit_m), -1.0, 1.0)
    # Looking up colours in a table is ten times as fast as interpolating them.
    index = np.rint(np.nan_to_num(place) * 127.0 + 127.0).astype(np.int16)
    coloured: NDArray[np.uint8] = _DIVERGING_TABLE[index]
    return coloured


def frame_words(frame: WallFrame) -> str:
    """Describe the size and resolution of a raster."""
    return (
        f"{frame.width * frame.gsd_m:.2f} x {frame.height * frame.gsd_m:.2f} m at "
        f"{1000 * frame.gsd_m:g} mm, {frame.width} x {frame.height} cells"
    )


def embedded_products(run: Run, type_name: str) -> tuple[tuple[str, str], ...]:
    """Return the cell and port of each product of a type in the record, without duplicates.

    Repeats are omitted, because they are of interest only for their metrics.
    """
    found: dict[str, tuple[str, str]] = {}
    for address, cell in run.cells.items():
        for port, product in cell.outputs.items():
            if product.type_name == type_name and product.embedded and cell.repeat == 0:
                found.setdefault(product.digest, (address, port))
    return tuple(found.values())


def products_of(
    run: Run, cls: type[T], addresses: Container[str] | None = None
) -> Iterator[tuple[str, T]]:
    """Yield the products of a type in the record, each preceded by the address of its cell.

    Only one product is loaded at a time, because the products of a large building together may
    exceed the memory.

    Args:
        run: the run.
        cls: class of the products.
        addresses: addresses of the cells; None for all.
    """
    every = embedded_products(run, cls.type_name)
    places = [place for place in every if addresses is None or place[0] in addresses]
    for (address, _), payload in zip(places, run.payloads(places), strict=True):
        yield address, cls.from_payload(payload)


def _depth_limit_m(depth_m: NDArray[np.float32]) -> float:
    known = np.abs(depth_m[np.isfinite(depth_m)])
    return max(0.001, float(np.percentile(known, 99))) if known.size else 0.001


def _title(name: str, address: str) -> str:
    _, varied, variants = address.partition("@")
    return f"{name} ({variants})" if varied else name


def _published(run: Run, address: str, name: str) -> str:
    for path in published_files(run.folder, address):
        if path.name == name:
            return path.relative_to(run.folder).as_posix()
    return ""


def _percent(share: float) -> str:
    return f"{100 * float(share):.1f} %"


def coarse_depths(depth_m: NDArray[np.float32]) -> dict[str, object]:
    """Sample depths in metres on a coarse grid; see `Picture.depths`."""
    height, width = depth_m.shape
    step = max(1.0, math.sqrt(width * height / _PLACES_MOST))
    columns, rows = max(1, round(width / step)), max(1, round(height / step))
    at_columns = ((np.arange(columns) + 0.5) * width / columns).astype(np.intp)
    at_rows = ((np.arange(rows) + 0.5) * height / rows).astype(np.intp)
    picked = np.rint(1000.0 * depth_m[np.ix_(at_rows, at_columns)].astype(np.float64)).ravel()
    depths = [int(value) if math.isfinite(value) else None for value in picked.tolist()]
    return {"columns": columns, "rows": rows, "mm": depths}


def cursor_places(
    orthoimages: Sequence[Picture], walls: Sequence[Picture]
) -> list[dict[str, object]]:
    """Return the frames of orthoimages and coarse depths, for the script of the page.

    Args:
        orthoimages: pictures of orthoimages.
        walls: pictures of walls, including pictures of depth.
    """
    places: list[dict[str, object]] = []
    for picture in orthoimages:
        if (frame := picture.frame) is not None:
            fitting = (
                other.depths
                for other in walls
                if other.depths and other.frame and frame.has_cells_of(other.frame)
            )
            places.append(
                {
                    "id": picture.id,
                    "wall": picture.number,
                    "name": shown(picture.name),
                    "origin": frame.origin_world.tolist(),
                    "u": frame.u_world.tolist(),
                    "v": frame.v_world.tolist(),
                    "n": frame.normal_world.tolist(),
                    **_bend_of(frame),
                    "gsd": frame.gsd_m,
                    "width": frame.width,
                    "height": frame.height,
                    **next(fitting, {"columns": 0, "rows": 0, "mm": []}),
                }
            )
    return places


def _bend_of(frame: WallFrame) -> dict[str, object]:
    """Return the surface of a curved wall for the scripts of pages."""
    if frame.bend is None:
        return {}
    return {"bend": frame.bend.revolution.numbers}


def sliders(pictures: Sequence[Picture], n_orthoimages: int) -> list[dict[str, object]]:
    """Group pictures of the same part of a wall, for the script of the page.

    Args:
        pictures: orthoimages first, then rasters of walls.
        n_orthoimages: number of orthoimages; every group contains at least one.

    Returns:
        For each group of two or more pictures, the name of the wall, the aspect ratio (width /
        height) of the first picture, and the id, titles and rectangle of each picture; rectangles
        are in percent of the width and height of the first picture.
    """
    groups: list[list[Picture]] = []
    for index, picture in enumerate(pictures):
        if picture.frame is None:
            continue
        for group in groups:
            if _is_same_place(frame_of(group[0]), picture.frame):
                group.append(picture)
                break
        else:
            if index < n_orthoimages:
                groups.append([picture])
    return [
        {
            "name": shown(group[0].title.partition(" (")[0]),
            "ratio": frame_of(group[0]).width / frame_of(group[0]).height,
            "pictures": [_placed(picture, frame_of(group[0])) for picture in group],
        }
        for group in groups
        if len(group) > 1
    ]


def _placed(picture: Picture, reference: WallFrame) -> dict[str, object]:
    frame = frame_of(picture)
    offset = frame.origin_world - reference.origin_world
    across_m, down_m = reference.width * reference.gsd_m, reference.height * reference.gsd_m
    left_m, top_m = float(offset @ reference.u_world), float(offset @ reference.v_world)
    if reference.bend is not None:
        at = reference.wall_from_world(frame.origin_world[None])[0]
        left_m, top_m = (reference.gsd_m * at[:2]).tolist()
    return {
        "id": picture.id,
        "title": shown(picture.title),
        "layer": shown(picture.layer),
        "left": 100 * left_m / across_m,
        "top": 100 * top_m / down_m,
        "width": 100 * frame.width * frame.gsd_m / across_m,
        "height": 100 * frame.height * frame.gsd_m / down_m,
    }


def frame_of(picture: Picture) -> WallFrame:
    """Return the frame of a picture, which must be a raster of a wall."""
    if picture.frame is None:
        raise ValueError(f"{picture.title} is not a raster of a wall")
    return picture.frame


def _is_same_place(one: WallFrame, other: WallFrame) -> bool:
    longest_m = max(one.width, one.height) * one.gsd_m
    centres = one.corners_world().mean(axis=0), other.corners_world().mean(axis=0)
    return (
        (one.bend is None) == (other.bend is None)
        and float(one.normal_world @ other.normal_world) > _SAME_NORMAL_COSINE
        and float(one.u_world @ other.u_world) > _SAME_NORMAL_COSINE
        and float(np.linalg.norm(centres[0] - centres[1])) < _SAME_PLACE_SHARE * longest_m
    )
