"""Finding and reading a workflow's text, and validating its content with the models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from orthoflow.catalog.wording import did_you_mean
from orthoflow.errors import WorkflowError
from orthoflow.files.yaml_positions import (
    Listing,
    Value,
    describe,
    plain,
)
from orthoflow.foreign_text import open_file
from orthoflow.products.product import JsonValue
from orthoflow.workflow.model import (
    FORMAT_TOO_NEW,
    NOT_A_NAME,
    annotation_at,
)
from orthoflow.workflow.problems import Location, ProblemLog

#: bytes of a workflow file
MOST_BYTES: Final = 400_000
_INSTALLED: Final = Path(__file__).parent / "shipped"
_CHECKOUT: Final = Path(__file__).parents[2] / "workflows"

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
    if path.is_file():
        return path
    if path.exists() and path.parent != Path():
        raise WorkflowError(f"{path} is a folder or a device; give a workflow file")
    return shipped_workflow(str(name_or_path))


def read_text(path: Path, what: str = "a workflow file", most_bytes: int = MOST_BYTES) -> str:
    """Read a text file of bounded size.

    Raises:
        WorkflowError: it cannot be read, is too large, or is not UTF-8.
    """
    try:
        # No more than needed: a file named by mistake may be a scan.
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


# Models -------------------------------------------------------------------------------------------


def validate(
    model: type[Model], data: JsonValue, log: ProblemLog, location: Location = ()
) -> Model | None:
    """Validate the content of a document; all mistakes are reported at their places.

    Invalid parts are then removed, so that the following checks see the rest.

    Args:
        model: the expected form.
        data: the value at the location.
        log: has the tree of the document, and receives the problems.
        location: of the value in the tree.

    Returns:
        The model of all valid parts; None if the whole is invalid.
    """
    is_first = True
    while True:
        try:
            return model.model_validate(data)
        except ValidationError as error:
            details = error.errors(include_url=False)
        if is_first:
            for one in _once(details):
                _report(model, one, log, location)
        is_first = False
        unfit = sorted({_unfit(data, one["loc"]) for one in details}, key=repr, reverse=True)
        if () in unfit:
            return None
        for parts in unfit:
            _remove(data, parts)


def _once(details: Sequence[ErrorDetails]) -> list[ErrorDetails]:
    """Drop problems that follow from another: a list that is too short because of its items."""
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
    """Return the location of what has to be removed: the innermost existing value."""
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
            f"unknown key {name}{did_you_mean(name, known)}; known here: {', '.join(known)}"
            f"{'; parameters of the method belong in params' if 'params' in known else ''}",
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
