"""The context of a step: random generator, scratch folder, metrics, figures and progress."""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, Protocol

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

__all__ = ["Drawing", "DrawnFigure", "Metric", "StepContext", "StepEvent"]

# Metrics that the engine measures for every step.
MEASURED_BY_THE_ENGINE: Final = tuple(COSTS)
_MEDIA_TYPES: Final = {".png": "image/png", ".webp": "image/webp"}
# Maximum number of diagnostics of a step: more than any step needs, but few enough for a terminal.
_MOST_DIAGNOSTICS: Final = 1_000
_LARGEST_FIGURE: Final = 64 << 20
_HEAD_BYTES: Final = 16  # signature of an image file
_NAME: Final = re.compile(r"\w[\w.-]{0,199}")


class Drawing(Protocol):
    """An object that can write itself to an image file, such as a matplotlib figure."""

    def savefig(self, fname: Path) -> None:
        """Write the image to a file, whose suffix determines the format."""


@dataclass(frozen=True, kw_only=True)
class DrawnFigure(Figure):
    """A figure of a method: a PNG or WebP file in the scratch folder."""

    path: Path


@dataclass(frozen=True, kw_only=True)
class StepEvent:
    """An event reported by a running step.

    Attributes:
        kind: `progress`, `log` or `diagnostic`.
        text: one line.
        fraction: progress, 0 to 1, if `kind` is `progress`.
        diagnostic: the diagnostic, if `kind` is `diagnostic`.
    """

    kind: Literal["progress", "log", "diagnostic"]
    text: str
    fraction: float = 0.0
    diagnostic: Diagnostic | None = None


def _ignore(event: StepEvent) -> None:
    """Ignore an event."""


def _never() -> bool:
    return False


@dataclass(kw_only=True)
class StepContext:
    """The context passed to `Method.run`.

    Attributes:
        rng: generator seeded for this cell; methods must not use other sources of randomness.
        cores: maximum number of threads of the method.
        scratch: existing empty folder; methods must not write elsewhere.
        listen: receives progress, log lines and diagnostics.
        is_cancelled: returns whether the step should stop.
        clock_s: like `time.perf_counter`, but excludes the time spent on loading modules and
            compiling kernels, which depends on earlier steps. The engine reports that time as
            `compile_s`.
        processor_s: returns the CPU time of all threads and of ended child processes in seconds,
            without that of loading modules and compiling kernels. Other programs on the machine
            hardly affect it.
        metrics: metrics reported by `metric`.
        figures: figures reported by `figure`.
        diagnostics: diagnostics reported by `report` and `warn`.
        drawing_s: elapsed time and CPU time in seconds spent on figures; the engine subtracts them
            from those of the method.
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
    drawing_s: tuple[float, float] = (0.0, 0.0)
    _fraction: float = 0.0
    _named: set[str] = field(default_factory=set)
    _n_diagnostics: int = 0

    def metric(self, name: str, value: float, unit: str) -> None:
        """Report a metric.

        Args:
            name: letters, digits, `-`, `_` and `.`; ends with the unit if there is one, e.g.
                `rms_mm`.
            value: a finite number.
            unit: a unit such as `mm`, `px` or `s`; `1` for counts and shares.

        Raises:
            ProductError: the value is not finite, or the name is invalid or was reported before.
        """
        _require_name("metric", name)
        if name in self._named:
            raise ProductError(f"metric {name} was reported twice")
        if not is_name(unit, also_of_file=False):
            raise ProductError(
                f"the unit of metric {name} must be a word, or 1 for counts and shares; got "
                f"{one_line(ascii(unit), 80)}"
            )
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise ProductError(f"metric {name} must be a number: {one_line(error)}") from error
        if not math.isfinite(number):
            raise ProductError(
                f"metric {name} must be finite, got {number}: do not report unknown values"
            )
        self._named.add(name)
        self.metrics.append(Metric(name=name, value=number, unit=unit))

    def figure(
        self, name: str, content: bytes | Callable[[], bytes] | Drawing, caption: str = ""
    ) -> None:
        """Add a figure to the record and the report.

        Args:
            name: short name that is unique in the step; letters, digits, `-`, `_` and `.`.
            content: content of a PNG or WebP file; a function that returns this content and is
                called only if figures are needed; or a matplotlib figure. Use PNG for charts and
                WebP for images that resemble photos, since this reduces their size to a tenth.
            caption: one sentence on what the figure shows.

        Raises:
            ProductError: the name is invalid or was used before, or the content is not a PNG or
                WebP image or is larger than 64 MiB.
        """
        _require_name("figure", name)
        clock_s, processor_s = self.clock_s(), self.processor_s()
        if callable(content):
            content = content()
        suffix = _suffix(content, name) if isinstance(content, bytes) else ".png"
        try:
            path = path_below(self.scratch / "figures", f"{name}{suffix}")
        except UnsafeFileError as error:
            raise ProductError(f"figure {name}: {error}") from error
        if colliding([*(figure.name for figure in self.figures), name]):
            raise ProductError(f"figure {name} was added twice")
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
        taken_s = self.clock_s() - clock_s, self.processor_s() - processor_s
        self.drawing_s = self.drawing_s[0] + taken_s[0], self.drawing_s[1] + taken_s[1]

    def progress(self, fraction: float, text: str = "") -> None:
        """Report the progress, 0 to 1, or stop the step if it was cancelled.

        Raises:
            CancelledStepError: the step was cancelled.
        """
        if self.is_cancelled():
            raise CancelledStepError("the step was cancelled")
        self._fraction = min(1.0, max(self._fraction, float(fraction)))
        self.listen(StepEvent(kind="progress", text=one_line(text), fraction=self._fraction))

    def log(self, text: str) -> None:
        """Write a line to the log of the step."""
        self.listen(StepEvent(kind="log", text=one_line(text)))

    def report(self, spec: DiagnosticSpec, *, subject: str = "", **values: object) -> None:
        """Report a diagnostic, which appears on the terminal, in the record and in the report.

        Diagnostics of a step after the thousandth are only counted.

        Args:
            spec: the kind of diagnostic.
            subject: the object concerned, e.g. `scan 0` or `wall 3`; diagnostics with the same spec
                are grouped.
            values: numbers and strings to insert into the text and the remedy.

        Raises:
            ProductError: a value is missing, or is neither a number nor a string.
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
        """Report a one-line warning without a code; prefer `report`."""
        self.report(PLAIN_WARNING, text=one_line(text))

    @property
    def warnings(self) -> list[str]:
        """The text of each diagnostic that is a warning or an error."""
        return list(warning_texts(self.diagnostics))

    def cancelled(self) -> bool:
        """Return whether the step was cancelled."""
        return self.is_cancelled()

    def allocate(
        self, port: str, name: str, shape: tuple[int, ...], dtype: DTypeLike
    ) -> NDArray[np.generic]:
        """Return a zeroed array for an output that is too large to be held in memory twice.

        The array is memory-mapped from a file in the scratch folder, so it does not count towards
        the memory of the step while it is being filled.

        Args:
            port: output port.
            name: field of the product, or any name for intermediate data.
            shape: shape of the array.
            dtype: numpy type.

        Raises:
            OSError: the disk is full.
            ProductError: the type contains Python objects, or the shape is negative.
        """
        size_bytes = math.prod(shape) * np.dtype(dtype).itemsize
        if np.dtype(dtype).hasobject or min(shape, default=0) < 0:
            raise ProductError(
                f"cannot allocate an array of type {np.dtype(dtype)} and shape {shape}"
            )
        if size_bytes == 0:
            return np.zeros(shape, dtype=dtype)
        folder = self.scratch / "allocated"
        folder.mkdir(exist_ok=True)
        path = folder / f"{len(list(folder.iterdir()))}"
        with path.open("wb") as file:
            # Writing to a memory-mapped sparse file on a full disk would kill the process.
            os.posix_fallocate(file.fileno(), 0, size_bytes)
        return np.memmap(path, dtype=np.dtype(dtype), mode="r+", shape=shape)


def _require_name(what: str, name: object) -> None:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ProductError(
            f"the name of a {what} may contain at most 200 letters, digits, `-`, `_` and `.`, got "
            f"{one_line(ascii(name), 80)}"
        )


def _suffix(picture: bytes, name: str) -> str:
    if picture.startswith(b"\x89PNG\r\n\x1a\n"):
        return ".png"
    if picture[:4] == b"RIFF" and picture[8:12] == b"WEBP":
        return ".webp"
    raise ProductError(
        f"figure {name} must be a PNG or WebP file; its content begins with "
        f"{picture[:_HEAD_BYTES]!r}"
    )
