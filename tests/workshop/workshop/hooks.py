"""What the workshop announces: two kinds and methods that end in every way."""

from __future__ import annotations

from orthoflow.sdk.hooks import KindSpec, MethodSpec, hookimpl


@hookimpl
def orthoflow_kinds() -> list[KindSpec]:
    return [
        KindSpec(name="survey", summary="a number in a file -> planes", is_source=True),
        KindSpec(
            name="paint",
            summary="planes -> orthoimages",
            inputs={"planes": "planes"},
            outputs={"orthoimages": "orthoimages"},
        ),
    ]


@hookimpl
def orthoflow_methods() -> list[MethodSpec]:
    classes = {
        "survey.offset": ("SurveyOffset", "one plane at a distance"),
        "paint.plain": ("PaintPlain", "one colour"),
        "paint.fail": ("PaintFail", "finds no result"),
        "paint.kernel": ("PaintKernel", "computes with compiled code"),
        "paint.lacking": ("PaintLacking", "needs a library that is not there"),
        "paint.slow": ("PaintSlow", "takes its time"),
    }
    return [
        MethodSpec(id=method, target=f"workshop.methods:{name}", summary=summary)
        for method, (name, summary) in classes.items()
    ]
