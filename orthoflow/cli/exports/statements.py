"""Exports for those who ask where results come from and where they lie: PROV and STAC."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from orthoflow.cli.exports.products import make_empty
from orthoflow.cli.tables import counted

if TYPE_CHECKING:
    from orthoflow.cli.exports.choices import Choices
    from orthoflow.records import Run


def export_prov(run: Run, folder: Path, _chosen: Choices) -> str:
    """Write `prov.json`."""
    from orthoflow.records.prov import count_things, prov_document
    from orthoflow.records.run_files import creating

    document = prov_document(run.record)
    make_empty(folder)
    with creating(folder, "prov.json") as stream:
        text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        stream.write(text.encode())
    counts = count_things(document)
    return f"prov.json: {', '.join(f'{name}: {count}' for name, count in counts.items())}"


def export_stac(run: Run, folder: Path, _chosen: Choices) -> str:
    """Write `collection.json`, and the orthoimages with an item beside each."""
    from orthoflow.records.stac import COLLECTION_FILE, write_stac

    make_empty(folder)
    n_items = write_stac(run, folder)
    return f"{COLLECTION_FILE} and {counted(n_items, 'item')} beside the orthoimages"
