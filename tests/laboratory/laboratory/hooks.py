"""What the laboratory announces: the real kinds and product types, and methods of its own."""

from __future__ import annotations

from orthoflow_plugins import hooks as builtin

from orthoflow.sdk.hooks import KindSpec, MethodSpec, ProductSpec, hookimpl


@hookimpl
def orthoflow_kinds() -> list[KindSpec]:
    return builtin.orthoflow_kinds()


@hookimpl
def orthoflow_products() -> list[ProductSpec]:
    return builtin.orthoflow_products()


@hookimpl
def orthoflow_methods() -> list[MethodSpec]:
    classes = {
        "read.scan": "ReadScan",
        "read.photos": "ReadPhotos",
        "simulate.room": "SimulateRoom",
        "plane.hough2d": "Hough2d",
        "plane.ransac": "Ransac",
        "raster.grid": "Grid",
        "match.sift": "Sift",
        "match.guided": "Guided",
        "orient.pnp": "Pnp",
        "orient.bundle": "Bundle",
        "ortho.backward": "Backward",
        "ortho.direct": "Direct",
        "mosaic.seams": "Seams",
        "inspect.truth": "InspectTruth",
    }
    return [
        MethodSpec(id=method, target=f"laboratory.methods:{name}", summary=f"{method} of the tests")
        for method, name in classes.items()
    ]
