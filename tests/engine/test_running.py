"""What becomes of whatever a method raises: one sentence, told by the right one of our errors."""

from __future__ import annotations

from tests.engine_world import World


def test_a_product_that_contradicts_its_inputs_fails_its_step_and_names_the_method(
    world: World,
) -> None:
    source = world.site / "toy_plugin" / "products.py"
    source.write_text(
        f"{source.read_text()}\n\n"
        "def _check(self, others):\n"
        "    from orthoflow.errors import ProductError\n"
        "    if any(len(one.values) == len(self.values) for one in others.values()):\n"
        "        raise ProductError('numbers.values must be as many as expected')\n\n\n"
        "Numbers.check_against = _check\n"
    )
    outcome = world.run(
        "steps:\n"
        "  first: {use: make.range}\n"
        "  second: {use: work.add, in: {numbers: first.numbers}}\n",
        executor="inline",
    )
    assert outcome.results["first"].status == "ok"
    failure = outcome.results["second"]
    assert failure.status == "failed"
    assert "method work.add" in failure.error_message
    assert "numbers.values must be as many as expected" in failure.error_message
