"""Formats of exports: which options belong to which, and what is said of those that do not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from importlib import import_module
from typing import Final

import pytest

from orthoflow.cli.export import flags
from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.formats import FORMATS, check_choices, listed
from orthoflow.errors import ArgumentError

FLAGS: Final = flags()
# Some value of each option; 0 is the first wall, and a grid of none.
GIVEN: Final[Mapping[str, object]] = {
    name: {"wall": 0, "grid": 0.0}.get(name, ("x",))
    for entry in FORMATS.values()
    for name in entry.options
}


def test_every_option_is_one_of_the_choices_and_has_a_flag() -> None:
    assert GIVEN.keys() <= FLAGS.keys() & {field.name for field in fields(Choices)}


@pytest.mark.parametrize("target", FORMATS)
def test_every_format_has_its_writer(target: str) -> None:
    module, _, name = FORMATS[target].writer.partition(":")
    assert callable(getattr(import_module(f"orthoflow.cli.exports.{module}"), name))


@pytest.mark.parametrize("name", GIVEN)
def test_an_option_goes_with_the_formats_that_it_belongs_to(name: str) -> None:
    chosen = Choices(**{name: GIVEN[name]})  # type: ignore[arg-type]
    owners = [target for target, entry in FORMATS.items() if name in entry.options]
    for target in FORMATS:
        if target in owners:
            check_choices(chosen, target, FLAGS)
            continue
        with pytest.raises(ArgumentError) as caught:
            check_choices(chosen, target, FLAGS)
        said = f"{FLAGS[name]} belongs to --to {listed(owners)}, not to --to {target}"
        assert str(caught.value) == said


def test_nothing_else_is_refused() -> None:
    for target in FORMATS:
        check_choices(Choices(), target, FLAGS)
    check_choices(Choices(embed=True), "ro-crate", FLAGS)
    check_choices(Choices(embed=True, inputs=("scan=a.laz",)), None, FLAGS)
    check_choices(Choices(split=True), None, FLAGS)


@pytest.mark.parametrize(
    ("chosen", "target", "said"),
    [
        (Choices(), None, "choose what to write: --to "),
        (Choices(split=True), "csv", "so it cannot be combined with --to csv: split first"),
        (Choices(split=True, embed=True), None, "so it cannot be combined with --embed: split fir"),
        (Choices(embed=True), "csv", "--to csv writes no record, so nothing can be embedded"),
        (Choices(inputs=("a=b",)), "csv", "--input belongs to --embed, not to --to csv"),
        (Choices(inputs=("a=b",), split=True), None, "--input belongs to --embed, not to --split"),
        (Choices(wall=1, embed=True), None, ", not to --embed"),
        (Choices(wall=1, split=True), None, ", not to --split"),
    ],
)
def test_what_contradicts_itself_is_refused(chosen: Choices, target: str | None, said: str) -> None:
    with pytest.raises(ArgumentError) as caught:
        check_choices(chosen, target, FLAGS)
    assert said in str(caught.value)
