"""The source of a capture's camera profile: a given file, the folder's camera.yaml, or its own metadata."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from virest.camera.field import Field
from virest.camera.kalibr import is_kalibr, parse_camchain
from virest.camera.profile import ANDROID_R_CAM_IMU, LANDSCAPE_R_CAM_IMU, CameraProfile
from virest.camera.profile_file import parse_profile
from virest.camera.shutter import Shutter
from virest.camera.yaml_mapping import load_yaml_mapping
from virest.capture.files import is_present
from virest.capture.location import locate
from virest.capture.logged_focal import corners
from virest.capture.records import Capture
from virest.errors import SettingsError

log = logging.getLogger(__name__)

PROFILE_NAME = "camera.yaml"


def default_profile(capture: Capture) -> CameraProfile:
    """The profile from the capture's own metadata.

    Documented defaults: principal point in the middle, no distortion; portrait pictures are read right to left with
    x_cam = diag(1, −1, −1) x_imu, landscape ones top to bottom with the Android landscape map; response and time
    offset unknown; readout unknown unless logged.  A recorder's own description of the camera (EuRoC's sensor.yaml, a
    .gcsv's header) replaces these defaults.
    """
    recorded = capture.recorded_profile
    if recorded is None:
        logged = capture.metadata
        recorded = phone_profile(capture.width, capture.height, logged.device, logged.focal_length_mm)
    return fill_from_metadata(recorded, capture)


def phone_profile(width: int, height: int, device: str = "", focal_length_mm: float | None = None) -> CameraProfile:
    """The default profile of a phone that does not describe its axes, by the shape of its stored picture."""
    portrait = height > width
    return CameraProfile(
        width=width,
        height=height,
        device=device,
        shutter=Shutter(0.0, "right_to_left" if portrait else "top_to_bottom"),
        readout_known=False,
        r_cam_imu=ANDROID_R_CAM_IMU if portrait else LANDSCAPE_R_CAM_IMU,
        axes_known=False,
        focal_length_mm=focal_length_mm,
    )


def fill_from_metadata(profile: CameraProfile, capture: Capture) -> CameraProfile:
    """Fill in the logged focal length and readout time if the profile has none; each with its source."""
    logged, source = capture.metadata, f"{capture.metadata_file}, median"
    if profile.intrinsics is None and (fx := logged.fx_px or logged.fy_px):
        fy = logged.fy_px or fx
        profile = profile.with_estimate("fx_px", fx, None, source, intrinsics=profile.lens_of(fx, fy))
    if not profile.readout_known and logged.readout_time_s is not None:
        shutter = replace(profile.shutter, readout_time_s=logged.readout_time_s)
        profile = profile.with_estimate(
            "readout_time_s", logged.readout_time_s, None, source, shutter=shutter, readout_known=True
        )
    return profile


def focus_log(capture: Capture) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Times, camera clock, and dioptres of the logged focus distance; None without a log.

    The rows of the last frame are read up to a frame period after its timestamp, while the lens goes on moving: the log
    is extended by a period along its last two values.
    """
    known = [(frame.time_s, frame.focus_dioptres) for frame in capture.frames if frame.focus_dioptres is not None]
    if not known:
        return None
    times, values = (list(column) for column in zip(*known, strict=True))
    if len(known) > 1:
        times.append(2 * times[-1] - times[-2])
        values.append(2 * values[-1] - values[-2])
    return tuple(map(float, times)), tuple(map(float, values))


def for_capture(profile: CameraProfile, capture: Capture) -> CameraProfile:
    """The profile with the fields and untrusted IMU intervals that apply to this capture.

    Those of another capture are removed.  A field over focus distance gets this capture's log, or is removed without.
    """
    focus = focus_log(capture)
    fields: list[Field] = []
    for field in profile.fields:
        if field.stamp_0_ns not in (None, capture.stamp_0_ns):
            text = "%s: a field of %s over %s belongs to another capture, ignored"
            log.info(text, capture.name, field.kind, field.covariates)
        elif "focus" not in field.covariates:
            fields.append(field)
        elif focus is not None:
            fields.append(replace(field, log=focus))
        else:
            log.warning("%s: no focus distance is logged: the field over it is ignored", capture.name)
    if profile.imu_untrusted_stamp_0_ns not in (None, capture.stamp_0_ns):
        profile = replace(profile, imu_untrusted_s=(), imu_untrusted_stamp_0_ns=None)
    return profile.with_fields(fields)


def with_logged_focal(profile: CameraProfile, capture: Capture) -> CameraProfile:
    """The profile with the focal length that the recorder logs for each frame, as a field.

    A profile that already has a focal drift or a field of the focal length is returned unchanged.
    """
    known = [frame for frame in capture.frames if frame.focal_scale is not None]
    has_own = profile.extensions.focal_drift_per_s or any(field.kind == "scale" for field in profile.fields)
    if not known or has_own:
        return profile
    # a logged value applies to the middle of its frame, and is interpolated linearly between frames
    middle_s = [f.time_s + 0.5 * ((f.exposure_s or 0.0) + profile.shutter.readout_time_s) for f in known]
    scales = np.array([f.focal_scale for f in known], np.float64)
    times, values = corners(np.array(middle_s), scales)
    ends = (float(scales.min()), float(scales.max()))
    log_of_capture = (tuple(times.tolist()), tuple(values.tolist()))
    field = Field("scale", ("focal",), (ends,), tuple((e - 1.0,) for e in ends), (), capture.stamp_0_ns, log_of_capture)
    return profile.with_fields([*profile.fields, field])


def read_any_profile(path: Path) -> CameraProfile:
    """Read a profile file: virest's own, or a Kalibr camera chain."""
    content = load_yaml_mapping(path)
    return parse_camchain(content, path.name) if is_kalibr(content) else parse_profile(content, path.name)


def resolve_profile(capture: Capture, config: Path | None = None) -> tuple[CameraProfile, str]:
    """The profile to use and its source: ``config``, else camera.yaml in the folder, else the metadata.

    Null focal length and readout are filled from plausible metadata.  Raises SettingsError if the profile's picture
    size is not the movie's, or the file cannot be read.
    """
    path = config
    if path is None and is_present(capture.folder / PROFILE_NAME):
        path = capture.folder / PROFILE_NAME
    if path is None:
        return with_logged_focal(default_profile(capture), capture), "the capture's metadata and documented defaults"
    profile = read_any_profile(locate(path))
    require_size(profile, capture, locate(path).name)
    return with_logged_focal(for_capture(fill_from_metadata(profile, capture), capture), capture), str(path)


def require_size(profile: CameraProfile, capture: Capture, name: str) -> None:
    """Raise SettingsError if the profile's picture size is not the movie's; ``name`` is the profile's in messages."""
    if (profile.width, profile.height) != (capture.width, capture.height):
        raise SettingsError(
            f"{name}: image {profile.width}x{profile.height}, but {capture.name}/{capture.movie.name} is "
            f"{capture.width}x{capture.height}",
            hint="a profile applies to one stored size; scale its intrinsics, or pass the profile of this mode",
        )
