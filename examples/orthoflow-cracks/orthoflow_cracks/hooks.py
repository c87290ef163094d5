"""Hooks of the plugin: a kind with its ports, a product type with its files, and two methods."""

from orthoflow.sdk import KindSpec, MethodSpec, ProductSpec, hookimpl


@hookimpl
def orthoflow_kinds() -> list[KindSpec]:
    """Return the kind; any other plugin can add methods of this kind."""
    return [
        KindSpec(
            name="crack",
            summary="find cracks in orthoimages",
            inputs={"orthoimages": "orthoimages"},
            outputs={"cracks": "cracks"},
        )
    ]


@hookimpl
def orthoflow_products() -> list[ProductSpec]:
    """Return the product type and the function that writes its files."""
    return [
        ProductSpec(
            type_name="cracks",
            target="orthoflow_cracks.cracks:Cracks",
            summary="cracks as lines in the world, with their widths",
            publisher="orthoflow_cracks.cracks:publish_cracks",
        )
    ]


@hookimpl
def orthoflow_methods() -> list[MethodSpec]:
    """Return the methods."""
    return [
        MethodSpec(
            id="crack.dark-lines",
            target="orthoflow_cracks.dark_lines:DarkLines",
            summary="thin dark lines, as lines in the world",
        ),
        MethodSpec(
            id="simulate.cracked-wall",
            target="orthoflow_cracks.cracked_wall:CrackedWall",
            summary="an orthoimage with known cracks",
        ),
    ]
