"""What the plugin announces: a kind with its ports, a product type with its files, two methods."""

from orthoflow.sdk import KindSpec, MethodSpec, ProductSpec, hookimpl


@hookimpl
def orthoflow_kinds() -> list[KindSpec]:
    """Give the kind; any other plugin may bring methods of it."""
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
    """Give the product type, and what writes its files."""
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
    """Give the methods."""
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
