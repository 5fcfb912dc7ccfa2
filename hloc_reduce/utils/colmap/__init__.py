"""pycolmap: what differs between its versions, its models, databases and estimators."""

import pycolmap

from .databases import (
    CAMERA_MODE,
    CAMERA_MODEL,
    CAMERA_MODELS,
    CameraMode,
    camera_mode,
    count_verified,
    import_images,
    lens_options,
    open_database,
    read_cameras,
    read_verified,
    same_geometries,
    write_matches,
    write_reference,
)
from .enu import ellipsoid_from_enu, enu_from_ellipsoid
from .estimators import (
    MIN_OF_POSE,
    bundle_adjuster,
    covariance,
    estimate_pose,
    estimate_rig_pose,
    exact,
    incremental_mapping,
    mapper_options,
    refine_pose,
    refine_rig_pose,
    triangulate_points,
    verify_matches,
)
from .exchange import write_for_all
from .models import (
    add_image,
    cam_from_img,
    find_model,
    fingerprint,
    infer_camera,
    model_files,
    observed,
    point3D_ids,
    read_model,
    read_normalized,
    remove_images,
    visibility,
    with_cameras,
    write_model,
    write_part,
)
from .origin import near_from_world, near_origin, transformed
from .records import PARTS
from .sift import check_dog_options, detect_dog
from .stored import SIFT, StoredDatabase, open_stored, shapes

pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
