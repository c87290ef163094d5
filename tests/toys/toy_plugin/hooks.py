"""What the toys declare."""

from __future__ import annotations

from orthoflow.sdk.hooks import KindSpec, MethodSpec, ProductSpec, hookimpl

METHODS = {
    "make.range": "makes:Range",
    "make.file": "makes:File",
    "make.scan": "makes:Scan",
    "make.survey": "makes:Survey",
    "thin.means": "works:Means",
    "work.add": "works:Add",
    "work.noise": "works:Noise",
    "work.slow": "works:Slow",
    "work.draws": "works:Draws",
    "work.does": "works:Does",
}
NUMBERS = {"numbers": "numbers"}


@hookimpl
def orthoflow_kinds() -> list[KindSpec]:
    return [
        KindSpec(name="make", summary="makes numbers", is_source=True),
        KindSpec(name="work", summary="works on numbers", inputs=NUMBERS, outputs=NUMBERS),
        KindSpec(name="thin", summary="few of many", inputs={"scan": "scan"}, outputs=NUMBERS),
    ]


@hookimpl
def orthoflow_products() -> list[ProductSpec]:
    return [
        ProductSpec(
            type_name="numbers",
            target="toy_plugin.products:Numbers",
            summary="numbers",
            publisher="toy_plugin.products:publish",
        ),
        ProductSpec(type_name="scan", target="toy_plugin.products:Scan", summary="many"),
    ]


@hookimpl
def orthoflow_methods() -> list[MethodSpec]:
    return [
        MethodSpec(id=name, target=f"toy_plugin.{target}", summary="")
        for name, target in METHODS.items()
    ]
