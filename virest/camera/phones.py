"""Readout times of known phones and cameras, each with its source, for a single video mode."""

from __future__ import annotations

from dataclasses import dataclass

_RINGABY = "E. Ringaby, P.-E. Forssén, IJCV 96, 2012, doi:10.1007/s11263-011-0465-8 (LED panel)"
_THALIN = "G. Thalin, Deshaker, rolling-shutter table, guthspot.se/video/deshaker.htm (panning past an edge)"
_OTH = "L. Oth et al., CVPR 2013, doi:10.1109/CVPR.2013.179 (checkerboard)"
_LED_TABLE = "J. Huai, rolling-shutter table of JzHuai0108/kalibr (LED panel)"


@dataclass(frozen=True, slots=True)
class Readout:
    """A measured readout time."""

    device: str
    width: int
    height: int
    frame_rate_hz: float | None
    readout_s: float
    std_s: float | None
    """Standard deviation of the measurement; None: not published."""
    source: str


def _table(source: str, *rows: tuple[str, int, int, float | None, float, float | None]) -> tuple[Readout, ...]:
    return tuple(
        Readout(device, width, height, rate, round(ms * 1e-3, 8), None if std is None else round(std * 1e-3, 8), source)
        for device, width, height, rate, ms, std in rows
    )


READOUTS: tuple[Readout, ...] = (
    *_table(
        _RINGABY,
        ("iPhone 3GS", 640, 480, 30, 30.84, 0.36),
        ("iPhone 4", 1280, 720, 30, 31.98, 0.25),
        ("iPhone 4, front", 640, 480, 30, 29.99, 0.16),
        ("iPod touch 4", 1280, 720, 30, 30.07, 0.25),
        ("iPod touch 4, front", 640, 480, 30, 31.39, 0.07),
        ("HTC Desire", 640, 480, None, 57.84, 0.051),
        ("HTC Desire", 1280, 720, None, 43.834, 0.034),
        ("Sony Ericsson W890i", 320, 240, 14.706, 60.78, 0.16),
        ("Sony Ericsson Xperia X10", 640, 480, None, 28.386, 0.024),
        ("Sony Ericsson Xperia X10", 800, 480, None, 27.117, 0.040),
    ),
    *_table(
        _THALIN,
        ("GoPro Hero3+ Black, wide", 1920, 1080, 60, 14.82, None),
        ("GoPro Hero3+ Black, narrow", 1920, 1080, 60, 14.34, None),
        ("iPhone 5", 1920, 1080, 30, 27.37, 0.03),
        ("iPhone 5", 1920, 1080, 24, 27.42, 0.04),
        ("iPhone 5, stabilisation off", 1920, 1080, 30, 29.87, 0.03),
        ("Samsung Galaxy S3", 1920, 1080, 30, 30.0, 0.33),
    ),
    *_table(
        _OTH,
        ("iPhone 4S", 1920, 1080, 30, 26.05, 0.56),
        ("Samsung Galaxy S3", 1920, 1080, 30, 32.67, 0.73),
    ),
    *_table(
        _LED_TABLE,
        ("Honor View 10", 1280, 720, 30, 20.68, 0.13),
        ("iPhone 6S", 1280, 720, 30, 15.01, 0.35),
        ("Lenovo Phab 2 Pro", 1280, 720, 30, 31.39, 0.30),
        ("Asus Zenfone AR", 1280, 720, 26, 7.42, 0.31),
    ),
)


def find_readouts(text: str) -> tuple[Readout, ...]:
    """Entries whose device name contains every word of the text, ignoring case."""
    words = text.lower().split()
    return tuple(entry for entry in READOUTS if all(word in entry.device.lower() for word in words))
