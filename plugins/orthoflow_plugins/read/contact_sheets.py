"""All photos of a set on one small picture."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_webp

_SIDE_PX: Final = 1200
_CELL_PX: Final = 300
_LABEL_PX: Final = 18
_LETTER_PX: Final = 7
_GAP_PX: Final = 6
_MOST: Final = 100
_PAPER: Final = 245
_INK: Final = (40, 40, 40)


class ContactSheet:
    """Thumbnails with their names, in rows; photos show as they are stored, never turned."""

    def __init__(self, n_photos: int) -> None:
        self.n_photos = n_photos
        self.n_shown = min(n_photos, _MOST)
        self._columns = max(1, math.ceil(math.sqrt(self.n_shown)))
        self._cell_px = min(_CELL_PX, _SIDE_PX // self._columns)
        self._cells: list[NDArray[np.uint8]] = []

    @property
    def caption(self) -> str:
        """One sentence on what the sheet shows."""
        if self.n_shown < self.n_photos:
            return f"The first {self.n_shown} of {self.n_photos} photos, as they are stored."
        return "The photos, as they are stored."

    def add(self, name: str, image: NDArray[np.uint8]) -> None:
        """Put the next photo (rows, cols, 3) RGB on the sheet, if there is room left."""
        import cv2

        if len(self._cells) == self.n_shown:
            return
        room_px = self._cell_px - 2 * _GAP_PX
        scale = min(room_px / image.shape[1], (room_px - _LABEL_PX) / image.shape[0])
        width, height = (max(1, int(side * scale)) for side in (image.shape[1], image.shape[0]))
        shape = (height + _LABEL_PX + 2 * _GAP_PX, self._cell_px, 3)
        cell = np.full(shape, _PAPER, dtype=np.uint8)
        cell[_GAP_PX : _GAP_PX + height, _GAP_PX : _GAP_PX + width] = cv2.resize(
            image, (width, height), interpolation=cv2.INTER_AREA
        )
        place = (_GAP_PX, _GAP_PX + height + _LABEL_PX - 5)
        label = _shortened(name, room_px // _LETTER_PX)
        cv2.putText(cell, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)
        self._cells.append(cell)

    def encoded(self) -> bytes:
        """Encode the sheet as WebP; no side is longer than 1200 pixels."""
        starts = range(0, len(self._cells), self._columns)
        rows = [_in_a_row(self._cells[start : start + self._columns]) for start in starts]
        width = max(row.shape[1] for row in rows)
        height = sum(row.shape[0] for row in rows)
        sheet = np.full((height, width, 3), _PAPER, dtype=np.uint8)
        top = 0
        for row in rows:
            sheet[top : top + row.shape[0], : row.shape[1]] = row
            top += row.shape[0]
        return encode_webp(sheet)


def _in_a_row(cells: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    height = max(cell.shape[0] for cell in cells)
    row = np.full((height, sum(cell.shape[1] for cell in cells), 3), _PAPER, dtype=np.uint8)
    left = 0
    for cell in cells:
        row[: cell.shape[0], left : left + cell.shape[1]] = cell
        left += cell.shape[1]
    return row


def _shortened(name: str, n_letters: int) -> str:
    """Cut a name in the middle: photos differ at the end of theirs. OpenCV letters are ASCII."""
    label = name.encode("ascii", "replace").decode()
    if len(label) <= n_letters:
        return label
    n_end = n_letters // 2
    return f"{label[: n_letters - n_end - 2]}..{label[-n_end:]}"
