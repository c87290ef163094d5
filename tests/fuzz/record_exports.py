"""What becomes of a run whose record and files fit each other and are hostile: exports of it.

A case's file holds no more than the number that the damage follows from. Records alone are in
`records`; here products are changed before they are digested, and files before the record names
them, so that nothing is found wrong but what they say.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any, Final

import numpy as np
from orthoflow_provenance.document import sha256_text

from orthoflow.products import PointCloud, PointLabels, Product
from orthoflow.products.product import Payload
from orthoflow.testing.examples import example, few_points
from tests import drawing_runs
from tests import hostile_records as hostile
from tests.fuzz.harness import Target
from tests.fuzz.mutation import mutate_bytes
from tests.fuzz.records import (
    MARK,
    SECRET,
    Command,
    RefusedError,
    changed_json,
    check_command,
    check_made,
    surroundings,
    with_damage,
)
from tests.studios import Studio

Change = Callable[[Payload], Payload]
MAX_CPU_S: Final = 10.0  # of a command that may be the first to compile a kernel

_PICTURED: Final[Sequence[Command]] = tuple(
    ("export", "--to", target, "-o", f"out/{target}")
    for target in ("sheet", "dxf", "geojson", "gltf", "tiles", "stac")
)
_CLOUDS: Final[Sequence[Command]] = (
    *(
        ("export", "--to", target, "-o", f"out/{target}")
        for target in ("laz", "copc", "ply", "e57")
    ),
    ("export", "--to", "ply", "--colour", "deviation", "-o", "out/deviation"),
    ("export", "--to", "laz", "--wall", "2", "-o", "out/wall"),
)
COMMANDS: Final[Sequence[Command]] = (
    *_PICTURED,
    *_PICTURED,
    *_CLOUDS,
    ("export", "--to", "colmap", "-o", "out/colmap"),
    ("export", "--to", "layers", "-o", "out/layers"),
    ("export", "--to", "prov", "-o", "out/prov"),
    ("report", "-o", "out/report.html"),
    ("show",),
    ("runs",),
    ("runs", "--json"),
)


# Runs ---------------------------------------------------------------------------------------------


def _cloud() -> PointCloud:
    """Points on the photographed wall and the floor, some of them far from both."""
    rng = np.random.default_rng(5)
    places = rng.uniform(0.2, 0.8, (300, 3)) * drawing_runs.SIZE_M
    places[:200, 1] = drawing_runs.SIZE_M[1] + rng.normal(0.0, 0.002, 200)
    places[200:280, 2] = 0.0
    return replace(
        few_points(drawing_runs.box_points(places) - drawing_runs.CORNER),
        origin=drawing_runs.CORNER,
        scan=(np.arange(300) % 2).astype(np.uint16),
        stations=np.array([drawing_runs.CORNER + 1.0, drawing_runs.CORNER + 1.5]),
    )


@cache
def _before() -> dict[str, Product]:
    """What steps before those of the drawing run give."""
    photos = {"photos": example("photos"), "orient": example("cameras"), "ortho": example("layers")}
    return {"scan": _cloud(), **photos}


def write_run(folder: Path, change: Change = lambda payload: payload) -> None:
    """Write a run whose record verifies, with products that were changed before it was made."""
    plane = np.repeat([drawing_runs.WALL, 0, -1], [200, 80, 20])
    drawing_runs.write_drawing_run(
        folder,
        before=_before(),
        labels=PointLabels(plane_index=plane.astype(np.int16)),
        change=change,
        key=sha256_text("{}"),
        key_preimage="{}",
        started="2026-01-02T03:04:05Z",
        ended="2026-01-02T03:04:06Z",
        determinism="exact",
        distribution="orthoflow-tls",
        distribution_version="0.1.0",
    )


# Damage -------------------------------------------------------------------------------------------

_VALUES: Final = (0.0, -1.0, 1.0, 1e30, -1e300, float("nan"), float("inf"), 5e-324)
_REFUSED: Final = (ValueError, TypeError, KeyError, OverflowError, RecursionError, OSError)


def _change_payload(random: Random, wanted: str, payload: Payload) -> Payload:
    """Change an array or the rest of a product of one type."""
    if payload.type_name != wanted:
        return payload
    names = sorted(payload.arrays)
    if not names or random.random() < 0.4:
        text = changed_json(json.dumps(dict(payload.metadata)).encode(), random)
        changed = json.loads(text)
        return replace(payload, metadata=changed) if isinstance(changed, dict) else payload
    name = random.choice(names)
    arrays = {**payload.arrays, name: _changed_array(payload.arrays[name], random)}
    if random.random() < 0.1:
        del arrays[name]
    return replace(payload, arrays=arrays)


# Any: arrays of every kind.
def _changed_array(array: np.ndarray[Any, Any], random: Random) -> np.ndarray[Any, Any]:
    changed = np.array(array)
    match random.randrange(6):
        case 0 | 1 if changed.size:
            places = random.choice((slice(None), slice(0, 1), random.randrange(changed.size)))
            with np.errstate(all="ignore"):
                changed.reshape(-1)[places] = np.float64(random.choice(_VALUES)).astype(array.dtype)
        case 2:
            return changed[: len(changed) // 2] if changed.ndim else changed
        case 3:
            with np.errstate(all="ignore"):
                return changed.astype(random.choice(("<f8", "<f4", "<i8", "|u1", "?")))
        case 4:
            return changed.reshape(random.choice(((-1,), (1, -1), (-1, 1))))
        case _ if changed.ndim:
            return np.concatenate([changed] * random.choice((0, 2, 50)) or [changed[:0]])
    return changed


def _damage_file(run: Path, random: Random) -> None:
    """Change a published file and let the record name it so, or put something else there."""
    files = sorted(path for path in (run / "products").rglob("*") if path.is_file())
    path, kind = random.choice(files), random.randrange(8)
    if kind == 0:
        path.unlink()
        path.symlink_to(random.choice(("/dev/zero", "../../../secret.txt", "/dev/tty", "..")))
    elif kind == 1:
        path.unlink()
        os.mkfifo(path)
    elif path.suffix == ".json":
        path.write_text(changed_json(path.read_bytes(), random))
        hostile.publish_again(run)
    else:
        path.write_bytes(mutate_bytes(path.read_bytes(), random, [path.read_bytes()]))
        hostile.publish_again(run)


def _read(path: Path) -> None:
    """Write a run, damaged, and make something of it; sheets of a sound one."""
    folder = path.parent
    _, mark, number = path.read_bytes().rpartition(MARK)
    (folder / "secret.txt").write_text(SECRET)
    run, random = folder / "out" / "run", Random(number)
    command = random.choice(COMMANDS) if mark else COMMANDS[0]
    if mark and random.random() < 0.5:
        made = (*_before().values(), *drawing_runs.box_products().values())
        wanted = random.choice(["labels", *sorted(item.type_name for item in made)])
        try:
            write_run(run, partial(_change_payload, random, wanted))
        except _REFUSED:
            raise RefusedError from None
    else:
        write_run(run)
        if mark:
            _damage_file(run, random)
    before = surroundings(folder)
    limit_s = MAX_CPU_S if mark else float("inf")
    code = check_command(Studio(folder), command, run, max_cpu_s=limit_s)
    check_made(folder / "out", run)
    assert surroundings(folder) == before
    if code:
        raise RefusedError


RECORD_EXPORTS: Final = (
    Target(
        seeds=lambda folder: (folder / "run").write_bytes(b""),
        read=_read,
        mutate=with_damage,
        refusals=(RefusedError,),
        max_cpu_s=2 * MAX_CPU_S,
    ),
)
