"""The text of a workflow: finding and reading the file, and problems with their places in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NoReturn, TypeAlias, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from orthoflow.catalog.wording import did_you_mean
from orthoflow.errors import ArgumentError, OrthoflowError, PluginError, WorkflowError
from orthoflow.files.regular_files import open_file
from orthoflow.files.yaml_positions import (
    Entry,
    Listing,
    Position,
    Table,
    Value,
    describe,
    plain,
    read_yaml,
)
from orthoflow.products.product import JsonValue
from orthoflow.workflow.model import FORMAT_TOO_NEW, NOT_A_NAME, annotation_at

MOST_BYTES: Final = 400_000
MOST_PROBLEMS: Final = 100
_SNIPPET_WIDTH: Final = 120
_INSTALLED: Final = Path(__file__).parent / "shipped"
_CHECKOUT: Final = Path(__file__).parents[2] / "workflows"

# Keys and indices that lead to a value: `("steps", "wall", "in", "cloud", 0)`.
Location: TypeAlias = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)


# Finding and reading ------------------------------------------------------------------------------


def shipped_workflows() -> dict[str, Path]:
    """Return all shipped recipes by name, e.g. `direct` -> .../direct.yaml."""
    folder = _INSTALLED if _INSTALLED.is_dir() else _CHECKOUT
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def shipped_workflow(name: str) -> Path:
    """Return the shipped recipe of a name: `direct`, `direct.yaml` or `workflows/direct.yaml`.

    Raises:
        WorkflowError: there is none.
    """
    recipes = shipped_workflows()
    wanted = Path(name)
    stem = wanted.name.removesuffix(".yaml")
    if wanted.parent in (Path(), Path("workflows")) and stem in recipes:
        return recipes[stem]
    raise WorkflowError(
        f"there is no workflow file {name} and no shipped workflow of that name"
        f"{did_you_mean(stem, recipes)}; shipped: {', '.join(recipes)}"
    )


def find_workflow(name_or_path: str | Path) -> Path:
    """Return an existing file, else the shipped recipe of that name.

    Raises:
        WorkflowError: there is neither.
    """
    path = Path(name_or_path)
    return path if path.is_file() else shipped_workflow(str(name_or_path))


def read_text(path: Path, what: str = "a workflow file", most_bytes: int = MOST_BYTES) -> str:
    """Read a text file of bounded size.

    Raises:
        WorkflowError: it cannot be read, is too large, or is no UTF-8.
    """
    try:
        # No more than is looked at: what was named by mistake may be a scan.
        with open_file(path) as stream:
            content = stream.read(most_bytes + 1)
    except OSError as error:
        raise WorkflowError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) > most_bytes:
        raise WorkflowError(f"{path} is too large: {what} has at most {most_bytes} bytes")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        column = error.start - content.rfind(b"\n", 0, error.start)
        raise WorkflowError(
            f"{path}:{line}:{column}: expected UTF-8 text, got the byte "
            f"0x{content[error.start]:02x}; save the file as UTF-8"
        ) from error


# Problems -----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One thing that is wrong.

    Attributes:
        file: the workflow file as the user named it, or the command-line option.
        line: from 1; 0 for a command-line option.
        column: from 1; 0 for a command-line option.
        path: where in the document, keys joined by dots, e.g. `steps.wall.params.gsd_m`.
        message: one sentence.
        text: the offending line, empty for a command-line option.
    """

    file: str
    line: int = 0
    column: int = 0
    path: str = ""
    message: str
    text: str = ""

    @property
    def place(self) -> str:
        """Where it is, as the sentence begins: `hall.yaml:3:9: steps.wall: `."""
        where = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        return f"{where}: {self.path}: " if self.path else f"{where}: "

    def __str__(self) -> str:
        head = f"{self.place}{self.message}"
        # Around the column, so that a line of a thousand characters does not bury the message.
        is_long = len(self.text) > _SNIPPET_WIDTH
        start = max(0, self.column - 1 - _SNIPPET_WIDTH // 2) if is_long else 0
        cut = self.text[start : start + _SNIPPET_WIDTH]
        shown = "".join(char if char.isprintable() else " " for char in cut)
        if not shown.strip():
            return head
        indent = len(shown) - len(shown.lstrip())
        caret = " " * max(0, self.column - 1 - start - indent) + "^"
        return f"{head}\n    {shown.strip()}\n    {caret}"


class _ProblemsError(OrthoflowError):
    """Some problems, a line each or more; `problems` holds them for tools."""

    def __init__(self, problems: tuple[Problem, ...]) -> None:
        self.problems = problems
        super().__init__("\n".join(str(problem) for problem in problems))


class InvalidWorkflowError(_ProblemsError, WorkflowError):
    """A workflow file has problems."""


class UnusablePluginError(_ProblemsError, PluginError):
    """A workflow is fine, but plugins it needs are not; `problems` names where it needs them."""


class InvalidArgumentsError(_ProblemsError, ArgumentError):
    """Command-line options do not fit the workflow."""


@dataclass
class ProblemLog:
    """Collects problems while a workflow is read.

    Attributes:
        file: the workflow file as the user named it.
        lines: its text.
        tree: its values with their positions, None before it is parsed.
        unnamed: the first key of locations, where paths do not state it.
    """

    file: str
    lines: tuple[str, ...] = ()
    tree: Value | None = None
    unnamed: str = ""
    _in_file: list[Problem] = field(default_factory=list)
    _in_plugins: list[Problem] = field(default_factory=list)
    _in_inputs: list[Problem] = field(default_factory=list)
    _in_options: list[Problem] = field(default_factory=list)

    def parse(self, text: str) -> Value | None:
        """Parse YAML; what is wrong with it is added, None when nothing can be read."""
        self.tree = read_yaml(text, self)
        return self.tree

    def beside(self, file: str, text: str) -> ProblemLog:
        """Return a log of another file, whose problems are raised together with these."""
        return replace(self, file=file, lines=tuple(text.splitlines()), tree=None, unnamed="")

    @property
    def has_any(self) -> bool:
        """Whether there is a problem."""
        return bool(self._in_file or self._in_plugins or self._in_options)

    def add(self, position: Position, path: str, message: str) -> None:
        """Add a problem at a position.

        Raises:
            InvalidWorkflowError: there are so many that the file must be something else.
        """
        problem = self._at(position, path, message)
        if problem in self._in_file:
            return
        if len(self._in_file) == MOST_PROBLEMS:
            message = f"more than {MOST_PROBLEMS} problems; correct those above and try again"
            self._in_file.append(self._at(position, path, message))
            self._raise()
        self._in_file.append(problem)

    def report(
        self,
        location: Location,
        message: str,
        *,
        at_key: bool = False,
        shown: Location | None = None,
    ) -> None:
        """Add a problem of the value, or of the key, at a location in the tree.

        Args:
            location: where it is in the tree.
            message: one sentence.
            at_key: the position is that of the key.
            shown: the path that the problem states, where it is another.
        """
        path = self.path(location if shown is None else shown)
        self.add(self.position(location, at_key=at_key), path, message)

    def report_plugin(self, location: Location, message: str) -> None:
        """Add a problem of a plugin that the file needs here."""
        problem = self._at(self.position(location), self.path(location), message)
        if problem not in self._in_plugins:
            self._in_plugins.append(problem)

    def report_input(self, place: Problem | None, message: str) -> None:
        """Add a problem of input files; the file itself decides the kind of the error."""
        if len(self._in_inputs) < MOST_PROBLEMS:
            nowhere = Problem(file=self.file, message="")
            self._in_inputs.append(replace(place or nowhere, message=message))

    def report_option(self, option: str, message: str) -> None:
        """Add a problem of a command-line option, e.g. `--set wall.gsd_m=0`."""
        problem = Problem(file=option, message=message)
        if problem not in self._in_options:
            self._in_options.append(problem)

    def place(self, location: Location) -> Problem | None:
        """Return a problem without its message; None where the value comes from no file."""
        position = self.position(location)
        return self._at(position, self.path(location), "") if position.line else None

    def position(self, location: Location, *, at_key: bool = False) -> Position:
        """Return the position of a value, of the nearest one around it where there is none."""
        steps = self._walk(location)
        if at_key and steps and isinstance(steps[-1][1], Entry):
            return steps[-1][1].position
        if steps:
            return steps[-1][0].position
        return self.tree.position if self.tree else Position(line=1, column=1)

    def path(self, location: Location) -> str:
        """Write a location: `steps.wall.in.cloud[1]`, without the index of what is no list."""
        path, value = "", self.tree
        for part in location:
            if isinstance(part, int):
                if value is not None and not isinstance(value, Listing):
                    continue
                path += f"[{part}]"
            elif part != self.unnamed or value is not self.tree:
                path = f"{path}.{part}" if path else part
            value = _inside(value, part)[0]
        return path

    def value(self, location: Location) -> Value | None:
        """Return the value at a location; None where there is none."""
        value = self.tree
        for part in location:
            if isinstance(part, int) and not isinstance(value, Listing):
                continue
            value = _inside(value, part)[0]
        return value

    def _walk(self, location: Location) -> list[tuple[Value, Entry | None]]:
        found: list[tuple[Value, Entry | None]] = []
        value = self.tree
        for part in location:
            value, entry = _inside(value, part)
            if value is None:
                break
            found.append((value, entry))
        return found

    def raise_any(self) -> None:
        """End with all problems found so far, if there are any.

        Raises:
            InvalidWorkflowError: the file has problems.
            InvalidArgumentsError: only command-line options have.
            UnusablePluginError: only plugins have.
        """
        if self.has_any:
            self._raise()

    def _raise(self) -> NoReturn:
        in_order = sorted(
            self._in_file + self._in_plugins + self._in_inputs,
            key=lambda problem: (problem.file, problem.line, problem.column),
        )
        everything = tuple(in_order + self._in_options)
        if self._in_file:
            raise InvalidWorkflowError(everything)
        if self._in_options:
            raise InvalidArgumentsError(everything)
        raise UnusablePluginError(everything)

    def _at(self, position: Position, path: str, message: str) -> Problem:
        text = self.lines[position.line - 1] if 0 < position.line <= len(self.lines) else ""
        return Problem(
            file=self.file,
            line=position.line,
            column=position.column,
            path=path,
            message=message,
            text=text,
        )


def _inside(value: Value | None, part: str | int) -> tuple[Value | None, Entry | None]:
    """Return what a key or an index leads to, and the entry of a key."""
    if isinstance(value, Table):
        entry = value.get(str(part))
        return (entry.value, entry) if entry else (None, None)
    if isinstance(value, Listing) and isinstance(part, int) and part < len(value.items):
        return value.items[part], None
    return None, None


# Models -------------------------------------------------------------------------------------------


def validate(
    model: type[Model], data: JsonValue, log: ProblemLog, location: Location = ()
) -> Model | None:
    """Validate what a document holds; all that does not fit is reported at its place.

    What does not fit is then left out, so that the checks that follow see all the rest.

    Args:
        model: what is expected.
        data: the value at the location.
        log: has the tree of the document, and takes the problems.
        location: of the value in the tree.

    Returns:
        The model of all that fits; None where the whole does not.
    """
    is_first = True
    while True:
        try:
            return model.model_validate(data)
        except ValidationError as error:
            details = error.errors(include_url=False)
        if is_first:
            for one in _told_once(details):
                _report(model, one, log, location)
        is_first = False
        unfit = sorted({_unfit(data, one["loc"]) for one in details}, key=repr, reverse=True)
        if () in unfit:
            return None
        for parts in unfit:
            _remove(data, parts)


def _told_once(details: Sequence[ErrorDetails]) -> list[ErrorDetails]:
    """Leave out what follows from another problem: a list that is short of the items in it."""
    locs = [one["loc"] for one in details]
    keys = [loc[:-1] for loc in locs if loc and loc[-1] == "[key]"]
    return [
        one
        for one, loc in zip(details, locs, strict=True)
        if not (
            any(len(other) > len(loc) and other[: len(loc)] == loc for other in locs)
            or any(loc[: len(key)] == key and loc[-1] != "[key]" for key in keys)
        )
    ]


def _unfit(data: Any, loc: Location) -> Location:
    """Return the location of what has to be left out: the innermost value that is there."""
    for index, part in enumerate(loc):
        is_there = (isinstance(data, dict) and part in data) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        )
        if not is_there:
            return loc[:index]
        data = data[part]
    return loc


def _remove(data: Any, parts: Location) -> None:
    for part in parts[:-1]:
        data = data[part]
    del data[parts[-1]]


def _report(
    model: type[BaseModel], details: ErrorDetails, log: ProblemLog, location: Location
) -> None:
    loc = details["loc"]
    kind = details["type"]
    if loc and loc[-1] == "[key]":
        log.report((*location, *loc[:-1]), details["msg"], at_key=True)
        return
    here = (*location, *loc)
    if kind == "extra_forbidden":
        owner, _ = annotation_at(model, loc[:-1])
        known = _keys(owner) if isinstance(owner, type) else ()
        name = str(loc[-1])
        log.report(
            here,
            f"unknown key {name}{did_you_mean(name, known)}; known here: {', '.join(known)}",
            at_key=True,
        )
        return
    value = log.value(here)
    got = describe(value) if value is not None else "nothing"
    if kind in {FORMAT_TOO_NEW, NOT_A_NAME}:
        log.report(here, details["msg"])
        return
    _, expected = annotation_at(model, loc)
    if kind == "literal_error":
        choices = expected.choices
        text = got if value is None else plain(value)
        log.report(
            here,
            f"unknown {loc[-1]} {text}{did_you_mean(str(text), choices)}; known: "
            f"{', '.join(choices)}",
        )
    elif kind == "too_short" and isinstance(value, Listing) and not value.items:
        log.report(here, f"expected at least one {expected.noun}, got an empty list")
    else:
        words = expected.words
        if kind == "too_short":
            got = str(len(value.items)) if isinstance(value, Listing) else "an empty mapping"
        elif kind == "too_long":
            words = f"at most {details['ctx']['max_length']} of them"
            got = str(details["ctx"]["actual_length"])
        log.report(here, f"expected {words}, got {got}")


def _keys(model: type[BaseModel]) -> tuple[str, ...]:
    return tuple(field.alias or name for name, field in model.model_fields.items())


def as_plain(value: Value | None) -> JsonValue:
    """Return a value without positions; None for nothing."""
    return None if value is None else plain(value)
