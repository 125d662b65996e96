"""``virest simulate OUT``: write a capture with known ground truth."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.errors import SettingsError
from virest.simulation.auto_exposure import AutoExposure
from virest.simulation.effects import EffectContext, hidden_isp, hide_effects
from virest.simulation.hidden import NOTHING, Hidden
from virest.simulation.phone_isp import OFF, PhoneIsp
from virest.simulation.recording import FOCUS_DIOPTRES, RecordingOptions, write_recording
from virest.simulation.session import Session, SessionSettings, nominal_camera, plan_session

log = logging.getLogger(__name__)


def simulate_command(
    out: Path,
    *,
    scene: str = "leaves",
    width: int = 720,
    height: int = 1280,
    frames: int = 12,
    fps: float = 30.0,
    exposure_ms: float | Sequence[float] = 10.0,
    auto_exposure_ev: float | None = None,
    auto_exposure_steps: int | None = None,
    readout_ms: float = 20.0,
    direction: str | None = None,
    focal_px: float | None = None,
    distortion: tuple[str, tuple[float, ...]] = ("none", ()),
    rate_rad_s: float = 1.0,
    pan_rad_s: float = 0.0,
    near_m: float | None = None,
    moving_px_s: float = 0.0,
    noise_levels: float = 1.5,
    response: str | ResponseCurve = "srgb",
    depth_m: float | None = None,
    tilt_deg: tuple[float, float] = (0.0, 0.0),
    sway_m: float | None = None,
    imu_rate_hz: float = 200.0,
    gyro_noise_rad_s: float = 0.0015,
    accel_noise_m_s2: float = 0.02,
    seed: int = 0,
    effects: Sequence[str] = (),
    layout: str = "2021",
    clock: str = "REALTIME",
    bitrate_bits_per_px: float = 0.25,
    crf: float | None = None,
    reference: str = "exposure-start",
    truth_frames: bool = True,
    overwrite: bool = False,
    profile: CameraProfile | None = None,
    hidden: Hidden = NOTHING,
    isp: PhoneIsp = OFF,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Simulate a recording and write it to ``out``; returns a summary for ``--json``.

    exposure_ms: one exposure, or several that frames cycle through; the ISO compensates for changes.
    auto_exposure_ev: exposure × ISO, and the brightness with it, vary smoothly over this range about exposure_ms;
    with auto_exposure_steps they rise in that many steps.  rate_rad_s: 0 for a camera that does not rotate; if it does
    not sway either (no depth_m, or sway_m 0), all frames are static.  direction: by default right_to_left for portrait
    and top_to_bottom for landscape.  pan_rad_s: constant yaw rate.  near_m: distance of objects in front of the scene.
    moving_px_s: speed of objects that move across it.  depth_m: distance of the scene's plane, None for infinity.
    effects: ``NAME`` or ``NAME=VALUE`` (contract, section 4), stated only in ``truth/``.
    hidden: effects without a name, for tests.
    reference: ``frame-middle`` also writes truth/frame_middle.  truth_frames: whether to write truth/frames.
    profile: use this camera as the nominal one; it defines width, height, focal_px, distortion, readout_ms, direction
    and response.
    isp: the phone's own processing; truth/ includes its global curves, the capture's profile nothing of it.
    """
    if reference not in ("exposure-start", "frame-middle"):
        raise SettingsError(f"reference '{reference}' is not known", hint="use exposure-start or frame-middle")
    exposures_ms = [float(exposure_ms)] if isinstance(exposure_ms, int | float) else [float(e) for e in exposure_ms]
    nominal = profile or nominal_camera(
        width,
        height,
        focal_px=focal_px,
        readout_time_s=readout_ms / 1000,
        readout_direction=direction,
        response=response if isinstance(response, ResponseCurve) else parse_response(response),
        distortion=distortion,
        depth_m=np.inf if depth_m is None else depth_m,
    )
    nominal = _of_new_capture(nominal)
    context = EffectContext(frames, fps, np.random.default_rng([seed, 5]))
    true, applied = hide_effects(nominal, list(effects), context)
    isp = hidden_isp(applied, isp)
    settings = SessionSettings(
        scene=scene,
        frames=frames,
        fps=fps,
        exposure_s=tuple(e / 1000 for e in exposures_ms),
        auto_exposure=_auto_exposure(auto_exposure_ev, auto_exposure_steps),
        rate_rad_s=rate_rad_s,
        sway_m=sway_m,
        pan_rad_s=pan_rad_s,
        tilt_rad=(float(np.deg2rad(tilt_deg[0])), float(np.deg2rad(tilt_deg[1]))),
        near_m=near_m,
        moving_px_s=moving_px_s,
        noise_levels=noise_levels,
        imu_rate_hz=imu_rate_hz,
        gyro_noise_rad_s=gyro_noise_rad_s,
        accel_noise_m_s2=accel_noise_m_s2,
        seed=seed,
        isp=isp,
    )
    session = plan_session(nominal, isp.true_profile(true), settings, hidden=hidden)
    bits_per_px = isp.bits_per_px or bitrate_bits_per_px
    options = RecordingOptions(layout, clock, bits_per_px, crf, reference == "frame-middle", truth_frames)
    folder = write_recording(
        session, Path(out), applied=applied, options=options, overwrite=overwrite, progress=progress
    )  # fmt: skip
    return {
        "capture": str(folder),
        **recording_facts(session, scene, fps, exposures_ms),
        **_exposed(session),
        **({"isp": isp.in_force()} if isp.in_force() else {}),
        "effects": [dataclasses.asdict(effect) for effect in applied],
    }


def recording_facts(session: Session, scene: str, fps: float, exposure_ms: list[float]) -> dict[str, Any]:
    """Facts of any simulated recording for ``--json``."""
    nominal = session.nominal
    return {
        "scene": scene,
        "width": nominal.width,
        "height": nominal.height,
        "frames": session.settings.frames,
        "fps": fps,
        "exposure_ms": exposure_ms,
        "readout_ms": nominal.shutter.readout_time_s * 1000,
        "readout_direction": nominal.shutter.readout_direction,
        "seed": session.settings.seed,
        "blur_px": session.blur_px(),
    }


def _of_new_capture(profile: CameraProfile) -> CameraProfile:
    """The profile with the fields that apply to a new capture: none of another capture, and a constant focus."""
    others = [field for field in profile.fields if field.belongs_to_one_capture]
    for field in others:
        log.warning(
            "a field of %s over %s belongs to another capture: left out", field.kind, ", ".join(field.covariates)
        )
    at_rest = ((0.0, 1.0), (FOCUS_DIOPTRES, FOCUS_DIOPTRES))
    kept = [
        replace(field, log=at_rest) if "focus" in field.covariates else field
        for field in profile.fields
        if field not in others
    ]
    if profile.imu_untrusted_stamp_0_ns is not None:
        profile = replace(profile, imu_untrusted_s=(), imu_untrusted_stamp_0_ns=None)
    return profile.with_fields(kept)


def _auto_exposure(range_ev: float | None, steps: int | None) -> AutoExposure | None:
    if range_ev is None and steps is not None:
        raise SettingsError(f"{steps} exposure steps without a range", hint="also give the range in EV")
    return None if range_ev is None else AutoExposure(range_ev, steps)


def _exposed(session: Session) -> dict[str, Any]:
    """The result of auto-exposure: shortest and longest logged exposure, lowest and highest ISO."""
    if session.settings.auto_exposure is None:
        return {}
    exposures = session.exposures
    return {
        "auto_exposure_ev": session.settings.auto_exposure.range_ev,
        "exposure_range_ms": [round(float(e) * 1000, 4) for e in (exposures.logged_s.min(), exposures.logged_s.max())],
        "iso_range": [int(exposures.iso.min()), int(exposures.iso.max())],
    }


def parse_response(text: str) -> ResponseCurve:
    """Parse a curve: ``srgb``, ``linear``, ``gamma:2.2`` or ``five_segment[:xb,yb,xc,yc,y_max]``."""
    kind, _, numbers = text.partition(":")
    kind = kind.strip().replace("-", "_")
    try:
        values = [float(n) for n in numbers.split(",")] if numbers else []
    except ValueError:
        raise SettingsError(f"response '{text}' is not a curve", hint="write gamma:2.2, for example") from None
    if kind in ("srgb", "linear") and not values:
        return ResponseCurve(kind)
    if kind == "gamma" and len(values) <= 1:
        return ResponseCurve("gamma", gamma=values[0] if values else 2.2)
    if kind == "five_segment" and len(values) in (0, 5):
        xb, yb, xc, yc, top = values or (0.12, 0.08, 0.62, 0.80, 1.0)
        return ResponseCurve("five_segment", b=(xb, yb), c=(xc, yc), y_max=top)
    raise SettingsError(f"response '{text}' is not a curve", hint="use srgb, linear, gamma:2.2 or five_segment")
