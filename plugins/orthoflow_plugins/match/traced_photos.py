"""Photos traced on the walls, in parts: what is kept of each, and how it lies on them again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Photo, Wall
from orthoflow_plugins.match.tie_pieces import TiePiece

if TYPE_CHECKING:
    from orthoflow_plugins.match.tracing import Trace
    from orthoflow_plugins.match.warping import Before


@dataclass(frozen=True, kw_only=True)
class TracedPhoto:
    """What tracing a photo found, without its pictures.

    Attributes:
        photo: index of the photo.
        pieces: as `Trace` has them.
        n_measured: likewise.
        n_outliers: likewise.
        held_out_px: likewise.
        content: likewise.
        camera: the pose that it was traced from.
        settled: the pose in the end.
    """

    photo: int
    pieces: tuple[TiePiece, ...]
    n_measured: int
    n_outliers: int
    held_out_px: tuple[float, ...]
    content: str
    camera: ViewingCamera
    settled: ViewingCamera

    @property
    def n_ties(self) -> int:
        """Ties on all walls."""
        return sum(len(piece) for piece in self.pieces)

    @classmethod
    def of(cls, trace: Trace, camera: ViewingCamera) -> Self:
        """Keep of a trace, and of the pose that it began with, what others need."""
        return cls(
            photo=trace.view.index,
            pieces=trace.pieces,
            n_measured=trace.n_measured,
            n_outliers=trace.n_outliers,
            held_out_px=trace.held_out_px,
            content=trace.content,
            camera=camera,
            settled=trace.view.camera,
        )

    def trace(self, photo: Photo, walls: Sequence[Wall], before: Before | None) -> Trace:
        """Lay the photo onto the walls again, as it lay there in the end.

        Args:
            photo: the photo.
            walls: all walls.
            before: what stands free before them; from the first pose it hides what it hides.
        """
        from orthoflow_plugins.match.tracing import Trace
        from orthoflow_plugins.match.warping import view_of

        view = view_of(self.photo, photo, self.camera, walls, before)
        return Trace(
            pieces=self.pieces,
            n_measured=self.n_measured,
            n_outliers=self.n_outliers,
            held_out_px=self.held_out_px,
            content=self.content,
            view=view.posed(self.settled, walls),
        )


@dataclass(frozen=True, kw_only=True)
class TracedPhotos:
    """Photos on the walls.

    Attributes:
        photos: those that were traced.
        pieces: ties of all of them, of `preset: paper`, which traces none.
    """

    photos: tuple[TracedPhoto, ...] = ()
    pieces: tuple[TiePiece, ...] = ()
