"""Write the documentation's gallery of effects: simulate each effect, diagnose the capture, draw what was found.

``python -m virest.app.gallery docs`` writes docs/gallery.md and docs/images/gallery/*.png; ``make figures`` calls it.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from virest.app.console import emit
from virest.app.diagnose import draw_figures, open_source
from virest.app.outputs import write_whole
from virest.app.pictures import compact
from virest.app.simulate import simulate_command
from virest.diagnosis.findings import BLUR, EDGES, GEOMETRY, PHOTOMETRY
from virest.diagnosis.geometric_evidence import CAP
from virest.diagnosis.ladder import diagnose_capture
from virest.effects.table import EFFECTS

FRAMES, WIDTH, HEIGHT, SEED = 60, 640, 480, 11
"""Two seconds of the simulator's usual landscape frame; any seed."""
EVIDENCE = {
    GEOMETRY: "tracked points",
    PHOTOMETRY: "brightness along tracks",
    BLUR: "blur of image regions",
    EDGES: "isolated edges",
}


@dataclass(frozen=True, slots=True)
class Case:
    """The effect hidden in one capture, and its visible signs."""

    value: str
    """VALUE of ``simulate --effect NAME=VALUE``."""
    look_for: str
    options: tuple[tuple[str, Any], ...] = ()
    """Further arguments of the simulation."""


CASES: dict[str, Case] = {
    "time_offset": Case("0.012", "residuals proportional to angular acceleration; no trend over the row"),
    "clock_skew": Case("0.004", "residuals that grow from the first frame to the last"),
    "readout_time": Case(
        "0.012", "residuals that grow linearly from the first row to the last, with the rotation rate"
    ),
    "readout_direction": Case("bottom_to_top", "the strongest trend over the rows: every row has the wrong time"),
    "timestamp_reference": Case(
        "exposure_end", "like a time offset, but proportional to the exposure", (("exposure_ms", (4.0, 12.0)),)
    ),
    "exposure_time": Case(
        "1.5",
        "blur longer than predicted; points move as with a time offset of half the extra exposure, hence the rival",
    ),
    "gyro_bias": Case("0.03,-0.02,0.025", "a constant shift from frame to frame, whatever the motion"),
    "gyro_scale": Case("1.03", "residuals proportional to the rotation rate; roll separates it from the focal length"),
    "gyro_lowpass": Case("12", "like a time offset, but fast rotations are too small: the gyroscope's low-pass filter"),
    "gyro_averaging": Case("0.012", "fast rotations are too small, slow ones are right, and none is late"),
    "gyro_axes": Case(
        "1.02,1.01,0.97,0.015,-0.01,0.02",
        "residuals proportional to the rotation rate, of another size and direction about each axis",
    ),
    "imu_rotation": Case("0.02,-0.015,0.03", "residuals across the direction of motion"),
    "focal_length": Case("1.03", "residuals proportional to the rotation rate in pitch and yaw, not in roll"),
    "pixel_aspect": Case("1.02", "residuals that grow with the rotation rate in pitch, not in yaw or roll"),
    "focal_drift": Case("0.02", "residuals that grow over time: the lens refocuses"),
    "radial_distortion": Case("-0.06", "residuals that grow with the distance from the picture's centre"),
    "higher_distortion": Case("0.08", "residuals near the corners only, where k1 cannot bend the picture enough"),
    "principal_point": Case("12,-9", "residuals under roll about the optical axis"),
    "stabilisation": Case("0.6,1.5", "the picture follows less of the fast motion than the gyroscope measures"),
    "scene_depth": Case("1.5", "residuals that follow the camera's travel, not its rotation", (("sway_m", 0.12),)),
    "frame_lag": Case(
        "0.2,20",
        "large residuals in the first frames only, while the recorder starts (the rms caps them, so it stays small)",
    ),
    "response_curve": Case(
        "1.3", "brightness that disagrees in the mid-tones when exposure changes", (("auto_exposure_ev", 3.0),)
    ),
    "black_level": Case("0.04", "brightness that disagrees in the shadows", (("auto_exposure_ev", 3.0),)),
    "vignetting": Case("0.3", "points that darken towards the corners"),
    "flicker": Case(
        "0.15,100", "bright and dark bands across the rows, moving from frame to frame", (("exposure_ms", 3.0),)
    ),
    "gain_drift": Case("0.03", "frames that are brighter or darker than exposure × ISO predicts"),
    "sharpening": Case("0.9,1.2", "overshoot beside edges: the phone sharpens; blur paths stay as predicted"),
    "defocus": Case(
        "2.5",
        "blur that is as strong along the motion as across it",
        (("scene", "board"), ("exposure_ms", 4.0), ("rate_rad_s", 0.5)),
    ),
}


def write_gallery(docs: Path, names: Sequence[str]) -> None:
    """Simulate, diagnose and draw the chosen effects; the page lists every effect drawn now or before."""
    images = docs / "images" / "gallery"
    images.mkdir(parents=True, exist_ok=True)
    kept = images / "results.json"
    results: dict[str, Any] = json.loads(kept.read_text("utf-8")) if kept.is_file() else {}
    with tempfile.TemporaryDirectory() as work:
        for name in names:
            results[name] = _draw_case(name, Path(work) / name, images)
            write_whole(kept, (json.dumps(results, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode())
            emit(f"gallery: {name}: {results[name]['verdict']}")
    write_whole(docs / "gallery.md", gallery_page(results).encode())


def gallery_page(results: dict[str, Any]) -> str:
    """The page of the effects that were drawn; results: by name, as images/gallery/results.json keeps them."""
    return HEAD + "\n".join(_section(name, results[name]) for name in CASES if name in results)


HEAD = f"""<!-- Written by `make figures`; edit virest/app/gallery.py instead. -->
# Gallery: what each effect looks like

Each capture below has one effect hidden in it by `virest simulate --effect`; `virest diagnose` reads the capture alone.
Captures have {FRAMES} frames of {WIDTH}×{HEIGHT} (seed {SEED}).

- **Curves** show residuals, medians and the central 68 %: grey with the profile as given, blue after the named causes
  are built in. The legend gives the rms over all frames, the text that over held-out frames. As in all output of
  `diagnose`, residuals above {CAP:g} times the typical one are capped, so that lost tracks do not dominate.
- **Bars** show the error that each candidate leaves on the rung where the cause entered; the red line is the error
  before that rung. For brightness these are errors of the fit, so they differ from the held-out errors in the text.

"""


def _draw_case(name: str, folder: Path, images: Path) -> dict[str, Any]:
    """Diagnose a capture with this effect hidden in it; its figure is written on the way."""
    case = CASES[name]
    options = {"exposure_ms": 9.0, "readout_ms": 22.0, "rate_rad_s": 1.2, "seed": SEED, **dict(case.options)}
    simulate_command(folder, width=WIDTH, height=HEIGHT, frames=FRAMES, effects=[f"{name}={case.value}"], **options)
    source = open_source(folder)
    found = diagnose_capture(source.capture, source.profile, source.pictures, source.gray)
    files, _ = draw_figures(source.capture, found)
    wanted = "residuals" if EFFECTS[name].seen_in == GEOMETRY else f"_{name}"
    figure = next((data for path, data in files.items() if path.endswith(f"{wanted}.png")), None)
    if figure is not None:
        write_whole(images / f"{name}.png", compact(figure))
    causes = [
        {
            "name": cause.name,
            "sentence": cause.sentence,
            "quantity": cause.held_out.quantity,
            "before": cause.held_out.before,
            "after": cause.held_out.after,
            "rivals": [rival.name for rival in cause.rivals],
        }
        for cause in found.causes
    ]
    return {"verdict": found.verdict, "causes": causes, "figure": figure is not None}


def _section(name: str, found: dict[str, Any]) -> str:
    case = CASES[name]
    evidence = EVIDENCE[EFFECTS[name].seen_in]
    lines = [f"## {name}", "", f"Hidden: `--effect {name}={case.value}`. Shows in {evidence}:"]
    lines += [f"{case.look_for}.", "", f"Verdict: **{found['verdict']}**", ""]
    for cause in found["causes"]:
        rivals = f"; rivals: {', '.join(cause['rivals'])}" if cause["rivals"] else ""
        size = f"held-out `{cause['quantity']}` {cause['before']:.3g} → {cause['after']:.3g}{rivals}"
        lines.append(f"- `{cause['name']}`: {cause['sentence']} ({size})")
    if found["figure"]:
        lines += ["", f"![{name}: what diagnose found](images/gallery/{name}.png)"]
    return "\n".join([*lines, ""])


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m virest.app.gallery DOCS [NAME...]``."""
    parser = argparse.ArgumentParser(prog="python -m virest.app.gallery", description=__doc__)
    parser.add_argument("docs", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME", help="effects to draw anew [all]")
    options = parser.parse_args(arguments)
    write_gallery(options.docs, options.names or list(CASES))


if __name__ == "__main__":
    main()
