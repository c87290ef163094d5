"""Which check points no picture shows, on which side of it they lie, and in how many words."""

from __future__ import annotations

from orthoflow_plugins.inspect.missed_points import ways_to_count, with_reasons


def test_four_points_are_named_and_the_rest_is_counted() -> None:
    reasons = {f"P{k}": "2 mm below wall" for k in range(6)}
    said = with_reasons(reasons)
    assert said.startswith("P0 (2 mm below wall), P1 (")
    assert said.endswith("P3 (2 mm below wall) and 2 more, see the log")
    assert with_reasons(dict([*reasons.items()][:4])).endswith("P3 (2 mm below wall)")
    assert "margin_m" in ways_to_count(reasons)
    assert "margin_m" not in ways_to_count({"P0": "nothing like it was recognised on below"})
