"""pycolmap: what differs between its versions, its models, databases and estimators."""

import pycolmap

from .databases import (
    add_camera_mode,
    camera_mode,
    count_verified,
    import_images,
    open_database,
    read_cameras,
    read_verified,
    write_matches,
    write_reference,
)
from .estimators import (
    estimate_pose,
    incremental_mapping,
    mapper_options,
    solver_options,
    triangulate_points,
    verify_matches,
)
from .models import (
    add_image,
    cam_from_img,
    check_whole,
    infer_camera,
    point3D_ids,
    read_model,
    write_part,
)
from .sift import check_dog_options, detect_dog
from .stored import SIFT, StoredDatabase, open_stored, shapes

pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)

__all__ = [
    "SIFT",
    "StoredDatabase",
    "add_camera_mode",
    "add_image",
    "cam_from_img",
    "camera_mode",
    "check_dog_options",
    "check_whole",
    "count_verified",
    "detect_dog",
    "estimate_pose",
    "import_images",
    "open_database",
    "incremental_mapping",
    "infer_camera",
    "mapper_options",
    "open_stored",
    "point3D_ids",
    "read_cameras",
    "read_model",
    "read_verified",
    "shapes",
    "solver_options",
    "triangulate_points",
    "verify_matches",
    "write_matches",
    "write_part",
    "write_reference",
]
