"""PNG files: another decoder reads exactly what was written."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from virest.app.png import SIGNATURE, less_row_above, png_bytes


def _pictures() -> dict[str, NDArray[np.uint8]]:
    rng = np.random.default_rng(5)
    noise = rng.integers(0, 256, (37, 53, 3), np.uint8)
    ramp = (np.add.outer(3 * np.arange(61), 2 * np.arange(83))[..., None] * np.array([1, 2, 5])).astype(np.uint8)
    return {
        "noise": noise,
        "ramp": ramp,
        "one row": noise[:1],
        "one column": noise[:, 7:8],
        "one pixel": noise[3:4, 5:6],
        "black": np.zeros((19, 31, 3), np.uint8),
        "extremes": np.where(noise > 127, 255, 0).astype(np.uint8),
        "reversed view": noise[::-1, :, ::-1],
        "part of a larger one": noise[5:30, 9:44],
        "wide": rng.integers(0, 256, (2, 70_001, 3), np.uint8),
    }


@pytest.mark.parametrize("name", _pictures())
def test_another_decoder_reads_back_every_pixel(name: str) -> None:
    """OpenCV's decoder returns the picture exactly, for any size, content and memory layout."""
    picture = _pictures()[name]
    read = cv2.imdecode(np.frombuffer(png_bytes(picture), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read[..., ::-1], picture)


def test_a_grey_picture_stays_grey() -> None:
    """One channel is written and one is read."""
    grey = np.random.default_rng(6).integers(0, 256, (29, 41), np.uint8)
    read = cv2.imdecode(np.frombuffer(png_bytes(grey), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read, grey)


def test_every_chunk_carries_its_checksum() -> None:
    """Each chunk has the length, type, data and zlib's CRC-32 of type and data, up to the end of the file."""
    data = png_bytes(_pictures()["ramp"])
    assert data.startswith(SIGNATURE)
    kinds, place = [], len(SIGNATURE)
    while place < len(data):
        length = int.from_bytes(data[place : place + 4], "big")
        body = data[place + 4 : place + 8 + length]
        assert int.from_bytes(data[place + 8 + length : place + 12 + length], "big") == zlib.crc32(body)
        kinds.append(body[:4])
        place += 12 + length
    assert kinds == [b"IHDR", b"IDAT", b"IEND"]


def test_the_same_picture_gives_the_same_bytes() -> None:
    """The bytes depend only on the pixels, not on time or memory layout."""
    picture = _pictures()["noise"]
    elsewhere = np.ascontiguousarray(picture[::-1])[::-1]
    assert png_bytes(picture) == png_bytes(picture) == png_bytes(elsewhere)


def test_rows_are_filtered_modulo_256() -> None:
    """PNG's filter "up": 3 − 250 is 9, the first row is unchanged, and each row begins with the filter type, 2."""
    rows = np.array([[250, 7], [3, 7], [3, 200]], np.uint8)
    np.testing.assert_array_equal(less_row_above(rows), [[2, 250, 7], [2, 9, 0], [2, 0, 193]])


@pytest.mark.parametrize("shape", [(0, 5, 3), (5, 0, 3), (4, 4, 2), (4,), (2, 2, 2, 3)])
def test_an_array_that_is_not_a_picture_is_rejected(shape: tuple[int, ...]) -> None:
    """Arrays without pixels or with a channel count that PNG does not have."""
    with pytest.raises(ValueError, match="not an 8-bit picture"):
        png_bytes(np.zeros(shape, np.uint8))


def test_sixteen_bits_are_refused() -> None:
    """They would be written as twice the number of pixels."""
    with pytest.raises(ValueError, match="uint16"):
        png_bytes(np.zeros((4, 4, 3), np.uint16))
