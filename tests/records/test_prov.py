from __future__ import annotations

import dataclasses
import datetime as dt
import json
import math
from collections.abc import Iterator

import pytest
from prov.model import (
    ProvActivity,
    ProvAgent,
    ProvDelegation,
    ProvDerivation,
    ProvDocument,
    ProvEntity,
    ProvGeneration,
    ProvUsage,
)

from orthoflow.records.archive import prov_document
from orthoflow.records.open import open_run
from tests.studios import Studio, open_finished_studio


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    with pytest.MonkeyPatch.context() as patch:
        yield open_finished_studio(tmp_path_factory.mktemp("prov"), patch)


def test_the_graph_of_a_run_is_read_by_the_prov_package(studio: Studio) -> None:
    done = studio("export", "first", "--to", "prov")
    assert done.exit_code == 0, done.output
    text = (studio.folder / "first" / "export" / "prov" / "prov.json").read_text()
    record = open_run(studio.folder / "first").record
    json.loads(text, parse_constant=pytest.fail)  # as JSON has it, without NaN
    document = ProvDocument.deserialize(content=text, format="json")
    executed = [cell for cell in record.cells if cell.status != "skipped"]
    activities = {str(a.identifier): a for a in document.get_records(ProvActivity)}
    assert set(activities) == {f"cell:{cell.address}" for cell in executed}
    for cell in executed:
        activity = activities[f"cell:{cell.address}"]
        facts = {str(name): value for name, value in activity.attributes}
        assert facts["orthoflow:method"] == cell.method
        assert facts["orthoflow:status"] == cell.status
        assert activity.get_startTime() == dt.datetime.fromisoformat(cell.started)
        assert activity.get_endTime() == dt.datetime.fromisoformat(cell.ended)
        for name, value in cell.params.items():
            if isinstance(value, int | float):
                assert facts[f"parameter:{name}"] == value
    outputs = {
        f"product:{cell.address}.{port}": product.digest
        for cell in executed
        for port, product in cell.outputs.items()
    }
    entities = {str(e.identifier): e for e in document.get_records(ProvEntity)}
    generated = {str(g.args[0]): str(g.args[1]) for g in document.get_records(ProvGeneration)}
    for name, digest in outputs.items():
        assert {str(k): v for k, v in entities[name].attributes}["orthoflow:digest"] == digest
        assert generated[name] == f"cell:{name.removeprefix('product:').rpartition('.')[0]}"
    published = {name for name in entities if name.startswith("published:")}
    # The tables of all metrics and of all walls are of no cell.
    assert {name.count("%2F") for name in published - set(generated)} == {1}
    # Everything that is used, or that something comes of, is an entity that is there.
    ends = [str(u.args[1]) for u in document.get_records(ProvUsage)]
    ends += [str(d.args[1]) for d in document.get_records(ProvDerivation)]
    assert ends
    assert set(ends) <= set(entities)
    agents = {str(a.identifier) for a in document.get_records(ProvAgent)}
    assert len(agents) >= 2
    assert {str(d.args[1]) for d in document.get_records(ProvDelegation)} <= agents


@pytest.mark.parametrize("strange", ["a b", "x:y", "../../etc", 'é\n#%41"'])
def test_strange_names_stay_names(studio: Studio, strange: str) -> None:
    record = open_run(studio.folder / "first").record
    first = record.cells[0]
    cell = dataclasses.replace(
        first,
        address=strange,
        params={strange: [1, None, {"a": 2}], "none": None, "nan": math.nan, "large": 10**30},
    )
    changed = dataclasses.replace(record, run_id=strange, cells=(cell,), published=())
    text = prov_document(changed).serialize(format="json")
    document = ProvDocument.deserialize(content=text, format="json")
    (activity,) = document.get_records(ProvActivity)
    facts = {str(name): value for name, value in activity.attributes}
    assert facts["prov:label"] == strange
    assert '[1, null, {"a": 2}]' in facts.values()
    assert facts["parameter:none"] == "null"
    assert math.isnan(facts["parameter:nan"])
    assert facts["parameter:large"] == 10**30
