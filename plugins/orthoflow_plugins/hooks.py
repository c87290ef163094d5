"""Hooks of the built-in plugin: kinds, product types, and methods as import strings."""

from __future__ import annotations

from typing import Final

from orthoflow.sdk.hooks import FILES, KindSpec, MethodSpec, ProductSpec, hookimpl

# Summaries of the methods, by module and class. The id of a method is the name of its module, with
# hyphens instead of underscores.
_METHODS: Final = {
    "read.scan:ReadScan": "a cloud from E57, LAS/LAZ, PLY, PCD, PTX or text scans",
    "read.photos:ReadPhotos": "JPEG, PNG and TIFF photos, unchanged, with EXIF data and "
    "calibration",
    "read.checkpoints:ReadCheckpoints": "surveyed points from CSV files",
    "read.ties:ReadTies": "points measured by hand in photos, from CSV files",
    "read.cameras:ReadCameras": "orientations from other programs, in the frame of the scan",
    "read.orthoimage:ReadOrthoimage": "GeoTIFF orthoimages from other programs, with the frame of "
    "their wall",
    "simulate.room:SimulateRoom": "a simulated room, scanned and photographed, with its true "
    "geometry",
    "simulate.curved:SimulateCurved": "a simulated vault, apse, tower, column, spire, dome or "
    "baptistery, scanned and photographed, with its true geometry",
    "register.similarity:RegisterSimilarity": "translation, rotation and scale from pairs of "
    "points, with sigma0 and residuals",
    "plane.hough2d:Hough2d": "Hough transform of the plan, with cells weighted by number of points",
    "plane.hough3d:Hough3d": "Hough transform of voxels, for planes in any direction",
    "plane.ransac:Ransac": "random sample consensus: Max-Consensus, MSAC or AC-RANSAC, in 3D "
    "or in plan",
    "plane.region:Region": (
        "region growing over neighbouring points with similar normals in one plane"
    ),
    "plane.comparators:Open3dRansac": "open3d's segment_plane, repeated for each plane, for "
    "comparison",
    "plane.comparators:Open3dPatches": "open3d's detect_planar_patches, for comparison",
    "plane.given:GivenPlane": "a reference plane given by the user",
    "surface.cylinder:SurfaceCylinder": "vaults, apses, towers and columns, from pairs of normals",
    "surface.cone:SurfaceCone": "spires and tapering towers, by the same search",
    "surface.sphere:SurfaceSphere": "domes and semi-domes, by the same search",
    # Last, because a new plugin of a kind takes what the first method of the kind requires.
    "surface.planes:SurfacePlanes": "planes as the first surfaces, to which curved ones are added",
    "raster.grid:RasterGrid": "depth, intensity and colour per cell of each wall",
    "match.sift:MatchSift": "match RootSIFT key points of photos with those of the walls, by "
    "mutual nearest neighbours and the ratio test",
    "match.sides:FaceByPhotos": "determine from photos which side of a plane is its front, if it "
    "was only guessed",
    "match.guided:MatchGuided": "match photos with the walls again, starting from a first pose",
    "orient.pnp:OrientPnp": "orient each photo separately from its ties, with its accuracy or "
    "the reason for its rejection",
    "orient.dlt:OrientDlt": (
        "orient each photo by direct linear transform, with or without distortion"
    ),
    "orient.bundle:OrientColmapBundle": "bundle adjustment of all photos, with ties to the walls "
    "and between photos",
    "orient.given:OrientGiven": "poses from other programs, unchanged or "
    "corrected by ties measured by hand",
    "dense.sgm:DenseSgm": "dense cloud from neighbouring photos, by semi-global matching",
    "colour.photos:ColourPhotos": "each point takes the colour of the photo that shows it best",
    "ortho.pointcloud_direct:PointcloudDirect": "each cell takes the colour of its point nearest "
    "to the viewer",
    "ortho.dsm_backward:DsmBackward": "each cell of a wall takes its colour from the photos that "
    "show it",
    "ortho.dsm_forward:DsmForward": "project each pixel of a photo onto the wall that it shows",
    "mosaic.seams:MosaicSeams": "one orthoimage per wall from its layers",
    "segment.openings:SegmentOpenings": "outlines of windows, doors and niches from depths, "
    "lines of sight and the orthoimage",
    "inspect.openings:InspectOpenings": "compare outlines of openings with a simulated scene",
    "inspect.truth:InspectTruth": "compare orthoimages, walls and planes with a simulated scene",
    "inspect.surfaces:InspectSurfaces": "compare curved surfaces with a simulated scene",
    "inspect.surf:InspectSurf": "compare orthoimages with the laser's intensity, by SURF key "
    "points",
    "inspect.checkpoints:InspectCheckpoints": "compare orthoimages with surveyed points: "
    "residuals, outliers, classes",
}
# Ids that differ from the names of the modules.
_IDS: Final = {
    "match.sides": "face.photos",
    "orient.bundle": "orient.colmap-bundle",
    "plane.comparators:Open3dRansac": "plane.open3d-ransac",
    "plane.comparators:Open3dPatches": "plane.open3d-patches",
}


@hookimpl
def orthoflow_kinds() -> list[KindSpec]:
    """Return the built-in kinds in order, from scan to inspection."""
    return [
        KindSpec(name="read", summary="files -> products", is_source=True),
        KindSpec(name="simulate", summary="scenes with ground truth", is_source=True),
        KindSpec(
            name="register",
            summary="transform a cloud into another coordinate system",
            inputs=_ports("cloud", points="checkpoints", control="checkpoints"),
            outputs=_ports("cloud inspection"),
        ),
        KindSpec(
            name="plane",
            summary="find the planes of walls, floors and ceilings",
            inputs=_ports("cloud"),
            outputs=_ports("planes labels"),
        ),
        KindSpec(
            name="surface",
            summary="find curved walls: vaults, apses, towers, columns, domes, spires",
            inputs=_ports("cloud planes labels surfaces"),
            outputs=_ports("surfaces labels"),
        ),
        KindSpec(
            name="face",
            summary="determine the fronts of planes",
            inputs=_ports("planes cloud photos"),
            outputs=_ports("planes"),
        ),
        KindSpec(
            name="raster",
            summary="bin the cloud into a raster on each plane and unrolled surface",
            inputs=_ports("cloud planes surfaces"),
            outputs=_ports("walls"),
        ),
        KindSpec(
            name="match",
            summary="find points of photos on the walls",
            inputs=_ports("photos walls cameras cloud", hand="ties"),
            outputs=_ports("ties"),
        ),
        KindSpec(
            name="orient",
            summary="orient the photos to the scan",
            inputs=_ports("ties photos cameras walls cloud"),
            outputs=_ports("cameras"),
        ),
        KindSpec(
            name="dense",
            summary="compute a dense cloud from oriented photos",
            inputs=_ports("photos cameras"),
            outputs=_ports("cloud"),
        ),
        KindSpec(
            name="colour",
            summary="colour a cloud",
            inputs=_ports("cloud photos cameras"),
            outputs=_ports("cloud"),
        ),
        KindSpec(
            name="ortho",
            summary="project photos or the coloured cloud onto the walls",
            inputs=_ports("walls cloud photos cameras"),
            outputs=_ports("layers"),
        ),
        KindSpec(
            name="mosaic",
            summary="join the layers of each wall",
            inputs=_ports("layers walls cameras", seams=FILES),
            outputs=_ports("orthoimages"),
        ),
        KindSpec(
            name="segment",
            summary="outline objects on the walls",
            inputs=_ports("walls cloud orthoimages"),
            outputs=_ports("openings"),
        ),
        KindSpec(
            name="inspect",
            summary="measure the quality of the orthoimages",
            inputs=_ports(
                "orthoimages walls checkpoints truth cloud planes labels surfaces cameras openings"
            ),
            outputs=_ports("inspection"),
        ),
    ]


def _ports(named_as_their_products: str, **others: str) -> dict[str, str]:
    return {name: name for name in named_as_their_products.split()} | others


@hookimpl
def orthoflow_products() -> list[ProductSpec]:
    """Return the built-in product types, with the functions that write their published files."""
    return [
        _product(
            "cloud",
            "cloud:PointCloud",
            "points with intensity and colour",
            publisher="publishing",
        ),
        _product("photos", "photographs:Photos", "photographs as files"),
        _product("calibration", "photographs:Calibration", "calibrated cameras"),
        _product("checkpoints", "inspections:CheckPoints", "surveyed check points"),
        _product("truth", "inspections:Truth", "the truth of a simulated scene"),
        _product(
            "planes",
            "planes:Planes",
            "planes with rectangles and covariances",
            publisher="publishing",
        ),
        _product("labels", "surfaces:PointLabels", "the plane or surface of each point"),
        _product(
            "surfaces",
            "surfaces:Surfaces",
            "planes, cylinders, cones and spheres with their extents and covariances",
            publisher="publishing",
        ),
        _product(
            "walls",
            "walls:Walls",
            "depth, intensity and colour on each plane",
            publisher="publishing",
        ),
        _product(
            "ties",
            "photographs:Ties",
            "points in photos with known positions on walls",
            publisher="publishing",
        ),
        _product(
            "cameras", "photographs:Cameras", "orientations of photos", publisher="publishing"
        ),
        _product("layers", "walls:Layers", "each source projected onto each wall"),
        _product(
            "orthoimages", "walls:Orthoimages", "the finished orthoimages", publisher="publishing"
        ),
        _product(
            "openings",
            "openings:Openings",
            "outlines of windows, doors and niches",
            publisher="publishing",
        ),
        _product("inspection", "inspections:Inspection", "measured displacements"),
    ]


def _product(name: str, where: str, summary: str, *, publisher: str = "") -> ProductSpec:
    """Return the spec of a type in `orthoflow.products`; the publisher is in `orthoflow.files`."""
    return ProductSpec(
        type_name=name,
        target=f"orthoflow.products.{where}",
        summary=summary,
        publisher=publisher and f"orthoflow.files.{publisher}:publish_{name}",
    )


@hookimpl
def orthoflow_methods() -> list[MethodSpec]:
    """Return the built-in methods."""
    return [
        MethodSpec(
            id=_IDS.get(where)
            or _IDS.get(module := where.partition(":")[0], module.replace("_", "-")),
            target=f"orthoflow_plugins.{where}",
            summary=summary,
        )
        for where, summary in _METHODS.items()
    ]
