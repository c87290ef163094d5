"""Warnings of one sense are one line: a count and the first few names."""

from __future__ import annotations

import time

import pytest

from orthoflow.alike import Alike, alike, sense

PHOTOS = [f"IMG_{number}.jpg" for number in range(11)]
CAUSES = {
    "ties": "photo {}: no wall is recognised in it, so it gets no ties",
    "first": "photo {} is not oriented: only {} ties agree",
    "shots": "the EXIF data of {} are damaged; what is readable was taken",
    "orient": "photo {}: the walls show it mirrored: turn it back",
}


def test_four_causes_of_eleven_photos_are_four_lines_and_the_one_that_helps_is_first() -> None:
    said = [
        (cell, text.format(photo, number))
        for number, photo in enumerate(PHOTOS)
        for cell, text in CAUSES.items()
    ]
    found = alike(said)
    assert [item.places for item in found] == [("orient",), ("ties",), ("first",), ("shots",)]
    assert [item.count for item in found] == [11] * 4
    assert found[0].sentence == (
        "photo IMG_0.jpg: the walls show it mirrored: turn it back "
        "(11 times; also IMG_1.jpg, IMG_2.jpg, IMG_3.jpg and 7 more)"
    )
    assert found[2].text == "photo IMG_0.jpg is not oriented: only 0 ties agree"


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("wall 3: 21% of the cells have a point", "wall 12: 4.5% of the cells have a point"),
        ('no photo shows "east wall"', 'no photo shows "the floor"'),
        ("wall 3: no point", "floor: no point"),
        ("wall 3: no point", "ceiling 2: no point"),
        ("left out: a.txt", "left out: a.txt, b.txt and 3 more"),
        ("near [1.0, 2.0, 3.0]: no wall", "near [4.0, 5.5, 6.0]: no wall"),
        ("the focal length of Übersicht.jpg is unknown", "the focal length of x.tiff is unknown"),
    ],
)
def test_names_and_numbers_make_no_other_sense(one: str, other: str) -> None:
    assert sense(one) == sense(other)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("the intensity is zero", "the colours are zero"),
        ("the scanner's side is a guess", "the viewer's side is a guess"),
    ],
)
def test_other_words_make_another_sense(one: str, other: str) -> None:
    assert sense(one) != sense(other)


def test_what_is_told_of_the_others_is_what_differs() -> None:
    texts = [
        f"wall 3: photo IMG_{number}.jpg is {share}% dark" for number, share in ((1, 5), (2, 7))
    ]
    (found,) = alike([("a", text) for text in texts])
    assert found.others == ("IMG_2.jpg",)


@pytest.mark.parametrize(
    ("texts", "sentence"),
    [
        (
            ["none of the 5 planes within 1 deg", "none of the 12 planes within 1 deg"] * 2,
            "none of the 5 to 12 planes within 1 deg",
        ),
        (["-0.5 m off, 4.5% seen", "1e-3 m off, 21% seen"], "-0.5 to 1e-3 m off, 4.5% to 21% seen"),
        # With a name, the numbers are those of the first.
        (
            ["3 ties of a.jpg agree", "7 ties of a.jpg agree", "3 ties of b.jpg agree"],
            "3 ties of a.jpg agree (3 times; also b.jpg)",
        ),
    ],
    ids=["counts", "amounts", "with names"],
)
def test_no_sentence_says_the_numbers_of_one_of_all(texts: list[str], sentence: str) -> None:
    (found,) = alike([(f"check#{number}", text) for number, text in enumerate(texts)])
    assert found.sentence == sentence
    # Of one place the count tells that it was said several times.
    (alone,) = alike([("check", text) for text in texts])
    assert f"({len(texts)} times" in alone.sentence


def test_one_sentence_of_several_cells_is_said_once() -> None:
    found = alike([("wall@a=1", "no intensity"), ("wall@a=2", "no intensity")])
    assert found == (
        Alike(text="no intensity", others=(), count=2, places=("wall@a=1", "wall@a=2")),
    )
    assert (found[0].where, found[0].sentence) == ("wall@a=1 and 1 more", "no intensity")


def test_a_sentence_of_its_own_stays_as_it_is() -> None:
    assert alike([("a", "wall 3: odd")])[0].sentence == "wall 3: odd"
    assert alike([]) == ()


@pytest.mark.parametrize("letter", ["a", '"', "'", "\0", "1", ".", "a.b, "])
def test_long_texts_of_strangers_take_no_time(letter: str) -> None:
    texts = [("x", letter * (2000 // len(letter)) + str(number)) for number in range(200)]
    started = time.process_time()
    assert sum(item.count for item in alike(texts)) == 200
    assert time.process_time() - started < 20.0  # squares would take minutes
