"""A first workflow for somebody's own files: a shipped recipe that names them, and nothing else."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, TypeAlias

from orthoflow.alike import first_few
from orthoflow.errors import InputError
from orthoflow.files.images import PHOTO_SUFFIXES
from orthoflow.files.points.formats import TEXT
from orthoflow.workflow.recipes import shipped_workflow
from orthoflow.workflow.recognising import FileKind, Recognised

Recipe: TypeAlias = Literal["photos-on-scan", "direct", "plan"]

# What stands in for a scan where there is none.
_STAND_INS: Final = ("room", "check")
_PLAIN: Final = re.compile(r"[A-Za-z0-9_./][A-Za-z0-9_./-]*")
_INPUT: Final = re.compile(r"  (\w+): \{.*?\}( *#.*)?")
_MOST_LISTED: Final = 12
# Paragraphs of a recipe's heading that are not about files of one's own: its commands, stand-ins.
_NOT_OWN: Final = ("#   ", "# Without a scan of your own")


@dataclass(frozen=True, kw_only=True)
class Draft:
    """A workflow to be written.

    Attributes:
        recipe: name of the shipped one that it follows.
        text: of the file.
        inputs: what each input holds, in words.
        left_out: files that no input takes, and why.
    """

    recipe: Recipe
    text: str
    inputs: Mapping[str, str]
    left_out: Sequence[str]


def draft_workflow(found: Sequence[Recognised], target: Path, recipe: Recipe | None) -> Draft:
    """Write the workflow that fits some files.

    Args:
        found: what the files are.
        target: where the workflow will lie; paths in it start there.
        recipe: the one that it shall follow, or None: photos on the scan where there are photos,
            the scan's own colours otherwise.

    Raises:
        InputError: there is no scan, or no photo where the recipe needs some.
    """
    by_kind: dict[FileKind, list[Recognised]] = {}
    for item in found:
        by_kind.setdefault(item.kind, []).append(item)
    scans = by_kind.get("scan", [])
    if not scans:
        others = "; ".join(f"{item.path.name}: {item.said}" for item in found[:_MOST_LISTED])
        raise InputError(
            "there is no scan among the files, and a workflow needs one (E57, LAS, LAZ, PLY, PCD, "
            f"PTX or text); found {others or 'nothing'}"
        )
    own_formats = [scan for scan in scans if scan.path.suffix.lower() not in TEXT.suffixes]
    if own_formats and len(own_formats) < len(scans):
        # Notes hold numbers too.
        by_kind["unknown"] = [
            *by_kind.get("unknown", []),
            *(
                replace(scan, said="text, left out beside scans of other formats")
                for scan in scans
                if scan not in own_formats
            ),
        ]
        scans = by_kind["scan"] = own_formats
    own_photos = [scan for scan in scans if scan.n_photos]
    has_posed = any(scan.n_posed for scan in own_photos)
    # What has no pose is mostly a picture for people, which matching would not find on the walls.
    is_usual = bool(by_kind.get("photos") or has_posed)
    chosen: Recipe = recipe or ("photos-on-scan" if is_usual else "direct")
    if chosen == "photos-on-scan" and not (own_photos or is_usual):
        raise InputError("photos-on-scan needs photos, and there are none among the files")
    if own_photos and "photos" not in by_kind:
        # Photos that a scanner took lie in its file, with their poses.
        inside = [replace(scan, said="the photos in it") for scan in own_photos]
        by_kind["photos"] = inside
        if len(inside) == 1 and has_posed:
            by_kind.setdefault("cameras", [replace(inside[0], said="the poses of its photos")])
    return _Drafting(by_kind=by_kind, target=target, recipe=chosen).draft()


@dataclass(frozen=True, kw_only=True)
class _Drafting:
    """The text, from the recipe's."""

    by_kind: Mapping[FileKind, Sequence[Recognised]]
    target: Path
    recipe: Recipe

    def draft(self) -> Draft:
        """Give the recipe with its inputs filled in, and a heading of its own."""
        shipped = shipped_workflow(self.recipe).read_text(encoding="utf-8")
        start, inputs, steps = re.split(r"^(?=orthoflow:|steps:)", shipped, flags=re.MULTILINE)
        taken, left_out = self._assigned(inputs)
        lines = []
        for line in inputs.splitlines():
            match = _INPUT.fullmatch(line)
            files = taken.get(match[1], ()) if match else ()
            lines.append(self._input_line(match[1], files) if match and files else line)
        described = {name: _described(files) for name, files in taken.items() if files}
        name = re.sub(r"[^A-Za-z0-9_-]+", "-", self.target.stem).strip("-") or self.recipe
        body = re.sub(r"^name: .*$", f"name: {name}", "\n".join(lines), flags=re.MULTILINE)
        text = f"{self._heading(start, described, left_out)}{body}\n{_without_stand_ins(steps)}"
        return Draft(recipe=self.recipe, text=text, inputs=described, left_out=left_out)

    def _assigned(self, inputs: str) -> tuple[dict[str, Sequence[Recognised]], list[str]]:
        """Which input takes which files, and what is left over."""
        names = [match[1] for line in inputs.splitlines() if (match := _INPUT.fullmatch(line))]
        taken: dict[str, Sequence[Recognised]] = {}
        left_out = []
        for kind, items in self.by_kind.items():
            takes_many = kind in ("scan", "photos", "other")
            if kind == "unknown":
                reasons: dict[str, list[str]] = {}
                for item in items:
                    reasons.setdefault(item.said, []).append(item.path.name)
                left_out += [f"{_some(each)}: {reason}" for reason, each in reasons.items()]
            elif kind not in names:
                left_out += [
                    f"{item.path.name}: {item.said}; {self.recipe} has no input for it"
                    for item in items
                ]
            elif len(items) > 1 and not takes_many:
                each = ", ".join(item.path.name for item in items)
                left_out.append(f"{each}: {kind} may be one of them only; name it under inputs")
            else:
                taken[kind] = items
        return taken, left_out

    def _input_line(self, name: str, items: Sequence[Recognised]) -> str:
        paths = _folders_of_photos(items) if name == "photos" else [item.path for item in items]
        places = [_yaml(self._place(path)) for path in paths]
        if name == "other":
            places += [_yaml(self._place(path.with_suffix(".json"))) for path in paths]
        if len(places) == 1:
            return f"  {name}: {{files: {places[0]}}}  # {_seen(_described(items))}"
        listed = "\n".join(f"      - {place}" for place in places)
        return f"  {name}:  # {_seen(_described(items))}\n    files:\n{listed}"

    def _place(self, path: Path) -> str:
        """A path as the workflow names it: from its folder."""
        here, place = (Path(os.path.normpath(one.absolute())) for one in (self.target.parent, path))
        if not place.is_relative_to(here):
            # `..` behind a link leads elsewhere than it reads.
            here, place = here.resolve(), place.resolve()
        return Path(os.path.relpath(place, here)).as_posix()

    def _heading(self, start: str, described: Mapping[str, str], left_out: Sequence[str]) -> str:
        said = [f"# Made by `orthoflow new` from the recipe {self.recipe}.yaml."]
        said += [f"#   {name}: {text}" for name, text in described.items()]
        said += [f"# Not used: {text}" for text in left_out[:_MOST_LISTED]]
        run = shlex.quote(self.target.name)
        said += [
            "#",
            f"#   orthoflow check {run}       is anything wrong with it?",
            f"#   orthoflow plan {run}        what would run",
            f"#   orthoflow run {run} --set wall.gsd_m=0.02    a coarse first look; then without",
            "#",
            "# What follows are the recipe's own words.",
            "#",
        ]
        paragraphs = start.rstrip("\n").split("\n#\n")
        kept = [text for text in paragraphs if not text.startswith(_NOT_OWN)]
        return "\n".join(map(_seen, said)) + "\n" + "\n#\n".join(kept) + "\n"


def _folders_of_photos(items: Sequence[Recognised]) -> list[Path]:
    """Paths of photos; a folder stands for all that lie in it."""
    paths = [item.path for item in items]
    places: dict[Path, None] = {}
    for path in paths:
        inside = [p for p in path.parent.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES]
        whole = path.suffix.lower() in PHOTO_SUFFIXES and set(inside) <= set(paths)
        # A folder among whose files are scans would bring these along.
        whole = whole and len(inside) > 1 and _holds_photos_only(path.parent)
        places[path.parent if whole else path] = None
    return list(places)


def _holds_photos_only(folder: Path) -> bool:
    return all(path.suffix.lower() in PHOTO_SUFFIXES for path in folder.iterdir() if path.is_file())


def _described(items: Sequence[Recognised]) -> str:
    """What some files are, in one line."""
    if len(items) == 1:
        return f"{_word(items[0].path.name)}, {items[0].said}"
    n_photos = sum(item.n_photos for item in items)
    if n_photos == len(items):
        return f"{n_photos} photos"
    return f"{len(items)} files: {_some([item.path.name for item in items])}"


def _some(names: Sequence[str]) -> str:
    """Name the first of some files."""
    return first_few([*map(_word, names)], most=4)


def _word(name: str) -> str:
    """A file's name within a comment, where a line end would end it."""
    return json.dumps(name, ensure_ascii=False)[1:-1]


def _yaml(text: str) -> str:
    return text if _PLAIN.fullmatch(text) else _seen(json.dumps(text, ensure_ascii=False))


def _seen(text: str) -> str:
    """Write every letter that has no shape as YAML has it: some of them end lines and comments."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii")
        for letter in text
    )


def _without_stand_ins(steps: str) -> str:
    """Take the simulated room out of the steps, and what only it is inspected with."""
    blocks = re.split(r"^(?=  \w+:)", steps, flags=re.MULTILINE)
    has_room = any(block.startswith("  room:") for block in blocks)
    kept = [
        block
        for block in blocks
        if not (has_room and block.partition(":")[0].strip() in _STAND_INS)
    ]
    text = "".join(kept).replace(", room.cloud]", "]")
    return re.sub(r"\[([\w.]+)\]", r"\1", text)
