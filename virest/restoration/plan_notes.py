"""Notes of the planning stage about a capture: a code for later steps, and a text for the user."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto


class NoteCode(Enum):
    """Subject of a note."""

    DEFAULT_TAKEN = auto()
    """A value missing in the profile is set to its documented default."""
    DOUBTFUL_LOG = auto()
    """The inertial log itself shows stretches that do not look like a gyroscope's."""
    TIME_OFFSET = auto()
    """The offset, missing in the profile, was estimated, or why it was not."""
    NOT_FOLLOWING = auto()
    """At no offset does the gyroscope explain half of the rotation: stabilised in the camera, or the wrong log."""
    OTHER_AXES = auto()
    """The gyroscope explains the rotation with other axes than the profile's."""
    OTHER_OFFSET = auto()
    """The frames contradict a stated offset, and theirs is used."""
    READOUT = auto()
    """The readout, missing in the profile, was estimated."""
    FOCAL_LENGTH = auto()
    """The focal length, missing in the profile, could not be estimated."""
    BLUR_LENGTH = auto()
    """The frames show blur paths of another length."""
    FINER_DETAIL = auto()
    """The frames show detail that the profile's defocus would remove."""
    PROFILE_CONFLICT = auto()
    """Tracked points contradict the profile: the values used instead, or that nothing explains them."""
    DISAGREEMENT = auto()
    """Frames and gyroscope do not belong together."""
    UNCHECKED = auto()
    """Whether frames and gyroscope belong together could not be tested."""
    TRANSLATION = auto()
    """Translation and depth: not estimated, or in some frames only."""
    TRUE_TIMES = auto()
    """Frames are used at other times than their stamps."""


@dataclass(frozen=True, slots=True)
class PlanNote:
    """A note about a capture."""

    code: NoteCode
    text: str
