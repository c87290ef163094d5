"""What the plugin announces."""

from orthoflow.sdk import KindSpec, MethodSpec, hookimpl

_MISCHIEF = "orthoflow_stranger.mischief"


@hookimpl
def orthoflow_methods() -> list[MethodSpec]:
    return [
        MethodSpec(
            id="plane.median",
            target="orthoflow_stranger.median:MedianPlanes",
            summary="the level surface with the most points",
        ),
        MethodSpec(id="mischief.crash", target=f"{_MISCHIEF}:Crash", summary="segfaults"),
        MethodSpec(id="mischief.eat", target=f"{_MISCHIEF}:Eat", summary="takes all memory"),
        MethodSpec(id="mischief.hang", target=f"{_MISCHIEF}:Hang", summary="never ends"),
        MethodSpec(id="mischief.raise", target=f"{_MISCHIEF}:Raise", summary="raises"),
        MethodSpec(id="mischief.exit", target=f"{_MISCHIEF}:Exit", summary="exits the process"),
        MethodSpec(id="mischief.meddle", target=f"{_MISCHIEF}:Meddle", summary="writes to inputs"),
        MethodSpec(id="mischief.wrong", target=f"{_MISCHIEF}:Wrong", summary="wrong type"),
        MethodSpec(id="mischief.good", target=f"{_MISCHIEF}:Good", summary="works"),
        MethodSpec(id="mischief.fill", target=f"{_MISCHIEF}:Fill", summary="fills the disk"),
    ]


@hookimpl
def orthoflow_kinds() -> list[KindSpec]:
    return [
        KindSpec(
            name="mischief",
            summary="methods that fail in every way a method can",
            inputs={"cloud": "cloud"},
            outputs={"planes": "planes"},
        )
    ]
