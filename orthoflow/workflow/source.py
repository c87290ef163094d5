"""Finds and reads the text of a workflow, and collects its problems."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, NoReturn, TypeAlias, TypeVar

from pydantic import BaseModel, ValidationError

from orthoflow.errors import ArgumentError, OrthoflowError, PluginError, WorkflowError, did_you_mean
from orthoflow.files.documents import existing, mistakes
from orthoflow.files.yaml_positions import Document, Location, Position, path_text, read_yaml
from orthoflow.products.product import JsonValue
from orthoflow.untrusted_text import open_file

#: bytes of a workflow file
MOST_BYTES: Final = 400_000
_INSTALLED: Final = Path(__file__).parent / "shipped"
_CHECKOUT: Final = Path(__file__).parents[2] / "workflows"


def shipped_workflows() -> dict[str, Path]:
    """Return name -> path of the shipped recipes, such as `direct` -> .../direct.yaml."""
    folder = _INSTALLED if _INSTALLED.is_dir() else _CHECKOUT
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def shipped_workflow(name: str) -> Path:
    """Return the path of a shipped recipe.

    The name may be `direct`, `direct.yaml` or `workflows/direct.yaml`.

    Raises:
        WorkflowError: there is no such recipe.
    """
    recipes = shipped_workflows()
    wanted = Path(name)
    stem = wanted.name.removesuffix(".yaml")
    if wanted.parent in (Path(), Path("workflows")) and stem in recipes:
        return recipes[stem]
    raise WorkflowError(
        f"there is no workflow file {name} and no shipped workflow with that name"
        f"{did_you_mean(stem, recipes)}; shipped: {', '.join(recipes)}"
    )


def find_workflow(name_or_path: str | Path) -> Path:
    """Return the path of a workflow file, or of a shipped recipe if there is no such file.

    Raises:
        WorkflowError: there is no such file or recipe.
    """
    path = Path(name_or_path)
    if path.is_file():
        return path
    if path.exists() and (path.parent != Path() or path.stem not in shipped_workflows()):
        raise WorkflowError(f"{path} is a folder or a device; give a workflow file")
    return shipped_workflow(str(name_or_path))


def read_text(path: Path, what: str = "a workflow file", most_bytes: int = MOST_BYTES) -> str:
    """Read a text file of limited size.

    Raises:
        WorkflowError: the file cannot be read, is too large, or is not UTF-8.
    """
    try:
        # Read no more than the limit, because the file may be a scan that was given by mistake.
        with open_file(path) as stream:
            content = stream.read(most_bytes + 1)
    except OSError as error:
        raise WorkflowError(f"cannot read {path}: {error.strerror}") from error
    if len(content) > most_bytes:
        raise WorkflowError(f"{path} is too large: {what} may have at most {most_bytes} bytes")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        column = error.start - content.rfind(b"\n", 0, error.start)
        raise WorkflowError(
            f"{path}:{line}:{column}: expected UTF-8 text, got the byte "
            f"0x{content[error.start]:02x}; save the file as UTF-8"
        ) from error


#: problems of a workflow that are reported at once
MOST_PROBLEMS: Final = 100
_SNIPPET_WIDTH: Final = 120
Model = TypeVar("Model", bound=BaseModel)
_Origin: TypeAlias = Literal["file", "plugin", "input", "option"]
# This value represents a document that cannot be read.
NOTHING: Final = Document(value=None, places={(): Position(line=1, column=1)})


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A problem with a workflow file or command-line option.

    Attributes:
        file: the workflow file as given by the user, or the command-line option.
        line: line number, starting at 1; 0 for a command-line option.
        column: column number, starting at 1; 0 for a command-line option.
        path: location in the document, as keys joined by dots, e.g. `steps.wall.params.gsd_m`.
        message: description of the problem, as one sentence.
        text: the line with the problem; empty for a command-line option.
    """

    file: str
    line: int = 0
    column: int = 0
    path: str = ""
    message: str
    text: str = ""

    @property
    def place(self) -> str:
        """Position as a prefix of the message, such as `hall.yaml:3:9: steps.wall: `."""
        where = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        return f"{where}: {self.path}: " if self.path else f"{where}: "

    def __str__(self) -> str:
        head = f"{self.place}{self.message}"
        # Show only the part of a long line around the column, so that the message remains visible.
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
    """Several problems; the message has one or more lines for each."""

    def __init__(self, problems: tuple[Problem, ...]) -> None:
        self.problems = problems
        super().__init__("\n".join(str(problem) for problem in problems))


class InvalidWorkflowError(_ProblemsError, WorkflowError):
    """A workflow file has problems."""


class UnusablePluginError(_ProblemsError, PluginError):
    """A workflow is valid, but needs unusable plugins; `problems` contains the positions."""


class InvalidArgumentsError(_ProblemsError, ArgumentError):
    """Command-line options do not fit the workflow."""


@dataclass
class ProblemLog:
    """Collects the problems found while a workflow is read.

    Attributes:
        file: the workflow file as given by the user.
        lines: lines of the file.
        document: values with their positions; `NOTHING` before parsing.
        unnamed: key that is omitted at the beginning of formatted locations; empty if there is
            none.
    """

    file: str
    lines: tuple[str, ...] = ()
    document: Document = NOTHING
    unnamed: str = ""
    _found: list[tuple[_Origin, Problem]] = field(default_factory=list)

    def parse(self, text: str) -> Document | None:
        """Parse YAML and add its problems; return None if the text cannot be read."""
        found = read_yaml(text, self)
        self.document = found or NOTHING
        return found

    def beside(self, file: str, text: str) -> ProblemLog:
        """Return a log for another file, whose problems are raised together with those here."""
        return replace(
            self, file=file, lines=tuple(text.splitlines()), document=NOTHING, unnamed=""
        )

    @property
    def has_any(self) -> bool:
        """Whether problems other than missing input files have been found."""
        return any(origin != "input" for origin, _ in self._found)

    def add(self, position: Position, path: str, message: str) -> None:
        """Add a problem at a position.

        Raises:
            InvalidWorkflowError: there are more than `MOST_PROBLEMS` problems.
        """
        self._add("file", self._at(position, path, message))
        if sum(origin == "file" for origin, _ in self._found) > MOST_PROBLEMS:
            more = f"more than {MOST_PROBLEMS} problems; correct those above and try again"
            self._found[-1] = ("file", self._at(position, path, more))
            self._raise()

    def _add(self, origin: _Origin, problem: Problem) -> None:
        if (origin, problem) not in self._found:
            self._found.append((origin, problem))

    def report(
        self,
        location: Location,
        message: str,
        *,
        at_key: bool = False,
        shown: Location | None = None,
    ) -> None:
        """Add a problem with a value or its key in the document.

        Args:
            location: location of the value in the document.
            message: description of the problem, as one sentence.
            at_key: whether to report the position of the key instead of that of the value.
            shown: location to show as the path of the problem, if it is another one.
        """
        path = self.path(location if shown is None else shown)
        self.add(self.position(location, at_key=at_key), path, message)

    def report_plugin(self, location: Location, message: str) -> None:
        """Add a problem with a plugin that is needed at a location in the document."""
        problem = self._at(self.position(location), self.path(location), message)
        self._add("plugin", problem)

    def report_input(self, place: Problem | None, message: str) -> None:
        """Add a problem with input files, which does not make the workflow file invalid."""
        if len(self._found) < 2 * MOST_PROBLEMS:
            nowhere = Problem(file=self.file, message="")
            self._add("input", replace(place or nowhere, message=message))

    def report_option(self, option: str, message: str) -> None:
        """Add a problem with a command-line option, such as `--set wall.gsd_m=0`."""
        self._add("option", Problem(file=option, message=message))

    def place(self, location: Location) -> Problem | None:
        """Return a problem without a message at a location; None for values from Python."""
        position = self.position(location)
        return self._at(position, self.path(location), "") if position.line else None

    def position(self, location: Location, *, at_key: bool = False) -> Position:
        """Return the position of a value or its key, or else that of the enclosing value."""
        return self.document.position(location, at_key=at_key)

    def path(self, location: Location) -> str:
        """Format a location, such as `steps.wall.in.cloud[1]`.

        Indices into values that are not lists are omitted.
        """
        stated, _ = self.document.resolve(location)
        return path_text(stated[1:] if stated[:1] == (self.unnamed,) else stated)

    def has(self, location: Location) -> bool:
        """Whether there is a value at a location, even if it is null."""
        return self.document.resolve(location)[1] == location

    def get(self, location: Location) -> JsonValue:
        """Return the value at a location; None if there is none."""
        return self.document.get(location)

    def raise_any(self) -> None:
        """Raise an error with all problems found so far, unless only input files are missing.

        Raises:
            InvalidWorkflowError: the file has problems.
            InvalidArgumentsError: only command-line options have problems.
            UnusablePluginError: only plugins have problems.
        """
        if self.has_any:
            self._raise()

    def _raise(self) -> NoReturn:
        # Problems with command-line options come last.
        in_order = sorted(
            self._found,
            key=lambda one: ("" if one[0] == "option" else one[1].file, one[1].line, one[1].column),
        )
        in_order.sort(key=lambda one: one[0] == "option")
        origins = {origin for origin, _ in in_order}
        error: type[_ProblemsError] = InvalidWorkflowError
        if "file" not in origins:
            error = InvalidArgumentsError if "option" in origins else UnusablePluginError
        raise error(tuple(problem for _, problem in in_order))

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


def validate(
    model: type[Model], data: JsonValue, log: ProblemLog, location: Location = ()
) -> Model | None:
    """Validate the content of a document, and report all mistakes at their positions.

    Invalid parts are omitted from the model so that later checks can use the valid parts.

    Args:
        model: class of the expected model.
        data: value at the location.
        log: log of the document, to which problems are added.
        location: location of the value in the document.

    Returns:
        The model with all valid parts; None if the value as a whole is invalid.
    """
    data, is_first = deepcopy(data), True
    while True:
        try:
            return model.model_validate(data)
        except ValidationError as error:
            found = list(mistakes(error, model, data))
        for loc, message, at_key in found if is_first else ():
            log.report((*location, *loc), message, at_key=at_key)
        is_first = False
        unfit = {existing(data, loc) for loc, _, _ in found}
        if () in unfit:
            return None
        # Remove later list items first, so that the indices of the others remain valid.
        for *outer, last in sorted(
            unfit,
            key=lambda loc: (len(loc), [part for part in loc if isinstance(part, int)]),
            reverse=True,
        ):
            place: Any = data
            for part in outer:
                place = place[part]
            del place[last]
