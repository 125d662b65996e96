"""``virest doctor``: what is installed, what the machine offers, and what that means for processing."""

from __future__ import annotations

import os
import platform
import shutil
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from virest import __version__
from virest.app.machine import cores, installed_version, processor

if TYPE_CHECKING:
    from virest.image_formation.transforms import Transform

Json = dict[str, Any]
NEEDED = ("numpy", "scipy", "opencv-python-headless", "av", "deflate", "pandas", "pydantic", "PyYAML", "typer", "tqdm",
          "matplotlib", "jinja2")  # fmt: skip
EXTRAS = {
    "cluster": ("distributed", "fsspec", "s3fs"),
    "slam": ("pycolmap", "evo"),
    "telemetry": ("telemetry-parser",),
    "rosbags": ("rosbags",),
}
TILE_PX, TILE_TRANSFORMS = 192, 40
"""Side of the tile whose transforms are timed, and number of transforms per timing."""
DECODERS, ENCODER = ("h264", "hevc", "vp9", "av1"), "libx264"
PER_WORKER_BYTES = 300e6
"""Peak memory of a worker at 720x1280 (`python -m virest.app.bench --only memory`)."""
USUAL_FFT_S = 0.010
"""Time of the transform below on a core of 2.5 GHz; a note is given above twice that."""


def examine() -> tuple[Json, str, int]:
    """Facts for ``--json``, the text, and the exit code: 1 if a requirement is missing."""
    facts: Json = {
        "virest": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "packages": {name: installed_version(name) for name in NEEDED},
        "extras": {name: all(installed_version(package) for package in packages) for name, packages in EXTRAS.items()},
        "processor": processor(),
        "cores": cores(),
        "memory_bytes": _memory_bytes(),
        "free_bytes_here": shutil.disk_usage(Path.cwd()).free,
    }
    missing = [name for name, found in facts["packages"].items() if found is None]
    if not missing:
        facts |= _abilities()
        missing += [f"{ENCODER} in PyAV"] if not facts["encoder"] else []
        missing += ["h264 in PyAV"] if "h264" not in facts["decoders"] else []
    facts["missing"] = missing
    facts["notes"] = _notes(facts)
    return facts, _describe(facts), 1 if missing else 0


def _memory_bytes() -> int | None:
    """Memory of the machine, or the container's limit; None if the system does not report it."""
    limits = []
    with suppress(AttributeError, ValueError, OSError):
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    with suppress(OSError, ValueError):
        limits.append(int(Path("/sys/fs/cgroup/memory.max").read_text("ascii")))
    return min(limits, default=None)


def _abilities() -> Json:
    """Codecs, and the time of Fourier transforms on one core."""
    import av
    import cv2
    import numpy as np

    from virest.image_formation import transforms

    picture = np.random.default_rng(1).random((1280, 720), dtype=np.float32)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    times = []
    for _ in range(5):
        began = time.perf_counter()
        cv2.dft(picture, flags=cv2.DFT_COMPLEX_OUTPUT)
        times.append(time.perf_counter() - began)
    cv2.setNumThreads(threads)
    return {
        "decoders": [name for name in DECODERS if name in av.codecs_available],
        "encoder": ENCODER if ENCODER in av.codecs_available else None,
        "vector_instructions": bool(cv2.useOptimized()),
        "transforms": transforms.library(TILE_PX, TILE_PX),
        "ipp": cv2.ipp.getIppVersion() if cv2.ipp.useIPP() else None,
        "tile_fft_s": {
            transforms.OPENCV: _tile_s(transforms.opencv_forward, transforms.opencv_inverse),
            transforms.POCKETFFT: _tile_s(transforms.pocketfft_forward, transforms.pocketfft_inverse),
        },
        "fft_s": round(min(times), 5),
    }


def _tile_s(forward: Transform, inverse: Transform) -> float:
    """CPU seconds of one tile's forward and inverse transform with one library: the minimum of five runs."""
    import numpy as np

    tile = np.random.default_rng(1).random((TILE_PX, TILE_PX), dtype=np.float32)
    spectrum, back = np.empty((2, TILE_PX, TILE_PX), np.float32)
    times = []
    for _ in range(5):
        began = time.process_time()
        for _ in range(TILE_TRANSFORMS):
            inverse(forward(tile, spectrum), back)
        times.append(time.process_time() - began)
    return round(min(times) / TILE_TRANSFORMS, 7)


def _notes(facts: Json) -> list[str]:
    """Notes on what would be slow or fail, and why."""
    notes = []
    if facts["cores"] == 1:
        notes.append("one core: frames are restored one at a time; --preset fast is many times faster than best")
    memory = facts["memory_bytes"]
    if memory is not None and facts["cores"] * PER_WORKER_BYTES > 0.8 * memory:
        jobs = max(int(0.8 * memory / PER_WORKER_BYTES), 1)
        notes.append(
            f"{memory / 1e9:.1f} GB for {facts['cores']} workers of 0.3 GB each (720x1280): pass --jobs {jobs}"
        )
    if not facts.get("vector_instructions", True):
        notes.append("OpenCV runs without vector instructions: deblurring takes several times as long; reinstall it")
    if "ipp" in facts and facts["ipp"] is None:
        notes.append(
            "OpenCV computes Fourier transforms without Intel IPP (not in its build for this processor, or disabled): "
            "deblurring takes up to 50 % longer"
        )
    if facts.get("fft_s", 0.0) > 2 * USUAL_FFT_S:
        times = facts["fft_s"] / USUAL_FFT_S
        notes.append(
            f"a Fourier transform takes {times:.1f} times the usual time: slow core, or one shared with other processes"
        )
    if facts["free_bytes_here"] < 2e9:
        notes.append(
            f"{facts['free_bytes_here'] / 1e9:.1f} GB free here; a minute of 720x1280 as PNGs takes about 2 GB"
        )
    if "hevc" not in facts.get("decoders", ("hevc",)):
        notes.append("no HEVC decoder: movies of newer phones cannot be read")
    return notes


def _describe(facts: Json) -> str:
    packages = ", ".join(f"{name} {found or 'MISSING'}" for name, found in facts["packages"].items())
    extras = ", ".join(f"{name}: {'yes' if there else 'no'}" for name, there in facts["extras"].items())
    memory = "unknown" if facts["memory_bytes"] is None else f"{facts['memory_bytes'] / 1e9:.1f} GB"
    lines = [
        f"virest {facts['virest']}, Python {facts['python']}, {facts['system']}",
        f"packages  {packages}",
        f"extras    {extras}; pip install 'virest[NAME]' adds one",
        f"machine   {facts['processor'] or 'unknown processor'}, {facts['cores']} cores, {memory} of memory, "
        f"{facts['free_bytes_here'] / 1e9:.1f} GB free here",
    ]
    if "decoders" in facts:
        lines.append(f"codecs    reads {', '.join(facts['decoders'])}; writes {facts['encoder'] or 'no H.264'}")
        lines.append(f"speed     Fourier transform of 720x1280 in {1e3 * facts['fft_s']:.1f} ms on one core")
        tiles = ", ".join(f"{1e6 * seconds:.0f} µs by {name}" for name, seconds in facts["tile_fft_s"].items())
        lines.append(f"          a tile of {TILE_PX} px, forward and inverse: {tiles} (CPU time)")
        lines.append(f"          frames are transformed by {facts['transforms']} ({facts['ipp'] or 'no IPP'})")
    lines += [f"note: {note}" for note in facts["notes"]]
    missing = ", ".join(facts["missing"])
    return "\n".join([*lines, f"missing: {missing}" if missing else "all requirements are installed"])
