"""Camera trajectory from frames alone: COLMAP's incremental structure from motion (Schönberger & Frahm 2016).

The lens is known and fixed, frames are matched with their neighbours in time, and every random choice is seeded.
Features, matching and bundle adjustment are COLMAP's (doi:10.1109/CVPR.2016.445); gyroscope and row times are not used.
pycolmap works on files: a folder of frames and a working folder for its database.
"""

from __future__ import annotations

import shutil
import signal
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from virest.arrays import Array
from virest.camera.colmap import colmap_camera
from virest.camera.intrinsics import Intrinsics
from virest.errors import SettingsError

MAX_FEATURES = 500
"""SIFT features per frame."""
OVERLAP = 6
"""Each frame is matched with this many following frames, and with those 8, 16, 32, … frames later."""
LEAST_ANGLE_DEG = 6.0
"""Minimum triangulation angle of the initial pair; COLMAP's default of 16° suits photographs, not a short movie."""
THREADS = 1
"""One thread keeps the order of summation, and so the result, reproducible."""


@dataclass(frozen=True, slots=True)
class SfmPath:
    """Result of one run, in arbitrary axes and scale."""

    pictures: tuple[str, ...]
    """File names of the frames with a pose, in order."""
    position: Array
    """(n, 3) camera centres."""
    q_world_cam: Array
    """(n, 4) w x y z."""
    points: int
    """Number of scene points."""


def require_pycolmap() -> Any:
    """Import pycolmap and log only its errors.  Raises SettingsError if it is not installed."""
    previous_handler = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError as error:
        raise SettingsError(
            "structure from motion needs pycolmap", hint="pip install 'virest[slam]', or give a SLAM by --command"
        ) from error
    # importing pycolmap installs a SIGTERM handler that reports a crash with a stack trace: restore the previous one
    if previous_handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, previous_handler)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.logging.alsologtostderr = False
    return pycolmap


def match_pictures(pictures: Path, work: Path, lens: Intrinsics) -> Path:
    """Extract features of all frames in a folder and match neighbours by descriptor: path of the database.

    This step is deterministic, so runs with different seeds can share the database.
    """
    colmap = require_pycolmap()
    database = work / "matches.db"
    model, parameters = colmap_camera(lens)
    reader = colmap.ImageReaderOptions(camera_model=model, camera_params=",".join(f"{p:.9g}" for p in parameters))
    extraction = colmap.FeatureExtractionOptions(num_threads=THREADS, use_gpu=False)
    extraction.sift.max_num_features = MAX_FEATURES
    extraction.sift.first_octave = 0
    matching = colmap.FeatureMatchingOptions(num_threads=THREADS, use_gpu=False, skip_geometric_verification=True)
    pairing = colmap.SequentialPairingOptions(overlap=OVERLAP, num_threads=THREADS)
    cpu = colmap.Device.cpu
    colmap.extract_features(
        database,
        pictures,
        camera_mode=colmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=cpu,
    )
    colmap.match_sequential(database, matching, pairing, device=cpu)
    return database


def find_path(database: Path, work: Path, seed: int) -> SfmPath:
    """Verify the matches and map, both with this seed; the largest model is returned, an empty one if mapping fails."""
    colmap = require_pycolmap()
    run_folder = work / f"seed_{seed}"
    run_folder.mkdir(parents=True)
    verified = Path(shutil.copyfile(database, run_folder / "verified.db"))
    colmap.set_random_seed(seed)
    verifier = colmap.GeometricVerifierOptions(num_threads=THREADS)
    two_view = colmap.TwoViewGeometryOptions()
    two_view.ransac.random_seed = seed
    colmap.geometric_verification(verified, verifier, two_view_geometry_options=two_view)
    models = colmap.incremental_mapping(verified, run_folder, run_folder, _mapping(colmap, seed))
    if not models:
        return SfmPath((), np.empty((0, 3)), np.empty((0, 4)), 0)
    return _path(max(models.values(), key=lambda model: model.num_reg_images()))


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _mapping(colmap: Any, seed: int) -> Any:
    """Options of incremental mapping with a fixed lens."""
    options = colmap.IncrementalPipelineOptions(
        num_threads=THREADS,
        random_seed=seed,
        multiple_models=False,
        extract_colors=False,
        ba_use_gpu=False,
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
        ba_global_frames_ratio=1.3,
        ba_global_points_ratio=1.3,
    )
    options.mapper.init_min_tri_angle = LEAST_ANGLE_DEG
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    options.mapper.random_seed = options.triangulation.random_seed = seed
    return options


def _path(model: Any) -> SfmPath:
    posed = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    rotation = [Rotation.from_matrix(image.cam_from_world().rotation.matrix()).inv() for image in posed]
    return SfmPath(
        tuple(image.name for image in posed),
        np.array([image.projection_center() for image in posed]).reshape(-1, 3),
        np.array([turn.as_quat(scalar_first=True) for turn in rotation]).reshape(-1, 4),
        len(model.points3D),
    )
