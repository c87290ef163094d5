"""Put a photo, the scan's intensity and the finished orthoimage of a wall side by side.

    orthoflow run quickstart.yaml --embed -o runs/quickstart
    python examples/photo_and_orthoimage.py runs/quickstart picture.jpg

All data are read from the record; `--embed` stores the photos in it. The picture in the README was
made with this program.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import orthoflow
from orthoflow.files.images import decode_image, encode_jpeg, stretch_to_grey
from orthoflow.geometry import eight_bits
from orthoflow.products import Orthoimages, OrthoMask, Photos, Walls

HEIGHT_PX = 360
GAP_PX = 12


def picture_of(run_folder: Path) -> NDArray[np.uint8]:
    """Return the three images in a row on a white background, (rows, cols, 3)."""
    run = orthoflow.open_run(run_folder)
    photos = run.product("room", "photos")
    walls = run.product("wall", "walls")
    orthoimages = run.product("mosaic", "orthoimages")
    assert isinstance(photos, Photos)
    assert isinstance(walls, Walls)
    assert isinstance(orthoimages, Orthoimages)
    photo = decode_image(photos.photos[0].encoded, photos.photos[0].name)
    intensity = walls.walls[0].intensity
    assert intensity is not None
    image = orthoimages.images[0]
    shown = (image.mask == OrthoMask.PAINTED) | (image.mask == OrthoMask.FILLED)
    ortho = np.where(shown[..., None], eight_bits(image.rgb), 255).astype(np.uint8)
    columns = [photo, np.dstack([stretch_to_grey(intensity)] * 3), ortho]
    gap = np.full((HEIGHT_PX, GAP_PX, 3), 255, dtype=np.uint8)
    row: list[NDArray[np.uint8]] = []
    for column in columns:
        row += [gap, shrunk(column)]
    return np.hstack(row[1:])


def shrunk(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Reduce an image to the height of the picture by averaging."""
    import cv2

    width = round(image.shape[1] * HEIGHT_PX / image.shape[0])
    small = cv2.resize(image, (width, HEIGHT_PX), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def main() -> None:
    """Write the picture for a run."""
    if len(sys.argv) != 3:
        sys.exit("usage: python examples/photo_and_orthoimage.py RUN PICTURE.jpg")
    Path(sys.argv[2]).write_bytes(encode_jpeg(picture_of(Path(sys.argv[1]))))


if __name__ == "__main__":
    main()
