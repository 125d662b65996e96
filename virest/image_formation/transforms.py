"""Fourier transforms of real tiles in OpenCV's packed form, by the faster library of this installation.

OpenCV is faster if built with Intel's IPP.  Without it (other processors, or switched off) pocketfft takes about half
of OpenCV's time for tiles of 160 px or more.  The choice depends on the build and the size, never on timings, so all
processes of a run agree; the results differ only by rounding.  `virest doctor` measures both.

Packed form ("CCS") of a spectrum with even height and width: columns 1 to width − 2 hold the real and imaginary parts
of the horizontal frequencies 1 to width / 2 − 1 side by side.  The first and the last column hold frequencies 0 and
width / 2: the real values at the vertical frequencies 0 and height / 2 at their ends, the others between them, real and
imaginary parts one below the other.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

Image = NDArray[np.float32]
Transform = Callable[[Image, Image | None], Image]
"""Takes a picture or its packed spectrum, (height, width) float32, and an output array, or None for a new one."""
OPENCV, POCKETFFT = "OpenCV", "scipy's pocketfft"
LEAST_POCKETFFT_PX = 128
"""Smaller tiles use OpenCV, because repacking costs what the transform saves (`virest doctor`, both libraries)."""


def opencv_forward(picture: Image, out: Image | None = None) -> Image:
    """Packed spectrum of a picture."""
    return cv2.dft(picture, out)


def opencv_inverse(spectrum: Image, out: Image | None = None) -> Image:
    """Picture of a packed spectrum."""
    return cv2.idft(spectrum, out, flags=cv2.DFT_SCALE)


def pocketfft_forward(picture: Image, out: Image | None = None) -> Image:
    """Packed spectrum of a picture of even height and width."""
    height, width = picture.shape
    packed = np.empty_like(picture) if out is None else out
    parts = fft.rfft2(picture).view(np.float32)
    packed[:, 1:-1] = parts[:, 2:-2]
    for column, part in ((0, 0), (width - 1, width)):
        packed[0, column], packed[-1, column] = parts[0, part], parts[height // 2, part]
        packed[1:-1, column].reshape(-1, 2)[:] = parts[1 : height // 2, part : part + 2]
    return packed


def pocketfft_inverse(spectrum: Image, out: Image | None = None) -> Image:
    """Picture of a packed spectrum of even height and width."""
    height, width = spectrum.shape
    numbers = np.empty((height, width // 2 + 1), np.complex64)
    numbers.view(np.float32)[:, 2:-2] = spectrum[:, 1:-1]
    for column, frequency in ((0, 0), (width - 1, width // 2)):
        numbers[0, frequency], numbers[height // 2, frequency] = spectrum[0, column], spectrum[-1, column]
        upper = np.ascontiguousarray(spectrum[1:-1, column]).view(np.complex64)
        numbers[1 : height // 2, frequency] = upper
        numbers[height // 2 + 1 :, frequency] = upper[::-1].conj()
    picture = fft.irfft2(numbers, s=(height, width), overwrite_x=True)
    if out is None:
        return picture
    out[:] = picture
    return out


def library(height: int, width: int) -> str:
    """Name of the library that transforms pictures of this size."""
    if cv2.ipp.useIPP() or min(height, width) < LEAST_POCKETFFT_PX or height % 2 or width % 2:
        return OPENCV
    return POCKETFFT


def in_use() -> str:
    """Name of the library that transforms large tiles here; the other one gives different last bits."""
    return library(LEAST_POCKETFFT_PX, LEAST_POCKETFFT_PX)


def forward(picture: Image, out: Image | None = None) -> Image:
    """Packed spectrum of a picture, (height, width) float32; out: array for the result."""
    return (opencv_forward if library(*picture.shape) == OPENCV else pocketfft_forward)(picture, out)


def inverse(spectrum: Image, out: Image | None = None) -> Image:
    """Picture of a packed spectrum, (height, width) float32; out: array for the result."""
    return (opencv_inverse if library(*spectrum.shape) == OPENCV else pocketfft_inverse)(spectrum, out)
