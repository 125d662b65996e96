"""What planning notes about a capture: a code that later steps decide by, and the sentence that people read."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto


class NoteCode(Enum):
    """What a note is about."""

    DEFAULT_TAKEN = auto()
    """A value that the profile leaves open is the documented default."""
    TIME_OFFSET = auto()
    """The offset that the profile leaves open: estimated, or why not."""
    NOT_FOLLOWING = auto()
    """At no offset does the gyroscope explain half of the rotation: stabilised in the camera, or another log."""
    OTHER_OFFSET = auto()
    """The frames contradict a stated offset."""
    FOCAL_LENGTH = auto()
    """The focal length that the profile leaves open could not be estimated."""
    BLUR_LENGTH = auto()
    """The frames show blur paths of another length."""
    PROFILE_CONFLICT = auto()
    """Tracked points contradict the profile: what was put in its place, or that nothing explains them."""
    DISAGREEMENT = auto()
    """Frames and gyroscope do not belong together."""
    UNCHECKED = auto()
    """Whether they do could not be tested."""
    TRANSLATION = auto()
    """Travel and depth: not estimated, or in some frames only."""
    TRUE_TIMES = auto()
    """Frames are taken at other times than their stamps."""


@dataclass(frozen=True, slots=True)
class PlanNote:
    """One note."""

    code: NoteCode
    text: str
