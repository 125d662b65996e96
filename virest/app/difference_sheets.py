"""Pictures of an evaluation: labelled frames and their differences from ground truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from virest.app.outputs import output_error, write_picture
from virest.arrays import Picture
from virest.evaluation.fidelity import difference_map

MAP_GAIN = 2
"""Gain of the difference maps: most differences are below 30 grey levels, too dark to see."""
HEAD_PX, GAP_PX = 22, 4
"""Height of a label, and white space to the right of and below a picture; the label's font is about 11 px high."""
WHITE = (255, 255, 255)
"""RGB."""


def amplified_difference(picture: Picture, truth: Picture) -> Picture:
    """The difference map of a picture, RGB, amplified by MAP_GAIN; black where they agree."""
    grey = cv2.convertScaleAbs(difference_map(picture, truth), alpha=MAP_GAIN)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), np.uint8)


def labelled(name: str, picture: Picture) -> Picture:
    """An RGB picture below its name."""
    framed = cv2.copyMakeBorder(picture, HEAD_PX, GAP_PX, 0, GAP_PX, cv2.BORDER_CONSTANT, value=WHITE)
    cv2.putText(framed, name, (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.asarray(framed, np.uint8)


def write_sheet(path: Path, picture: Picture) -> None:
    """Write an RGB picture, and its folder if it is missing.  Raises OutputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(path.parent, error) from error
    write_picture(path, np.ascontiguousarray(picture))
