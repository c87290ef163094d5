"""Problems of a workflow, all collected before any is reported, each with its place."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, NoReturn, TypeAlias

from orthoflow.errors import ArgumentError, OrthoflowError, PluginError, WorkflowError
from orthoflow.files.yaml_positions import Entry, Listing, Position, Table, Value, read_yaml

#: problems of a workflow that are reported at once
MOST_PROBLEMS: Final = 100
_SNIPPET_WIDTH: Final = 120
# Keys and indices that lead to a value: `("steps", "wall", "in", "cloud", 0)`.
Location: TypeAlias = tuple[str | int, ...]


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One problem.

    Attributes:
        file: the workflow file as the user named it, or the command-line option.
        line: from 1; 0 for a command-line option.
        column: from 1; 0 for a command-line option.
        path: location in the document, keys joined by dots, e.g. `steps.wall.params.gsd_m`.
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
        """Return its place, as the sentence begins: `hall.yaml:3:9: steps.wall: `."""
        where = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        return f"{where}: {self.path}: " if self.path else f"{where}: "

    def __str__(self) -> str:
        head = f"{self.place}{self.message}"
        # Around the column, so that a line of a thousand characters does not hide the message.
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
    """A workflow is correct, but plugins it needs are not; `problems` names where it needs them."""


class InvalidArgumentsError(_ProblemsError, ArgumentError):
    """Command-line options do not fit the workflow."""


@dataclass
class ProblemLog:
    """Collects problems while a workflow is read.

    Attributes:
        file: the workflow file as the user named it.
        lines: its text.
        tree: its values with their positions, None before it is parsed.
        unnamed: the first key of locations, if paths do not state it.
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
        """Parse YAML; problems are added, None if nothing can be read."""
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
            shown: the path stated in the problem, if it differs.
        """
        path = self.path(location if shown is None else shown)
        self.add(self.position(location, at_key=at_key), path, message)

    def report_plugin(self, location: Location, message: str) -> None:
        """Add a problem of a plugin that the file needs here."""
        problem = self._at(self.position(location), self.path(location), message)
        if problem not in self._in_plugins:
            self._in_plugins.append(problem)

    def report_input(self, place: Problem | None, message: str) -> None:
        """Add a problem of input files; the file itself decides the type of the error."""
        if len(self._in_inputs) < MOST_PROBLEMS:
            nowhere = Problem(file=self.file, message="")
            self._in_inputs.append(replace(place or nowhere, message=message))

    def report_option(self, option: str, message: str) -> None:
        """Add a problem of a command-line option, e.g. `--set wall.gsd_m=0`."""
        problem = Problem(file=option, message=message)
        if problem not in self._in_options:
            self._in_options.append(problem)

    def place(self, location: Location) -> Problem | None:
        """Return a problem without its message; None if the value comes from no file."""
        position = self.position(location)
        return self._at(position, self.path(location), "") if position.line else None

    def position(self, location: Location, *, at_key: bool = False) -> Position:
        """Return the position of a value, or of the nearest enclosing one."""
        steps = self._walk(location)
        if at_key and steps and isinstance(steps[-1][1], Entry):
            return steps[-1][1].position
        if steps:
            return steps[-1][0].position
        return self.tree.position if self.tree else Position(line=1, column=1)

    def path(self, location: Location) -> str:
        """Format a location: `steps.wall.in.cloud[1]`, without indices of non-lists."""
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
        """Return the value at a location; None if there is none."""
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
    """Return the value of a key or an index, and the entry of a key."""
    if isinstance(value, Table):
        entry = value.get(str(part))
        return (entry.value, entry) if entry else (None, None)
    if isinstance(value, Listing) and isinstance(part, int) and part < len(value.items):
        return value.items[part], None
    return None, None
