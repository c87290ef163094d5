"""What a method gets besides its inputs: a seeded generator, a scratch folder, and listeners."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray
from orthoflow_provenance.model import Figure, Metric

from orthoflow.errors import CancelledStepError, ProductError

__all__ = ["Drawing", "DrawnFigure", "Metric", "StepContext", "StepEvent"]

_MEDIA_TYPES: Final = {".png": "image/png", ".webp": "image/webp", ".svg": "image/svg+xml"}


class Drawing(Protocol):
    """Anything that can write itself as an image file, such as a matplotlib figure."""

    def savefig(self, fname: Path) -> None:
        """Write the image; the suffix decides the format."""
        raise AssertionError("a protocol is never called")


@dataclass(frozen=True, kw_only=True)
class DrawnFigure(Figure):
    """One picture a method made, a PNG, WebP or SVG file in the scratch folder."""

    path: Path


@dataclass(frozen=True, kw_only=True)
class StepEvent:
    """Something a running step says.

    Attributes:
        kind: `progress`, `log` or `warning`.
        text: one line.
        fraction: 0..1 for progress.
    """

    kind: Literal["progress", "log", "warning"]
    text: str
    fraction: float = 0.0


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
        listen: where progress, log lines and warnings go as they happen.
        is_cancelled: asks whether the step should stop.
        metrics: what `metric` collected.
        figures: what `figure` collected.
        warnings: what `warn` collected.
    """

    rng: np.random.Generator
    cores: int
    scratch: Path
    listen: Callable[[StepEvent], None] = _ignore
    is_cancelled: Callable[[], bool] = _never
    metrics: list[Metric] = field(default_factory=list)
    figures: list[DrawnFigure] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    _fraction: float = 0.0

    def metric(self, name: str, value: float, unit: str) -> None:
        """Report a number about the result.

        Args:
            name: name with its unit at the end where it has one, e.g. `rms_mm`.
            value: a finite number.
            unit: `mm`, `px`, `s`, ...; `1` for counts and shares.

        Raises:
            ProductError: the value is not finite, or the name was reported before.
        """
        number = float(value)
        if not math.isfinite(number):
            raise ProductError(f"metric {name} must be finite, got {number}")
        if any(metric.name == name for metric in self.metrics):
            raise ProductError(f"metric {name} was reported twice")
        self.metrics.append(Metric(name=name, value=number, unit=unit))

    def figure(self, name: str, content: bytes | Drawing, caption: str = "") -> None:
        """Keep a picture for the record and the report.

        Args:
            name: short name, unique in the step; letters, digits, `-`, `_`.
            content: the bytes of a PNG, WebP or SVG file, or a matplotlib figure. Charts are PNG or
                SVG; what looks like a photo is WebP, which takes a tenth of the bytes.
            caption: one sentence on what it shows.
        """
        folder = self.scratch / "figures"
        folder.mkdir(exist_ok=True)
        if isinstance(content, bytes):
            path = folder / f"{name}{_suffix(content)}"
            path.write_bytes(content)
        else:
            path = folder / f"{name}.png"
            content.savefig(path)
        media_type = _MEDIA_TYPES[path.suffix]
        self.figures.append(
            DrawnFigure(name=name, caption=caption, media_type=media_type, path=path)
        )

    def progress(self, fraction: float, text: str = "") -> None:
        """Say how far the step is, 0..1; never goes back. Stops a cancelled step.

        Raises:
            CancelledStepError: the step was asked to stop.
        """
        if self.is_cancelled():
            raise CancelledStepError("the step was cancelled")
        self._fraction = min(1.0, max(self._fraction, float(fraction)))
        self.listen(StepEvent(kind="progress", text=text, fraction=self._fraction))

    def log(self, text: str) -> None:
        """Write one line to the step's log."""
        self.listen(StepEvent(kind="log", text=text))

    def warn(self, text: str) -> None:
        """Tell the user something that limits the result; shown in terminal, record and report."""
        self.warnings.append(text)
        self.listen(StepEvent(kind="warning", text=text))

    def cancelled(self) -> bool:
        """Whether the step was asked to stop."""
        return self.is_cancelled()

    def allocate(
        self, port: str, name: str, shape: tuple[int, ...], dtype: DTypeLike
    ) -> NDArray[np.generic]:
        """Give a zeroed array for an output too large to hold in memory twice.

        The array lies in a file of the scratch folder and is mapped into memory, so that it does
        not count against the memory of the step while it is filled.

        Args:
            port: output port.
            name: field of the product, or a name of your own for intermediate data.
            shape: shape of the array.
            dtype: numpy type.

        Raises:
            OSError: the disk has no room for it.
        """
        size_bytes = math.prod(shape) * np.dtype(dtype).itemsize
        if size_bytes == 0:
            return np.zeros(shape, dtype=dtype)
        folder = self.scratch / "allocated"
        folder.mkdir(exist_ok=True)
        path = folder / f"{port}.{name.replace('/', '.')}"
        with path.open("wb") as file:
            # Writing into the hole of a sparse file on a full disk would kill the process.
            os.posix_fallocate(file.fileno(), 0, size_bytes)
        return np.memmap(path, dtype=np.dtype(dtype), mode="r+", shape=shape)


def _suffix(picture: bytes) -> str:
    if picture.startswith(b"\x89PNG"):
        return ".png"
    return ".webp" if picture[:4] == b"RIFF" and picture[8:12] == b"WEBP" else ".svg"
