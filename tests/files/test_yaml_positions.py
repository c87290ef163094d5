"""YAML with positions: every value knows its place, and what is odd is a problem with its own."""

from __future__ import annotations

import pytest
from syrupy.assertion import SnapshotAssertion

from orthoflow.files.yaml_positions import MOST_VALUES, Document, Position, read_yaml


class Problems:
    def __init__(self) -> None:
        self.found: list[tuple[int, int, str, str]] = []

    def add(self, position: Position, path: str, message: str) -> None:
        self.found.append((position.line, position.column, path, message))


def problems_of(text: str, most_values: int = MOST_VALUES) -> list[tuple[int, int, str, str]]:
    problems = Problems()
    read_yaml(text, problems, most_values)
    return problems.found


def read(text: str, most_values: int = MOST_VALUES) -> Document:
    assert not problems_of(text, most_values)
    value = read_yaml(text, Problems(), most_values)
    assert value is not None
    return value


def test_every_value_knows_its_line_and_column() -> None:
    document = read("a: 1\nlist:\n  - x\n  - {deep: 2.5}\n")
    assert document.value == {"a": 1, "list": ["x", {"deep": 2.5}]}
    deep = ("list", 1, "deep")
    assert document.position(("list",), at_key=True) == Position(line=2, column=1)
    assert document.position(("list",)) == Position(line=3, column=3)
    assert document.position(("list", 0)) == Position(line=3, column=5)
    assert document.position(deep, at_key=True) == Position(line=4, column=6)
    assert document.position(deep) == Position(line=4, column=12)
    assert (document.get(deep), document.get(("b",)), document.get(("list", 7))) == (
        2.5,
        None,
        None,
    )
    # What is missing stands where it would be written, and a single value has no index.
    assert document.position(("list", 1, "b", "c")) == document.position(("list", 1))
    assert document.resolve(("a", 0)) == (("a",), ("a",))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        # The table of the core schema, YAML 1.2.2 section 10.3.2, and what is close to it.
        *((text, None) for text in ("null", "Null", "NULL", "~", "")),
        *((text, True) for text in ("true", "True", "TRUE")),
        *((text, False) for text in ("false", "False", "FALSE")),
        *(("12", 12), ("-12", -12), ("+12", 12), ("014", 14), ("0o14", 12), ("0xC", 12)),
        *(("0xc", 12), ("0o17", 15), ("0", 0), ("-0", 0)),
        *((".5e-1", 0.05), ("-.5", -0.5), ("1e3", 1000.0), ("12e03", 12000.0), ("-2E+05", -2e5)),
        *(("5.", 5.0), ("+12.3", 12.3), ("1.e2", 100.0), ("0.1", 0.1)),
        *((text, float("inf")) for text in (".inf", ".Inf", ".INF", "+.inf")),
        *(("-.inf", float("-inf")), ("-.INF", float("-inf"))),
        *(
            (text, text)
            for text in (
                *("1_000", "0b11", "-0o14", "-0x1F", "0o18", "0xG", "1e", ".e1", "1.2.3", "12:30"),
                *("yes", "no", "on", "off", "y", "n", "tRUE", "nULL", "inf", "nan", ".iNf"),
                *("2001-01-01", "1,5", "0x", "0o", "1e-", "."),
            )
        ),
        ("'12'", "12"),
        ('"true"', "true"),
        ("!!float 3", 3.0),
        ("!!str 3", "3"),
    ],
)
def test_plain_values_are_those_of_yaml_1_2(text: str, value: object) -> None:
    found = read(f"a: {text}").get(("a",))
    assert found == value
    assert type(found) is type(value)


# The last two: over two lines nothing is a key, nor what has more letters than YAML lets keys have.
ODD = (
    "",
    "a: 1\na: 3",
    "a: {3: x}",
    "a: {~: x}",
    "a:\n  ? [x]\n  : 1",
    "a: {: x}",
    "a: [x, !foo y]",
    "a: !foo {b: 1}",
    "b: !foo [1]",
    f"a: 0x{'1' * 999}",
    "a: &b {c: *b}",
    "%YAML 1.1\n---\na: 1",
    "a: {b: 0,003}",
    "a: {b: 0,5, c: 1}",
    "a: [1, 0,05]",
    "a: {b:[1, 2]}",
    "a: 1\n b: 2",
    "a: \x01",
    "a:\n\tb: 1",
    "a:\n    b: 1\n  c: 2",
    "a:\n  b: [1, 2\nc: }",
    "a: {b: 1\n",
    "\na: 'b\n",
    "a\nb: 1",
    "k" * 1025 + ": 1",
)


def test_what_is_odd_is_told_with_its_place(snapshot: SnapshotAssertion) -> None:
    assert [(ascii(text)[:40], *problems_of(text)) for text in ODD] == snapshot


def test_a_document_has_a_largest_number_of_values_aliases_expanded() -> None:
    assert read("[1, 2, 3, 4, 5, 6]", 7).value == [1, 2, 3, 4, 5, 6]
    assert problems_of("[1, 2, 3, 4, 5, 6, 7]", 7)[0][3] == "the document has more than 7 values"
    assert problems_of("[&a [1, 2], *a, *a]", 7)[0][3] == (
        "the document has more than 7 values once aliases are expanded"
    )
    # A key that YAML 1.1 gave a meaning is one as any other.
    assert read("a: {<<: {x: 1}}").value == {"a": {"<<": {"x": 1}}}


@pytest.mark.parametrize("marks", ["[]", "{}"], ids=["lists", "mappings"])
@pytest.mark.parametrize(("depth", "is_read"), [(60, True), (61, False)])
def test_sixty_levels_are_the_most(marks: str, depth: int, is_read: bool) -> None:
    one = marks[0] if marks == "[]" else "{a: "
    text = one * depth + "1" + marks[1] * depth
    if is_read:
        read(text)
        # Beside each other they are no deeper.
        read("\n".join(f"- {text.replace(one, '', 1)[:-1]}" for _ in range(5)))
        return
    (problem,) = problems_of(text)
    assert problem[3] == "the document is nested deeper than 60 levels"


def test_aliases_lead_no_deeper_than_brackets() -> None:
    def nested(n_around: int) -> str:
        return f"[&a {'[' * 30}1{']' * 30}, {'[' * n_around}*a{']' * n_around}]"

    read(nested(29))
    (problem,) = problems_of(nested(30))
    assert problem[3] == "the document is nested deeper than 60 levels"
