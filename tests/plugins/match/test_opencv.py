"""Pictures worked on at once, and which OpenCV it was."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError

import cv2
import pytest
from orthoflow_plugins.match import opencv


@pytest.mark.parametrize(
    ("cores", "n_threads"), [(1, 1), (3, 1), (4, 1), (7, 1), (8, 2), (16, 4)], ids=str
)
def test_four_pictures_at_once_share_the_cores(
    cores: int, n_threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[int] = []
    workers: list[int] = []
    monkeypatch.setattr(cv2, "setNumThreads", told.append)

    def in_order(function: object, items: object, *, threads: int) -> list[int]:
        workers.append(threads)
        return [3, 1, 2]

    monkeypatch.setattr(opencv, "in_order", in_order)
    assert list(opencv.one_by_one(str, [1, 2, 3], cores)) == [3, 1, 2]
    assert (told, workers) == ([n_threads], [min(cores, 4)])


@pytest.mark.parametrize("installed", ["opencv-python", "opencv-python-headless", None])
def test_the_version_is_that_of_the_distribution_that_is_there(
    installed: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def version(name: str) -> str:
        if name != installed:
            raise PackageNotFoundError(name)
        return "4.9"

    monkeypatch.setattr(opencv, "version", version)
    assert opencv.opencv_version() == ({installed: "4.9"} if installed else {})
