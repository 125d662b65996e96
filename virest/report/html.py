"""The report: the results of one or several runs and diagnoses as one self-contained HTML page.

Pictures are embedded, and plots are inline SVG.  The content security policy allows only the page's own style and
script, by their hashes, and embedded pictures.  The template engine escapes all text; unprintable characters (control
characters, marks of writing direction) are shown by their code.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup

from virest.arrays import Picture
from virest.capture.join import consecutive_runs
from virest.report.charts import ArrowField, Chart, Stretch, arrow_field, band, time_chart
from virest.report.words import (
    Mapped,
    Verdict,
    camera_values,
    cause_view,
    diagnosis_verdict,
    figure_words,
    gain_words,
    number,
    remaining_words,
)

TEMPLATES = "templates"
RENDITIONS = ((1280, 88), (1280, 78), (1024, 76), (800, 74), (640, 72), (480, 70), (360, 64), (240, 60), (160, 50))
"""Longest side in pixels and WebP quality: the first that fits the byte limit is used."""
FIGURE_SIDE_PX, FIGURE_QUALITY = 1700, 82
"""Largest side and WebP quality: labels stay sharp on screens of twice the density."""
FIRST_FIGURES = ("residuals", "pictures")
"""Figures of a diagnosis that are shown at once; the others are collapsed."""
STATES = ("restored", "copied", "skipped", "failed")
STATE_WORDS = {
    "restored": "restored",
    "copied": "copied unchanged",
    "skipped": "skipped",
    "failed": "failed",
    "straightened": "straightened, not deblurred",
    "remark": "restored, with a warning",
}
LEFT_ALONE = ("failed", "skipped", "copied", "straightened", "remark")
"""States listed in the table of reasons, in this order."""


# ── data of the page ─────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """The facts of one frame; None for unknown values."""

    frame: int
    timestamp_ns: int
    state: str
    """``restored``, ``copied``, ``skipped`` or ``failed``."""
    warnings: tuple[str, ...] = ()
    exposure_s: float | None = None
    blur_px: float | None = None
    """Blur at the frame's centre."""
    longest_blur_px: float | None = None
    """Longest blur over all tiles."""
    rate_rad_s: tuple[float, ...] | None = None
    shift_px: float | None = None
    """Largest displacement by the rolling shutter."""
    depth_m: float | None = None
    speed_m_s: float | None = None
    gain_db: float | None = None
    """Predicted gain of deblurring."""
    neighbours_gain_db: float | None = None
    """Additional gain from joint restoration with neighbours, predicted by the spectra."""
    noise_levels: float | None = None
    deblurred: bool = False
    straightened: bool = False
    valid_px: tuple[int, int, int, int] | None = None
    """x0, y0, x1, y1 of the recorded data in the restored frame; outside, the edge is replicated."""

    @property
    def done(self) -> str:
        """The frame's result, in words."""
        steps = [name for name, was in (("deblurred", self.deblurred), ("straightened", self.straightened)) if was]
        return " and ".join(steps) if self.state == "restored" and steps else STATE_WORDS[self.state]


@dataclass(frozen=True, slots=True)
class Embedded:
    """An embedded picture."""

    uri: str
    """A data URI."""
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class ShownFrame:
    """A frame that the page shows."""

    facts: FrameFacts
    before: Embedded | None
    after: Embedded | None
    arrows: ArrowField
    width: int
    """Frame size of the movie in px; the arrows' unit."""
    height: int

    @property
    def repeats_edge(self) -> bool:
        """Whether part of the restored frame replicates the edge."""
        return self.facts.valid_px is not None and tuple(self.facts.valid_px) != (0, 0, self.width, self.height)


@dataclass(frozen=True, slots=True)
class RunRecord:
    """One run of ``process``."""

    account: Mapped
    """The content of run.json."""
    frames: Sequence[FrameFacts]
    shown: Sequence[ShownFrame]
    notes: tuple[str, ...] = ()
    """Notes on what the page could not show, and why."""


@dataclass(frozen=True, slots=True)
class DiagnosisRecord:
    """One diagnosis."""

    facts: Mapped
    """The content of diagnosis.json."""
    figures: Sequence[tuple[str, Embedded]] = ()
    """Name without suffix, and the picture."""
    profile: str = ""
    """The text of extended.yaml."""


@dataclass(frozen=True, slots=True)
class CaptureRecord:
    """The results of one capture."""

    name: str
    run: RunRecord | None = None
    diagnosis: DiagnosisRecord | None = None


# ── pictures ─────────────────────────────────────────────────────────────────────────────────────────────────────


def embed_pictures(pictures: Sequence[Picture | None], max_bytes: int) -> list[Embedded | None]:
    """RGB pictures as WebP data URIs, all in the first rendition whose total size fits max_bytes."""
    for side_px, quality in RENDITIONS:
        coded = [None if picture is None else _webp(picture, side_px, quality) for picture in pictures]
        if sum(len(item.uri) for item in coded if item) <= max_bytes:
            break
    return coded


def embed_figure(picture: Picture) -> Embedded:
    """A figure as a WebP data URI, large enough for readable labels."""
    return _webp(picture, FIGURE_SIDE_PX, FIGURE_QUALITY)


def _webp(picture: Picture, side_px: int, quality: int) -> Embedded:
    height, width = picture.shape[:2]
    scale = min(1.0, side_px / max(height, width))
    if scale < 1.0:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, data = cv2.imencode(".webp", picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])
    text = base64.b64encode(data.tobytes()).decode("ascii")
    return Embedded(f"data:image/webp;base64,{text}", picture.shape[1], picture.shape[0])


def show_frame(
    facts: FrameFacts,
    before: Picture | None,
    after: Picture | None,
    tiles: Sequence[tuple[float, float, float, float]],
    size: tuple[int, int],
    max_bytes: int,
) -> ShownFrame:
    """Prepare a frame for the page.

    tiles: (x, y, angle_rad, length_px) each.  size: (width, height) of the movie.  max_bytes: of both pictures.
    """
    coded = embed_pictures([before, after], max_bytes)
    columns = np.array(tiles, float).reshape(-1, 4)
    arrows = arrow_field(columns[:, :2], columns[:, 2], columns[:, 3], *size)
    return ShownFrame(facts, coded[0], coded[1], arrows, *size)


def choose_frames(frames: Sequence[FrameFacts], count: int) -> list[FrameFacts]:
    """Frames to show: the frame with the longest blur in each of ``count`` equal parts of the run.

    Restored frames; if there are none, copied ones, then skipped or failed ones.
    """
    for states in (("restored",), ("copied",), ("skipped", "failed")):
        there = [facts for facts in frames if facts.state in states]
        if there:
            parts = np.array_split(np.arange(len(there)), min(count, len(there)))
            return [max((there[k] for k in part), key=lambda f: f.longest_blur_px or 0.0) for part in parts]
    return []


# ── the page ─────────────────────────────────────────────────────────────────────────────────────────────────────


def report_page(captures: Sequence[CaptureRecord], version: str) -> str:
    """The whole page."""
    environment = _environment()
    style, script = (_source(name) for name in ("page.css", "page.js"))
    return environment.get_template("page.html").render(
        captures=[_capture_view(record) for record in captures],
        style=Markup(style),
        script=Markup(script),
        policy=content_policy(style, script),
        version=version,
        state_words=STATE_WORDS,
    )


def content_policy(style: str, script: str) -> str:
    """A policy that allows only the page's own style and script, by hash, and embedded pictures."""
    own = {name: _sha256(text) for name, text in (("style", style), ("script", script))}
    return (
        f"default-src 'none'; img-src data:; style-src {own['style']}; script-src {own['script']}; "
        "base-uri 'none'; form-action 'none'"
    )


def _sha256(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


@cache
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("virest.report", TEMPLATES),
        autoescape=True,
        finalize=shown,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _source(name: str) -> str:
    """A file that is included in the page unchanged."""
    environment = _environment()
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0].strip()


def shown(value: Any) -> Any:
    """Text for display: tabs and line breaks as blanks, other unprintable characters by their code."""
    if value is None:
        return "–"
    if not isinstance(value, str) or isinstance(value, Markup) or value.isprintable():
        return value
    return "".join(c if c.isprintable() else " " if c in "\t\n\r" else f"\\u{ord(c):04x}" for c in value)


# ── one capture ──────────────────────────────────────────────────────────────────────────────────────────────────


def _capture_view(record: CaptureRecord) -> dict[str, Any]:
    return {
        "name": record.name,
        "run": None if record.run is None else _run_view(record.run),
        "diagnosis": None if record.diagnosis is None else _diagnosis_view(record.diagnosis),
    }


def _run_view(run: RunRecord) -> dict[str, Any]:
    counts = {state: int(run.account["counts"].get(state, 0)) for state in STATES}
    return {
        "verdict": run_verdict(counts, str(run.account["verdict"]), run.frames),
        "counts": counts,
        "share": _shares(counts),
        "warnings": [str(text) for text in run.account.get("warnings", ())],
        "notes": run.notes,
        "shown": run.shown,
        "charts": time_charts(run.frames, [frame.facts.frame for frame in run.shown]),
        "steady": steady_words(run.frames),
        "band": band([facts.state for facts in run.frames]),
        "left_alone": left_alone(run.frames),
        "values": camera_values(run.account.get("profile") or {}, str(run.account.get("profile_source", ""))),
        "account": run.account,
    }


def run_verdict(counts: Mapping[str, int], verdict: str, frames: Sequence[FrameFacts]) -> Verdict:
    """The run's result in words."""
    total, restored = sum(counts[state] for state in STATES), counts["restored"]
    deblurred = counts.get("deblurred", sum(facts.deblurred for facts in frames))
    rest = ", ".join(f"{counts[s]} {STATE_WORDS[s]}" for s in ("copied", "skipped", "failed") if counts[s])
    if not restored:
        level, headline = "poor", "No frame was restored"
    else:
        level = "good" if restored == total else "poor" if counts["failed"] else "fair"
        only = restored - deblurred
        parts = [f"{deblurred} of {total} {_frames(total)} deblurred"] if deblurred else []
        parts += [f"{only}{'' if deblurred else f' of {total} {_frames(total)}'} only straightened"] if only else []
        headline = ", ".join(parts)
    words = [f"{rest}." if rest else ""]
    words += [f"{verdict[:1].upper()}{verdict[1:]}." if verdict != "restored" and not restored else ""]
    return Verdict(level, headline, " ".join(filter(None, [*words, _motion_words(frames)])))


def _frames(count: int) -> str:
    return "frame" if count == 1 else "frames"


def count_words(counts: Mapping[str, int]) -> str:
    """Frame counts by result in one line: deblurred first, then only straightened."""
    deblurred = counts.get("deblurred", 0)
    parts = {"deblurred": deblurred, "only straightened": counts.get("restored", 0) - deblurred}
    parts |= {STATE_WORDS[state]: counts.get(state, 0) for state in STATES[1:]}
    return ", ".join(f"{count} {words}" for words, count in parts.items() if count)


def _motion_words(frames: Sequence[FrameFacts]) -> str:
    """Blur and rolling-shutter distortion of the recorded frames, in a sentence."""
    blur = [f.blur_px for f in frames if f.blur_px is not None]
    longest = [f.longest_blur_px for f in frames if f.longest_blur_px is not None]
    shift = [f.shift_px for f in frames if f.shift_px is not None]
    words = []
    if blur and longest:
        words.append(f"blurred by {np.median(blur):.1f} px at the centre (median), {max(longest):.1f} px at most")
    if shift and max(shift) > 0:
        words.append(f"distorted by the rolling shutter by up to {max(shift):.1f} px")
    return f"The recorded frames are {' and '.join(words)}." if words else ""


def _shares(counts: Mapping[str, int]) -> tuple[Stretch, ...]:
    """The counts as parts of a bar."""
    total, start, parts = max(sum(counts[state] for state in STATES), 1), 0, []
    for state in STATES:
        parts.append(Stretch(state, start / total, counts[state] / total))
        start += counts[state]
    return tuple(part for part in parts if part.width)


def steady_words(frames: Sequence[FrameFacts]) -> list[str]:
    """A sentence instead of a plot if all frames have the same exposure."""
    exposures = {facts.exposure_s for facts in frames}
    if len(exposures) != 1 or None in exposures:
        return []
    return [f"Every frame was exposed for {number(1e3 * exposures.pop())} ms."]  # type: ignore[operator]


def time_charts(frames: Sequence[FrameFacts], marked: Sequence[int]) -> list[Chart]:
    """Plots of the known parameters over the time since the first frame."""
    if not frames:
        return []
    stamps = np.array([f.timestamp_ns for f in frames], np.int64)
    time_s = (stamps - stamps[0]) / 1e9
    marks = [float(t) for t, facts in zip(time_s, frames, strict=True) if facts.frame in set(marked)]

    def column(read: Callable[[FrameFacts], float | None]) -> list[float | None]:
        return [read(facts) for facts in frames]

    def exposure_ms(f: FrameFacts) -> float | None:
        return None if f.exposure_s is None else 1e3 * f.exposure_s

    def axis(k: int) -> Callable[[FrameFacts], float | None]:
        return lambda f: None if f.rate_rad_s is None else f.rate_rad_s[k]

    def joint_gain_db(f: FrameFacts) -> float | None:
        return f.neighbours_gain_db if any(other.neighbours_gain_db for other in frames) else None

    wanted = [
        ("Blur", "px", [("longest", column(lambda f: f.longest_blur_px)), ("centre", column(lambda f: f.blur_px))]),
        ("Rotation of the camera", "rad/s", [(name, column(axis(k))) for k, name in enumerate("xyz")]),
        ("Rolling-shutter distortion", "px", [("largest shift", column(lambda f: f.shift_px))]),
        ("Exposure", "ms", [] if steady_words(frames) else [("", column(exposure_ms))]),
        ("Predicted gain of deblurring", "dB", [("", column(lambda f: f.gain_db))]),
        ("Predicted gain from neighbouring frames", "dB", [("", column(joint_gain_db))]),
        ("Noise", "grey levels", [("", column(lambda f: f.noise_levels))]),
        ("Scene depth", "m", [("", column(lambda f: f.depth_m))]),
        ("Speed of the camera", "m/s", [("", column(lambda f: f.speed_m_s))]),
    ]
    charts = (time_chart(title, unit, time_s, series, marks) for title, unit, series in wanted)
    return [chart for chart in charts if chart is not None]


# ── frames not fully restored ────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class Reason:
    """Frames with the same result for the same reason."""

    state: str
    text: str
    varies: bool
    """Whether the numbers in the text differ between frames; those of the first frame are shown."""
    count: int
    ranges: str
    """Frame indices, such as ``3–9, 12``."""


def left_alone(frames: Sequence[FrameFacts]) -> list[Reason]:
    """Frames not fully restored, and remarks on restored ones, grouped by result and reason.

    Reasons that differ only in numbers are merged.
    """
    groups: dict[tuple[str, str], list[tuple[int, str]]] = {}
    for facts in frames:
        state = facts.state if facts.state != "restored" else "remark" if facts.deblurred else "straightened"
        texts = facts.warnings if facts.warnings or state == "remark" else ("no reason is logged",)
        for text in dict.fromkeys(texts):
            groups.setdefault((state, re.sub(r"\d+(\.\d+)?", "#", text)), []).append((facts.frame, text))
    reasons = [
        Reason(state, found[0][1], len({text for _, text in found}) > 1, len(found), ranges([f for f, _ in found]))
        for (state, _), found in groups.items()
    ]
    return sorted(reasons, key=lambda reason: (LEFT_ALONE.index(reason.state), -reason.count))


def ranges(numbers: Sequence[int]) -> str:
    """Numbers as ranges: ``3–9, 12``."""
    return ", ".join(f"{first}" if first == last else f"{first}–{last}" for first, last in consecutive_runs(numbers))


def _is_first(name: str) -> bool:
    return name in FIRST_FIGURES or name.startswith("field_")


def _diagnosis_view(diagnosis: DiagnosisRecord) -> dict[str, Any]:
    facts = diagnosis.facts
    causes = facts.get("causes") or []
    return {
        "verdict": diagnosis_verdict(str(facts["verdict"]), causes, facts.get("nominal") or {}),
        "causes": [cause_view(cause) for cause in causes],
        "fields": facts.get("fields") or [],
        "remaining": remaining_words(facts.get("unexplained") or {}, str(facts["verdict"])),
        "gain": gain_words(facts.get("restoration_gain") or {}),
        "figures": [(figure_words(name), picture) for name, picture in diagnosis.figures if _is_first(name)],
        "rungs": [(figure_words(name), picture) for name, picture in diagnosis.figures if not _is_first(name)],
        "profile": diagnosis.profile.splitlines(),
    }
