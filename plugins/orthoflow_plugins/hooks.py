"""What the built-in plugin announces: kinds, product types and methods, by import string."""

from __future__ import annotations

from orthoflow.sdk.hooks import KindSpec, MethodSpec, ProductSpec, hookimpl


@hookimpl
def orthoflow_kinds() -> list[KindSpec]:
    """Give the built-in kinds, in the order of the road from scan to inspection."""
    return [
        KindSpec(name="read", summary="files -> products", is_source=True),
        KindSpec(name="simulate", summary="scenes with exact truth", is_source=True),
        KindSpec(
            name="register",
            summary="bring a cloud into another coordinate system",
            inputs={"cloud": "cloud", "points": "checkpoints", "control": "checkpoints"},
            outputs={"cloud": "cloud", "inspection": "inspection"},
        ),
        KindSpec(
            name="plane",
            summary="find the planes of walls, floors and ceilings",
            inputs={"cloud": "cloud"},
            outputs={"planes": "planes", "labels": "labels"},
        ),
        KindSpec(
            name="face",
            summary="turn planes to the side from which they are seen",
            inputs={"planes": "planes", "cloud": "cloud", "photos": "photos"},
            outputs={"planes": "planes"},
        ),
        KindSpec(
            name="raster",
            summary="lay the cloud into a raster on each plane",
            inputs={"cloud": "cloud", "planes": "planes"},
            outputs={"walls": "walls"},
        ),
        KindSpec(
            name="match",
            summary="find points of the photos on the walls",
            inputs={
                "photos": "photos",
                "walls": "walls",
                "cameras": "cameras",
                "cloud": "cloud",
                "hand": "ties",
            },
            outputs={"ties": "ties"},
        ),
        KindSpec(
            name="orient",
            summary="orient the photos to the scan",
            inputs={"ties": "ties", "photos": "photos", "cameras": "cameras", "walls": "walls"},
            outputs={"cameras": "cameras"},
        ),
        KindSpec(
            name="colour",
            summary="colour a cloud",
            inputs={"cloud": "cloud", "photos": "photos", "cameras": "cameras"},
            outputs={"cloud": "cloud"},
        ),
        KindSpec(
            name="ortho",
            summary="lay photos or the coloured cloud onto the walls",
            inputs={"walls": "walls", "cloud": "cloud", "photos": "photos", "cameras": "cameras"},
            outputs={"layers": "layers"},
        ),
        KindSpec(
            name="mosaic",
            summary="join the layers of each wall",
            inputs={
                "layers": "layers",
                "walls": "walls",
                "cameras": "cameras",
                "seams": "files",
            },
            outputs={"orthoimages": "orthoimages"},
        ),
        KindSpec(
            name="segment",
            summary="outline what is on the walls",
            inputs={"walls": "walls", "cloud": "cloud", "orthoimages": "orthoimages"},
            outputs={"openings": "openings"},
        ),
        KindSpec(
            name="inspect",
            summary="measure how good the orthoimages are",
            inputs={
                "orthoimages": "orthoimages",
                "walls": "walls",
                "checkpoints": "checkpoints",
                "truth": "truth",
                "cloud": "cloud",
                "planes": "planes",
                "labels": "labels",
                "cameras": "cameras",
                "openings": "openings",
            },
            outputs={"inspection": "inspection"},
        ),
    ]


@hookimpl
def orthoflow_products() -> list[ProductSpec]:
    """Give the built-in product types with what publishes their files."""
    publish = "orthoflow.files.publishing"
    return [
        ProductSpec(
            type_name="cloud",
            target="orthoflow.products.cloud:PointCloud",
            summary="points with intensity and colour",
        ),
        ProductSpec(
            type_name="photos",
            target="orthoflow.products.photographs:Photos",
            summary="photographs as they were taken",
        ),
        ProductSpec(
            type_name="calibration",
            target="orthoflow.products.photographs:Calibration",
            summary="calibrated cameras",
        ),
        ProductSpec(
            type_name="checkpoints",
            target="orthoflow.products.inspections:CheckPoints",
            summary="surveyed check points",
        ),
        ProductSpec(
            type_name="truth",
            target="orthoflow.products.inspections:Truth",
            summary="what a simulated scene really is",
        ),
        ProductSpec(
            type_name="planes",
            target="orthoflow.products.planes:Planes",
            summary="planes with rectangles and covariances",
            publisher=f"{publish}:publish_planes",
        ),
        ProductSpec(
            type_name="labels",
            target="orthoflow.products.planes:PointLabels",
            summary="the plane of each point",
        ),
        ProductSpec(
            type_name="walls",
            target="orthoflow.products.walls:Walls",
            summary="depth, intensity and colour on each plane",
            publisher=f"{publish}:publish_walls",
        ),
        ProductSpec(
            type_name="ties",
            target="orthoflow.products.photographs:Ties",
            summary="points of photos known on walls",
            publisher=f"{publish}:publish_ties",
        ),
        ProductSpec(
            type_name="cameras",
            target="orthoflow.products.photographs:Cameras",
            summary="orientations of photos",
            publisher=f"{publish}:publish_cameras",
        ),
        ProductSpec(
            type_name="layers",
            target="orthoflow.products.walls:Layers",
            summary="each source laid onto each wall",
        ),
        ProductSpec(
            type_name="orthoimages",
            target="orthoflow.products.walls:Orthoimages",
            summary="the finished orthoimages",
            publisher=f"{publish}:publish_orthoimages",
        ),
        ProductSpec(
            type_name="openings",
            target="orthoflow.products.openings:Openings",
            summary="outlines of windows, doors and niches",
            publisher="orthoflow.files.opening_files:publish_openings",
        ),
        ProductSpec(
            type_name="inspection",
            target="orthoflow.products.inspections:Inspection",
            summary="measured displacements",
        ),
    ]


@hookimpl
def orthoflow_methods() -> list[MethodSpec]:
    """Give the built-in methods."""
    return [
        MethodSpec(
            id="read.scan",
            target="orthoflow_plugins.read.scan:ReadScan",
            summary="E57, LAS/LAZ, PLY, PCD, PTX and text scans -> cloud",
        ),
        MethodSpec(
            id="read.photos",
            target="orthoflow_plugins.read.photos:ReadPhotos",
            summary="JPEG, PNG and TIFF photos as they are, with EXIF and calibration",
        ),
        MethodSpec(
            id="read.checkpoints",
            target="orthoflow_plugins.read.checkpoints:ReadCheckpoints",
            summary="surveyed points from CSV files",
        ),
        MethodSpec(
            id="read.ties",
            target="orthoflow_plugins.read.ties:ReadTies",
            summary="points of photos that a person measured, from CSV files",
        ),
        MethodSpec(
            id="read.cameras",
            target="orthoflow_plugins.read.cameras:ReadCameras",
            summary="orientations that other programs found, in the frame of the scan",
        ),
        MethodSpec(
            id="read.orthoimage",
            target="orthoflow_plugins.read.orthoimage:ReadOrthoimage",
            summary="GeoTIFF orthoimages of other programs, with the frame of their wall",
        ),
        MethodSpec(
            id="simulate.room",
            target="orthoflow_plugins.simulate.room:SimulateRoom",
            summary="a scanned and photographed room with relief and obstacle, and its truth",
        ),
        MethodSpec(
            id="register.similarity",
            target="orthoflow_plugins.register.similarity:RegisterSimilarity",
            summary="shift, rotation and scale from pairs of points, with sigma0 and residuals",
        ),
        MethodSpec(
            id="plane.hough2d",
            target="orthoflow_plugins.plane.hough2d:Hough2d",
            summary="Hough transform of the plan, cells weighted by their points",
        ),
        MethodSpec(
            id="plane.hough3d",
            target="orthoflow_plugins.plane.hough3d:Hough3d",
            summary="Hough transform of voxels, planes in any direction",
        ),
        MethodSpec(
            id="plane.ransac",
            target="orthoflow_plugins.plane.ransac:Ransac",
            summary="random sample consensus: Max-Consensus, MSAC or AC-RANSAC, in 3D or the plan",
        ),
        MethodSpec(
            id="plane.region",
            target="orthoflow_plugins.plane.region:Region",
            summary="regions grown over neighbouring points with like normals and one plane",
        ),
        MethodSpec(
            id="plane.open3d-ransac",
            target="orthoflow_plugins.plane.open3d_ransac:Open3dRansac",
            summary="open3d's segment_plane, plane after plane, for comparison",
        ),
        MethodSpec(
            id="plane.open3d-patches",
            target="orthoflow_plugins.plane.open3d_patches:Open3dPatches",
            summary="open3d's detect_planar_patches, for comparison",
        ),
        MethodSpec(
            id="plane.given",
            target="orthoflow_plugins.plane.given:GivenPlane",
            summary="a reference plane that the user gives",
        ),
        MethodSpec(
            id="raster.grid",
            target="orthoflow_plugins.raster.grid:RasterGrid",
            summary="depth, intensity and colour per cell of each wall",
        ),
        MethodSpec(
            id="match.sift",
            target="orthoflow_plugins.match.sift:MatchSift",
            summary="key points of the photos and of the walls, RootSIFT, mutual and distinct",
        ),
        MethodSpec(
            id="face.photos",
            target="orthoflow_plugins.match.sides:FaceByPhotos",
            summary="planes whose side was guessed, turned to the side that the photos show",
        ),
        MethodSpec(
            id="match.guided",
            target="orthoflow_plugins.match.guided:MatchGuided",
            summary="photos laid into the walls by a first pose and measured there",
        ),
        MethodSpec(
            id="orient.pnp",
            target="orthoflow_plugins.orient.pnp:OrientPnp",
            summary="each photo by itself from its ties, with its accuracy or the reason against",
        ),
        MethodSpec(
            id="orient.dlt",
            target="orthoflow_plugins.orient.dlt:OrientDlt",
            summary="each photo by a direct linear transform, with or without distortion",
        ),
        MethodSpec(
            id="orient.colmap-bundle",
            target="orthoflow_plugins.orient.bundle:OrientColmapBundle",
            summary="all photos at once, tied to the walls and to each other, lenses refined",
        ),
        MethodSpec(
            id="orient.given",
            target="orthoflow_plugins.orient.given:OrientGiven",
            summary="poses from elsewhere, as they are or corrected by ties measured by hand",
        ),
        MethodSpec(
            id="colour.photos",
            target="orthoflow_plugins.colour.photos:ColourPhotos",
            summary="each point takes the colour of the photo that shows it best",
        ),
        MethodSpec(
            id="ortho.pointcloud-direct",
            target="orthoflow_plugins.ortho.pointcloud_direct:PointcloudDirect",
            summary="the topmost point colours its cell",
        ),
        MethodSpec(
            id="ortho.dsm-backward",
            target="orthoflow_plugins.ortho.dsm_backward:DsmBackward",
            summary="each cell of a wall looks up its colour in the photos that see it",
        ),
        MethodSpec(
            id="ortho.dsm-forward",
            target="orthoflow_plugins.ortho.dsm_forward:DsmForward",
            summary="each pixel of a photo is thrown onto the wall it shows",
        ),
        MethodSpec(
            id="mosaic.seams",
            target="orthoflow_plugins.mosaic.seams:MosaicSeams",
            summary="one orthoimage per wall from its layers",
        ),
        MethodSpec(
            id="segment.openings",
            target="orthoflow_plugins.segment.openings:SegmentOpenings",
            summary="windows, doors and niches as outlines, by depth, lines of sight and picture",
        ),
        MethodSpec(
            id="inspect.openings",
            target="orthoflow_plugins.inspect.openings:InspectOpenings",
            summary="compare outlines of openings with a simulated scene",
        ),
        MethodSpec(
            id="inspect.truth",
            target="orthoflow_plugins.inspect.truth:InspectTruth",
            summary="compare orthoimages, walls and planes with a simulated scene",
        ),
        MethodSpec(
            id="inspect.surf",
            target="orthoflow_plugins.inspect.surf:InspectSurf",
            summary="compare orthoimages with the laser's intensity, by SURF key points",
        ),
        MethodSpec(
            id="inspect.checkpoints",
            target="orthoflow_plugins.inspect.checkpoints:InspectCheckpoints",
            summary="compare orthoimages with surveyed points: residuals, outliers, classes",
        ),
    ]
