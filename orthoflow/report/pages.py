"""Writing the page: the templates filled with what the records say."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import secrets
import shlex
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

import jinja2
from markupsafe import Markup, escape

from orthoflow.errors import StoreError
from orthoflow.foreign_text import shown
from orthoflow.products import Cameras
from orthoflow.records import COSTS, RecordedCell
from orthoflow.records.comparison import compare_runs
from orthoflow.records.datasets import pages_of, parts_of
from orthoflow.records.deliverables import DeliveredWall, delivered_walls
from orthoflow.records.published import METRICS_FILE, PRODUCTS_FOLDER
from orthoflow.records.runs import FIGURES_FOLDER, Run, figure_files
from orthoflow.records.tables import CommonPoints, common_points
from orthoflow.records.verification import sealed_page
from orthoflow.records.wall_results import UncountedPoints, uncounted_points
from orthoflow.report.combinations import baseline_cells, is_missing
from orthoflow.report.comparisons import ComparisonTable, comparison_table
from orthoflow.report.cursors import cursor_places
from orthoflow.report.curves import Curve, curves, curves_over
from orthoflow.report.dataset_tables import DatasetTable, dataset_table
from orthoflow.report.diagrams import run_diagram
from orthoflow.report.differences import differences
from orthoflow.report.environments import told_apart
from orthoflow.report.figures import (
    FigureGroup,
    baseline_addresses,
    figure_groups,
    write_figures,
)
from orthoflow.report.legends import depth_gradient
from orthoflow.report.numbers import number, number_with_unit
from orthoflow.report.overlays import overlays
from orthoflow.report.paired import MetricOverDatasets, over_datasets, who_leads
from orthoflow.report.photo_plans import PhotoPlan, photo_plan
from orthoflow.report.pictures import (
    DIVERGING,
    Picture,
    embedded_products,
    orthoimage_pictures,
    sliders,
    wall_pictures,
)
from orthoflow.report.plane_tables import PlaneTable, plane_tables
from orthoflow.report.summaries import (
    Answer,
    Limit,
    answers,
    citations,
    limits,
    results,
    says_how_far_off,
)
from orthoflow.report.ways import Way, improved_on, ways
from orthoflow.version import __version__

if TYPE_CHECKING:
    from orthoflow.engine.store import Store

# Parentheses in a DOI come in pairs, as in doi:10.1007/3DRes.02(2011)3.
_DOI: Final = re.compile(r"doi:\s*(10\.(?:\([^\s()]*\)|[^\s,;()])*(?:\([^\s()]*\)|[^\s,;().]))")

# Pages that exports write where no other folder is named.
_VIEWERS: Final = {
    "model of the room": Path("export/gltf/room.html"),
    "orthoimages to measure on": Path("export/tiles/index.html"),
}


@dataclass(frozen=True, kw_only=True)
class _Ground:
    """A drawing and the id of the picture that it lies over."""

    svg: Markup
    title: str
    caption: str
    ground: str
    cell: str
    wall: str
    check_rms_mm: tuple[float, float] | None


@dataclass(frozen=True, kw_only=True)
class _Part:
    """What methods made that stands in one place of the page."""

    cells: tuple[RecordedCell, ...] = ()
    orthoimages: tuple[Picture, ...] = ()
    walls: tuple[Picture, ...] = ()
    overlays: tuple[_Ground, ...] = ()
    planes: tuple[PlaneTable, ...] = ()
    figures: tuple[FigureGroup, ...] = ()

    def of(self, addresses: Collection[str]) -> _Part:
        """What some cells have a part in."""
        return _Part(
            cells=tuple(one for one in self.cells if one.address in addresses),
            orthoimages=tuple(one for one in self.orthoimages if one.cell in addresses),
            walls=tuple(one for one in self.walls if one.cell in addresses),
            overlays=tuple(one for one in self.overlays if one.cell in addresses),
            planes=tuple(one for one in self.planes if one.cell in addresses),
            figures=tuple(one for one in self.figures if one.cell in addresses),
        )


@dataclass(frozen=True, kw_only=True)
class _Section:
    """All that the templates need of one run."""

    run: Run
    prefix: str
    answers: tuple[Answer, ...]
    limits: tuple[Limit, ...]
    delivered: tuple[DeliveredWall, ...]
    results: Mapping[str, tuple[str, ...]]
    comparison: ComparisonTable | None
    curves: tuple[Curve, ...]
    common_points: tuple[CommonPoints, ...]
    main: _Part
    earlier: frozenset[str]
    ways: tuple[tuple[Way, _Part], ...]
    sliders: list[dict[str, object]]
    places: list[dict[str, object]]
    photos: tuple[str, ...]
    plan: PhotoPlan | None
    diagram: Markup
    record_file: str
    citations: Mapping[str, tuple[str, ...]]
    viewers: Mapping[str, str]
    files: Mapping[str, Mapping[str, str]]
    title: str = ""
    whole: str = ""
    doubt: str = ""
    is_measured: bool = True
    is_unfinished: bool = False
    uncounted: UncountedPoints | None = None
    datasets: DatasetTable | None = None
    over: tuple[MetricOverDatasets, ...] = ()
    leads: str = ""


def write_page(
    run: Run, path: Path, *, go_on: str = "", doubts: Mapping[Path, str] = MappingProxyType({})
) -> None:
    """Write the report of one run, and its figures as PNG and SVG files into `figures/` beside it.

    Of a comparison these are the figures of the baseline; `write_figures` writes those of any cell.
    A run on several datasets gets a page for each, in `pages/`, and one that leads to them.

    Args:
        run: the run.
        path: file to write.
        go_on: of a run that was interrupted, the command that goes on with it.
        doubts: record -> why nobody should rely on it.

    Raises:
        StoreError: a file cannot be written.
        RecordError: the record is damaged, or a figure has a name that no file can have.
    """
    addresses = baseline_addresses(run)
    # Before the page is written: a record with such names gets none.
    figure_files(run, addresses)
    pages = pages_of(run)
    for folder in {(path.parent / page).parent for page in pages.values()}:
        _make_folder(folder)
    with run.held_open() as opened:
        parts = parts_of(opened)
        for name, page in pages.items():
            target = path.parent / page
            title = f"{run.record.name}: {name}"
            place = _Place(
                folder=target.parent, title=title, whole=f"../{path.name}", doubts=doubts
            )
            _write([parts[name]], target, place)
        place = _Place(
            folder=path.parent,
            title=run.record.name,
            go_on=go_on,
            doubts=doubts,
            pages=pages,
            has_figures=True,
        )
        _write([opened], path, place)
    write_figures(run, path.parent, addresses, inside=FIGURES_FOLDER)


def write_report(
    runs: Sequence[Run],
    path: Path,
    *,
    go_on: str = "",
    doubts: Mapping[Path, str] = MappingProxyType({}),
    stores: Sequence[Store] = (),
) -> None:
    """Write one self-contained HTML file about one or more runs.

    Args:
        runs: opened with `orthoflow.open_run`; of two, the page also says what differs.
        path: file to write; replaced as a whole, never half.
        go_on: of a run that was interrupted, the command that goes on with it.
        doubts: record -> why nobody should rely on it.
        stores: where products are that the records of two runs only name.

    Raises:
        StoreError: the file cannot be written.
        RecordError: a record is damaged.
    """
    title = ", ".join(dict.fromkeys(run.record.name for run in runs))
    place = _Place(folder=path.parent, title=title, go_on=go_on, doubts=doubts, stores=stores)
    _write(runs, path, place)


def _make_folder(folder: Path) -> None:
    # A link would lead the pages to where nobody wants them.
    if folder.is_symlink():
        raise StoreError(f"{folder} is a link, so no pages are written there: remove it")
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise StoreError(f"{folder} cannot be made: {error.strerror}") from error


@dataclass(frozen=True, kw_only=True)
class _Place:
    """Where a page stands among others.

    Attributes:
        folder: that the page lies in.
        title: of the page.
        go_on: of a run that was interrupted, the command that goes on with it.
        doubts: record -> why nobody should rely on it.
        pages: dataset -> its own page; empty for a page that leads to none.
        whole: the page of all datasets, for the one of a single dataset.
        has_figures: the figures' own files are written beside it.
        stores: where products are that the records of two runs only name.
    """

    folder: Path
    title: str
    go_on: str = ""
    doubts: Mapping[Path, str] = field(default_factory=dict)
    pages: Mapping[str, str] = field(default_factory=dict)
    whole: str = ""
    has_figures: bool = False
    stores: Sequence[Store] = ()


def _write(runs: Sequence[Run], path: Path, place: _Place) -> None:
    text = (
        environment()
        .get_template("page.html.j2")
        .render(
            sections=[
                (_overview if pages_of(run) else _section)(
                    run, f"r{index + 1}-", place, share=1 / len(runs)
                )
                for index, run in enumerate(runs)
            ],
            comparison_of_all=comparison_table(runs) if len(runs) > 1 else None,
            differences=differences(compare_runs(*runs, stores=place.stores))
            if len(runs) == 2
            else None,
            title=place.title,
            go_on=place.go_on,
        )
    )
    write_whole(path, sealed_page(text, runs))


def write_whole(path: Path, text: str) -> None:
    """Write a page, as a whole or not at all.

    Raises:
        StoreError: it cannot be written.
    """
    aside = path.with_name(f".report-{secrets.token_hex(8)}")
    try:
        # A new file: through a link that lies there it would be another's.
        with aside.open("x", encoding="utf-8") as stream:
            stream.write(text)
        aside.replace(path)
    except OSError as error:
        with suppress(OSError):
            aside.unlink()
        raise StoreError(
            f"the report {path} cannot be written: {error.strerror}; choose another place with -o"
        ) from error


@cache
def environment() -> jinja2.Environment:
    """Return the templates, with what all pages share."""
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=_shown,
        loader=jinja2.PackageLoader("orthoflow.report"),
    )
    environment.filters["with_unit"] = number_with_unit
    environment.filters["number"] = number
    environment.filters["environments"] = told_apart
    environment.filters["cited"] = cited
    environment.filters["breakable"] = _breakable
    environment.filters["urlpath"] = quote
    environment.filters["shell"] = shlex.quote
    environment.filters["drawing"] = Markup
    environment.globals["costs"] = COSTS
    environment.globals["version"] = __version__
    environment.globals["depth_gradient"] = Markup(depth_gradient(DIVERGING.tolist()))
    # Ours, and no template: braces in them mean nothing.
    css, early, script = (_packaged(name) for name in ("page.css", "early.js", "page.js"))
    environment.globals["css"] = Markup(css)
    environment.globals["early_script"] = Markup(early)
    environment.globals["script"] = Markup(script)
    environment.globals["policy"] = (
        "default-src 'none'; img-src data:; "
        f"style-src {_hash_source(css)}; script-src {_hash_source(early)} {_hash_source(script)}; "
        "base-uri 'none'; form-action 'none'"
    )
    return environment


def _shown(value: object) -> object:
    """Write out what turns reading round; what is markup already was made of escaped parts."""
    is_text = isinstance(value, str) and not isinstance(value, Markup)
    return shown(str(value), keep="\n\t") if is_text else value


def _hash_source(text: str) -> str:
    """Name a style or a script for the policy of the page, by its content."""
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _packaged(name: str) -> str:
    return files("orthoflow.report").joinpath("templates", name).read_text(encoding="utf-8")


def cited(citation: str) -> Markup:
    """Escape a citation and make its DOI a link: a page that links needs no network itself."""
    return Markup(
        _DOI.sub(
            lambda found: (
                f'<a href="https://doi.org/{quote(found[1], safe="/.()-;")}">doi:{found[1]}</a>'
            ),
            str(escape(shown(citation))),
        )
    )


def _breakable(name: str) -> Markup:
    """Let a long name or address be broken behind its underscores, and before its variants."""
    return Markup(re.sub(r"([_@,])", r"\1<wbr>", str(escape(shown(name)))))


def _overview(run: Run, prefix: str, place: _Place, *, share: float) -> _Section:
    """Describe a run on several datasets, whose pictures and figures stand on own pages."""
    parts = parts_of(run)
    over = over_datasets(parts)
    empty = replace(run, record=replace(run.record, cells=()))
    return replace(
        _section(empty, prefix, place, share=share),
        run=run,
        title=run.record.name,
        limits=limits(run),
        results=results(run),
        diagram=Markup(run_diagram(next(iter(parts.values())))),
        citations=citations(run),
        datasets=dataset_table(parts, place.pages),
        curves=curves_over(parts),
        over=over,
        leads=who_leads(over, len(parts)),
    )


def _section(run: Run, prefix: str, place: _Place, *, share: float) -> _Section:
    # The baseline's stand first: they are what the numbers beside them are of.
    baseline = {cell.address for cell in baseline_cells(run)}
    orthoimages, walls = (
        sorted(pictures(run, share=share), key=lambda picture: picture.cell not in baseline)
        for pictures in (orthoimage_pictures, wall_pictures)
    )
    # Files are named from where the page will lie.
    from_page = Path(os.path.relpath(run.folder, place.folder))
    numbered = [
        replace(
            picture,
            id=f"{prefix}picture-{index}",
            file=(from_page / picture.file).as_posix() if picture.file else "",
        )
        for index, picture in enumerate([*orthoimages, *walls])
    ]
    orthoimages, walls = numbered[: len(orthoimages)], numbered[len(orthoimages) :]
    every = _Part(
        cells=tuple(cell for cell in run.record.cells if cell.repeat == 0),
        orthoimages=tuple(orthoimages),
        walls=tuple(walls),
        overlays=_grounded(run, walls, share=share),
        planes=plane_tables(run),
        figures=figure_groups(run, share=share, with_files=place.has_figures),
    )
    main = baseline_addresses(run)
    on_show = next((picture.name for picture in every.of(main).orthoimages), "")
    is_measured = says_how_far_off(run)
    shown_ways = ways(run, prefix)
    comparison = comparison_table([run])
    return _Section(
        run=run,
        prefix=prefix,
        answers=answers(run),
        is_measured=is_measured,
        is_unfinished=any(is_missing(cell) for cell in run.record.cells),
        uncounted=uncounted_points(run) if on_show and not is_measured else None,
        limits=limits(run, on_show),
        delivered=delivered_walls(run.folder / PRODUCTS_FOLDER) if on_show else (),
        results=results(run),
        comparison=comparison,
        curves=curves(run) if comparison else (),
        common_points=common_points(run) if comparison else (),
        main=every.of(main),
        earlier=improved_on(run, main),
        ways=tuple((way, every.of(way.cells)) for way in shown_ways) if comparison else (),
        sliders=_slider_data(numbered, len(orthoimages)),
        places=cursor_places(orthoimages, walls),
        photos=_photo_names(run),
        plan=photo_plan(run, walls),
        # Built from escaped parts only, as the overlays are.
        diagram=Markup(run_diagram(run)),
        record_file=(from_page / run.file_name).as_posix(),
        citations=citations(run),
        viewers={
            text: (from_page / page).as_posix()
            for text, page in _VIEWERS.items()
            if (run.folder / page).is_file()
        },
        files=_files(run, from_page),
        title=place.title if place.whole else run.record.name,
        whole=place.whole,
        doubt=place.doubts.get(run.path, ""),
    )


def _grounded(run: Run, walls: Sequence[Picture], *, share: float) -> tuple[_Ground, ...]:
    """What is drawn over pictures of walls, each with the picture that it lies over."""
    grounds = {(picture.cell, picture.wall): picture.id for picture in reversed(walls)}
    return tuple(
        _Ground(
            svg=Markup(overlay.svg),
            title=overlay.title,
            caption=overlay.caption,
            ground=grounds.get((overlay.walls_cell, overlay.wall), ""),
            cell=overlay.cell,
            wall=overlay.name,
            check_rms_mm=overlay.check_rms_mm,
        )
        for overlay in overlays(run, walls, share=share)
    )


def _files(run: Run, from_page: Path) -> dict[str, dict[str, str]]:
    """The files that cells published: address -> name -> where it lies from the page."""
    published = {file.path for file in run.record.published}
    found = {
        address: {
            path.name: (from_page / PRODUCTS_FOLDER / path.parent.name / path.name).as_posix()
            for path in files
            if path.name != METRICS_FILE and path.relative_to(run.folder).as_posix() in published
        }
        for address, files in run.files.items()
    }
    return defaultdict(dict, {address: files for address, files in found.items() if files})


def _photo_names(run: Run) -> tuple[str, ...]:
    """Names of the photos that were oriented, or were to be."""
    places = embedded_products(run, "cameras")
    found = [Cameras.from_payload(payload) for payload in run.payloads(places)]
    return tuple(sorted({camera.photo for cameras in found for camera in cameras.cameras}))


def _slider_data(pictures: Sequence[Picture], n_orthoimages: int) -> list[dict[str, object]]:
    """What the page's script needs to know of pictures that show the same place."""
    return [
        {
            "name": shown(slider.name),
            "ratio": slider.ratio,
            "pictures": [
                {
                    "id": pictures[laid.picture].id,
                    "title": shown(laid.title),
                    "layer": shown(pictures[laid.picture].layer),
                    "left": laid.left,
                    "top": laid.top,
                    "width": laid.width,
                    "height": laid.height,
                }
                for laid in slider.pictures
            ],
        }
        for slider in sliders(pictures, n_orthoimages)
    ]
