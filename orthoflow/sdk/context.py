"""What a method gets besides its inputs: a seeded generator, a scratch folder, and listeners."""

from __future__ import annotations

import inspect
import math
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Final, Literal, ParamSpec, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray
from orthoflow_provenance.document import COSTS, Figure, Metric, UnsafeFileError
from orthoflow_provenance.paths import colliding, path_below

from orthoflow.diagnostics import (
    PLAIN_WARNING,
    TOO_MANY,
    Diagnostic,
    DiagnosticSpec,
    warning_texts,
)
from orthoflow.errors import CancelledStepError, ProductError
from orthoflow.sdk.lines import is_name, one_line
from orthoflow.untrusted_text import MOST_SVG_BYTES, is_plain_svg

__all__ = ["Drawing", "DrawnFigure", "Metric", "StepContext", "StepEvent"]

# Of every step, whatever its method.
MEASURED_BY_THE_ENGINE: Final = tuple(COSTS)
_MEDIA_TYPES: Final = {".png": "image/png", ".webp": "image/webp", ".svg": "image/svg+xml"}
# Far above what a step can have to say; far below what a record or a terminal suffers from.
_MOST_METRICS: Final = 20_000
_MOST_FIGURES: Final = 2_000
_MOST_DIAGNOSTICS: Final = 1_000
_LARGEST_FIGURE: Final = 64 << 20
_SAID_WHERE: Final = re.compile(r" \([^()]+:\d+\)$")
_Given = ParamSpec("_Given")
_HEAD_BYTES: Final = 16  # by which a picture is known


def _names_the_line(report: Callable[_Given, None]) -> Callable[_Given, None]:
    """Add to an error about a report the line of source that reported it."""

    @wraps(report)
    def located(*args: _Given.args, **kwargs: _Given.kwargs) -> None:
        try:
            report(*args, **kwargs)
        except ProductError as error:
            frame = inspect.currentframe()
            # A trial watches through a context of its own.
            while frame and (
                frame.f_code.co_filename == __file__ or args[0] is frame.f_locals.get("self")
            ):
                frame = frame.f_back
            if frame is None or _SAID_WHERE.search(str(error)):
                raise
            where = f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
            raise ProductError(f"{error} ({where})") from error

    return located


class Drawing(Protocol):
    """Anything that can write itself as an image file, such as a matplotlib figure."""

    def savefig(self, fname: Path) -> None:
        """Write the image; the suffix decides the format."""


@dataclass(frozen=True, kw_only=True)
class DrawnFigure(Figure):
    """One picture a method made, a PNG, WebP or SVG file in the scratch folder."""

    path: Path


@dataclass(frozen=True, kw_only=True)
class StepEvent:
    """What a running step reports.

    Attributes:
        kind: `progress`, `log` or `diagnostic`.
        text: one line.
        fraction: 0..1 for progress.
        diagnostic: of that kind.
    """

    kind: Literal["progress", "log", "diagnostic"]
    text: str
    fraction: float = 0.0
    diagnostic: Diagnostic | None = None


def _ignore(event: StepEvent) -> None:
    """Take an event and do nothing with it."""


def _never() -> bool:
    return False


@dataclass(kw_only=True)
class StepContext:
    """Handed to `Method.run`.

    Attributes:
        rng: generator seeded for this cell; the only source of randomness a method may use.
        cores: how many threads the method may use.
        scratch: existing empty folder, the only place a method may write to.
        listen: where progress, log lines and diagnostics go as they happen.
        is_cancelled: asks whether the step should stop.
        clock_s: seconds as `time.perf_counter`, which stand still while modules are loaded and
            kernels compiled: what a method measures of its own speed must not depend on what ran
            before. The engine states that time as `compile_s`.
        processor_s: processor seconds of all threads, and of processes that have ended, without
            those of loading and compiling: what is left to compare where others use the machine.
        metrics: what `metric` collected.
        figures: what `figure` collected.
        diagnostics: what `report` and `warn` collected.
    """

    rng: np.random.Generator
    cores: int
    scratch: Path
    listen: Callable[[StepEvent], None] = _ignore
    is_cancelled: Callable[[], bool] = _never
    clock_s: Callable[[], float] = time.perf_counter
    processor_s: Callable[[], float] = time.process_time
    metrics: list[Metric] = field(default_factory=list)
    figures: list[DrawnFigure] = field(default_factory=list)
    diagnostics: list[Diagnostic] = field(default_factory=list)
    _fraction: float = 0.0
    _named: set[str] = field(default_factory=set)
    _n_diagnostics: int = 0

    @_names_the_line
    def metric(self, name: str, value: float, unit: str) -> None:
        """Report a number about the result.

        Args:
            name: letters, digits, `-`, `_`, `.`, with its unit at the end where it has one, e.g.
                `rms_mm`.
            value: a finite number.
            unit: `mm`, `px`, `s`, ...; `1` for counts and shares.

        Raises:
            ProductError: the value is not finite, the name is none or was reported before, or
                there are too many.
        """
        self._take_name(name)
        if not is_name(unit, also_of_file=False):
            raise ProductError(
                f"the unit of metric {name} must be a word, 1 for counts and shares, "
                f"got {one_line(ascii(unit), 80)}"
            )
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise ProductError(f"metric {name} must be a number: {one_line(error)}") from error
        if not math.isfinite(number):
            raise ProductError(f"metric {name} must be finite, got {number}: leave it out instead")
        self.metrics.append(Metric(name=name, value=number, unit=unit))

    @_names_the_line
    def figure(
        self, name: str, content: bytes | Callable[[], bytes] | Drawing, caption: str = ""
    ) -> None:
        """Keep a picture for the record and the report.

        Args:
            name: short name, unique in the step; letters, digits, `-`, `_`.
            content: the bytes of a PNG, WebP or SVG file, a function that gives them and is called
                where figures are wanted, or a matplotlib figure. Charts are PNG or SVG; what looks
                like a photo is WebP, which takes a tenth of the bytes.
            caption: one sentence on what it shows.

        Raises:
            ProductError: the name has other letters or none, or a figure was drawn under it
                before, there are too many figures, or one is no picture (an SVG with script or
                links is none) or larger than 64 MiB.
        """
        _require_room("figure", len(self.figures), _MOST_FIGURES)
        path = _path_below(self.scratch / "figures", name)
        _require_letters("figure", name)
        if callable(content):
            content = content()
        suffix = _suffix(content, name) if isinstance(content, bytes) else ".png"
        path = _path_below(path.parent, f"{name}{suffix}")
        if colliding([*(figure.name for figure in self.figures), name]):
            raise ProductError(f"figure {name} was drawn twice")
        path.parent.mkdir(exist_ok=True)
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            content.savefig(path)
        if path.is_symlink() or not path.is_file() or path.stat().st_size > _LARGEST_FIGURE:
            raise ProductError(
                f"figure {name} must be a file of at most {_LARGEST_FIGURE >> 20} MiB"
            )
        if not isinstance(content, bytes):
            with path.open("rb") as file:
                _suffix(file.read(_HEAD_BYTES), name)
        media_type = _MEDIA_TYPES[path.suffix]
        self.figures.append(
            DrawnFigure(name=name, caption=one_line(caption), media_type=media_type, path=path)
        )

    def progress(self, fraction: float, text: str = "") -> None:
        """Report how far the step is, 0..1; never goes back. Stops a cancelled step.

        Raises:
            CancelledStepError: the step was asked to stop.
        """
        if self.is_cancelled():
            raise CancelledStepError("the step was cancelled")
        self._fraction = min(1.0, max(self._fraction, float(fraction)))
        self.listen(StepEvent(kind="progress", text=one_line(text), fraction=self._fraction))

    def log(self, text: str) -> None:
        """Write one line to the step's log."""
        self.listen(StepEvent(kind="log", text=one_line(text)))

    @_names_the_line
    def report(self, spec: DiagnosticSpec, *, subject: str = "", **values: object) -> None:
        """Report something that deserves attention; shown in terminal, record and report.

        After the thousandth of a step, only their number is kept.

        Args:
            spec: what it is.
            subject: what it is about, e.g. `scan 0` or `wall 3`; those of one spec are grouped.
            values: numbers and texts that its sentences name.

        Raises:
            ProductError: a value is missing, or is no number and no text.
        """
        one = spec.of(subject, values)
        self._n_diagnostics += 1
        if self._n_diagnostics <= _MOST_DIAGNOSTICS:
            self.diagnostics.append(one)
            self.listen(StepEvent(kind="diagnostic", text=one.text, diagnostic=one))
        else:
            n_more = self._n_diagnostics - _MOST_DIAGNOSTICS
            self.diagnostics[_MOST_DIAGNOSTICS:] = [TOO_MANY.of("", {"n": n_more})]

    def warn(self, text: str) -> None:
        """Report a warning that has no code, one line; `report` serves readers better."""
        self.report(PLAIN_WARNING, text=one_line(text))

    @property
    def warnings(self) -> list[str]:
        """Texts of the warnings and errors among the diagnostics."""
        return list(warning_texts(self.diagnostics))

    def cancelled(self) -> bool:
        """Whether the step was asked to stop."""
        return self.is_cancelled()

    def allocate(
        self, port: str, name: str, shape: tuple[int, ...], dtype: DTypeLike
    ) -> NDArray[np.generic]:
        """Return a zeroed array for an output too large to hold in memory twice.

        The array lies in a file of the scratch folder and is mapped into memory, so that it does
        not count against the memory of the step while it is filled.

        Args:
            port: output port.
            name: field of the product, or a name of your own for intermediate data.
            shape: shape of the array.
            dtype: numpy type.

        Raises:
            OSError: the disk has no room for it.
            ProductError: no file can have the name.
        """
        file_name = f"{port}.{name.replace('/', '.')}"
        size_bytes = math.prod(shape) * np.dtype(dtype).itemsize
        if np.dtype(dtype).hasobject or min(shape, default=0) < 0:
            raise ProductError(f"an array cannot be of type {np.dtype(dtype)} and shape {shape}")
        if size_bytes == 0:
            return np.zeros(shape, dtype=dtype)
        path = _path_below(self.scratch / "allocated", file_name)
        path.parent.mkdir(exist_ok=True)
        with path.open("wb") as file:
            # Writing into the hole of a sparse file on a full disk would kill the process.
            os.posix_fallocate(file.fileno(), 0, size_bytes)
        return np.memmap(path, dtype=np.dtype(dtype), mode="r+", shape=shape)

    def _take_name(self, name: object) -> None:
        if not is_name(name):
            raise ProductError(
                f"a metric must have a name of one printable line, without `/` and of at most 200 "
                f"bytes, got {one_line(ascii(name), 80)}"
            )
        _require_letters("metric", name)
        if name in self._named:
            raise ProductError(f"metric {name} was reported twice")
        _require_room("metric", len(self.metrics), _MOST_METRICS)
        self._named.add(str(name))


def _require_room(what: str, n_before: int, most: int) -> None:
    if n_before >= most:
        raise ProductError(f"a step may report {most} {what}s, not more")


def _require_letters(what: str, name: object) -> None:
    if strange := "".join(dict.fromkeys(re.sub(r"[\w.-]", "", str(name)))):
        raise ProductError(
            f"the name of a {what} has letters, digits, `-`, `_` and `.`, got {strange!r} in "
            f"{one_line(ascii(name), 80)}"
        )


def _path_below(folder: Path, name: object) -> Path:
    if not isinstance(name, str):
        raise ProductError(f"the name of a file must be a text, got {one_line(ascii(name), 80)}")
    try:
        return path_below(folder, name)
    except UnsafeFileError as error:
        raise ProductError(str(error)) from error


def _suffix(picture: bytes, name: str) -> str:
    if picture.startswith(b"\x89PNG\r\n\x1a\n"):
        return ".png"
    if picture[:4] == b"RIFF" and picture[8:12] == b"WEBP":
        return ".webp"
    if not is_plain_svg(picture):
        raise ProductError(
            f"figure {name} must be a PNG, a WebP or a plain SVG (no script, no link, no file from "
            f"elsewhere, at most {MOST_SVG_BYTES // 1_000_000} MB), got what begins with "
            f"{picture[:_HEAD_BYTES]!r}"
        )
    return ".svg"
