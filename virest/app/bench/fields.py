"""Accuracy of diagnose on effects outside the catalogue, and benefit of its result on frames and on another capture.

The diagnosis reads only the capture folder.  The seed of a case determines sign and size (weak, strong) of the effect.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.workload import Scale, run_process
from virest.app.console import CONSOLE, cell, numeric_table
from virest.app.diagnose import Source, open_source
from virest.app.evaluation_captures import truth_frame
from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import write_profile
from virest.camera.response import ResponseCurve
from virest.diagnosis.findings import CONSISTENT, Diagnosis
from virest.diagnosis.geometric_evidence import make_evidence
from virest.diagnosis.geometric_ladder import climb
from virest.diagnosis.ladder import diagnose_capture
from virest.evaluation.fidelity import psnr_db
from virest.inference.observed_tracks import observe_tracks
from virest.inference.tracking import track_pairs
from virest.restoration.capture import at_true_times
from virest.simulation.effects import EffectContext, hide_effects
from virest.simulation.hidden import NOTHING, Hidden
from virest.simulation.recording import RecordingOptions, write_recording
from virest.simulation.session import SessionSettings, nominal_camera, plan_session

Row = dict[str, Any]
Draw = Callable[[np.random.Generator, float], "UnknownEffect"]
SIZE, SMALL, FPS = (640, 480), (480, 360), 30.0
"""Frame with an unknown effect, the smaller frame of captures without one, and frame rate."""
FRAMES, FRAMES_OF_OTHER = 96, 50
"""3.2 s to diagnose, and 1.7 s of another capture in which the found field is tested."""
FIRST_SEED, FIRST_NULL = 7100, 8100
"""First seeds of captures with and without an unknown effect."""
SEEDS = {"quick": 1, "usual": 2, "full": 6}
NULLS = {"quick": 4, "usual": 16, "full": 50}
"""Captures per effect, and captures without one: their number bounds the rate of false alarms that can be seen."""
SCENES = ("leaves", "text", "board", "bright", "photographs")
SOLVED = 0.8
"""Minimum fraction of the excess residual (squared) that a correct field removes in another capture."""
PRESET, RESTORED_FRAMES, HARM_DB = "balanced", "8:96:16", 0.1
"""Preset and frames of the restorations with and without the result, and the change in dB that counts."""


@dataclass(frozen=True, slots=True)
class UnknownEffect:
    """A phone's effect outside the catalogue, and the expected diagnosis."""

    hidden: Hidden = NOTHING
    tangential: tuple[float, float] = (0.0, 0.0)
    """Tangential distortion p1, p2."""
    effects: tuple[str, ...] = ()
    """Catalogue effects, with or without values."""
    expected: tuple[frozenset[tuple[str, str]], ...] = ()
    """Per field: acceptable pairs of kind and covariates."""
    lasting: bool = True
    """Whether other captures of the phone share the effect."""
    exposures_s: tuple[float, ...] = ()
    """Exposures of successive frames; empty: one for all."""
    nameless: bool = False
    """Whether neither a cause nor a field describes it, so that only an unnamed result is right."""


def _either(*pairs: tuple[str, str]) -> frozenset[tuple[str, str]]:
    return frozenset(pairs)


# ── hidden effects ───────────────────────────────────────────────────────────────────────────────────────────────


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice((-1.0, 1.0)))


def _uneven(rng: np.random.Generator, size: float) -> UnknownEffect:
    """Row delays: a parabola, a wave, or two blocks with a pause between them."""
    late_s, kind = _sign(rng) * size * 1.1e-3 * rng.uniform(0.8, 1.25), int(rng.integers(3))
    pause = float(rng.uniform(0.3, 0.7))

    def delay_s(fraction: Array) -> Array:
        wave = np.sin(2 * np.pi * fraction)
        block = np.clip((fraction - pause) / 0.04, 0, 1) - fraction
        return np.asarray(late_s * (4 * fraction * (1 - fraction), wave, 1.6 * block)[kind])

    return UnknownEffect(Hidden(row_delay_s=delay_s), expected=(_either(("delay", "row")),))


def _tangential(rng: np.random.Generator, size: float) -> UnknownEffect:
    turn = rng.uniform(0, 2 * np.pi)
    p = 0.006 * size * rng.uniform(0.8, 1.25)
    lens = (float(p * np.cos(turn)), float(p * np.sin(turn)))
    return UnknownEffect(tangential=lens, expected=(_either(("displacement", "x, y")),))


def _clipping(rng: np.random.Generator, size: float) -> UnknownEffect:
    part = float(np.clip(0.72 - 0.1 * size + rng.uniform(-0.04, 0.04), 0.3, 0.9))

    def clipped(_time: Array, reading: Array, _force: Array) -> Array:
        limit = part * np.abs(reading).max()
        return np.clip(reading, -limit, limit)

    return UnknownEffect(Hidden(gyro=clipped), expected=(_either(("inertial_rows", "rate")),), lasting=False)


def _gap(rng: np.random.Generator, size: float) -> UnknownEffect:
    from_s, lasting_s = rng.uniform(0.6, 1.9), rng.uniform(0.07, 0.1) * (1 + size)

    def filled(time_s: Array, reading: Array, _force: Array) -> Array:
        inside = np.flatnonzero((time_s >= from_s) & (time_s <= from_s + lasting_s))
        reading = reading.copy()
        reading[inside] = np.linspace(reading[inside[0]], reading[inside[-1]], len(inside))
        return reading

    return UnknownEffect(Hidden(gyro=filled), expected=(_either(("inertial_rows", "time")),), lasting=False)


def _breathing(rng: np.random.Generator, size: float) -> UnknownEffect:
    """The focus moves to a near object and back, and the focal length changes with it."""
    per_dioptre = _sign(rng) * 0.006 * size * rng.uniform(0.8, 1.25)
    far, near = rng.uniform(0.2, 0.8), rng.uniform(2.0, 3.5)
    there_s, back_s = rng.uniform(0.6, 1.1), rng.uniform(1.9, 2.5)

    def dioptres(time_s: Array) -> Array:
        rise = 1 / (1 + np.exp(-(time_s - there_s) / 0.12)) - 1 / (1 + np.exp(-(time_s - back_s) / 0.12))
        return np.asarray(far + (near - far) * rise)

    hidden = Hidden(focal_scale=lambda t: 1 + per_dioptre * (dioptres(t) - far), focus_dioptres=dioptres)
    return UnknownEffect(hidden, expected=(_either(("scale", "focus")),))


def _thermal(rng: np.random.Generator, size: float) -> UnknownEffect:
    part, settling_s = _sign(rng) * 0.010 * size * rng.uniform(0.8, 1.25), rng.uniform(0.4, 0.8)
    hidden = Hidden(focal_scale=lambda t: 1 + part * (1 - np.exp(-np.maximum(t, 0) / settling_s)))
    return UnknownEffect(hidden, expected=(_either(("scale", "time")),), lasting=False)


def _g_sensitivity(rng: np.random.Generator, size: float) -> UnknownEffect:
    per_force = 0.003 * size * rng.normal(size=(3, 3))
    hidden = Hidden(gyro=lambda _t, reading, force: reading + force @ per_force.T)
    return UnknownEffect(hidden, expected=(_either(("rate", "acceleration")),))


def _lens_switch(rng: np.random.Generator, size: float) -> UnknownEffect:
    part, at_s = _sign(rng) * 0.012 * size * rng.uniform(0.8, 1.25), rng.uniform(1.0, 2.2)
    hidden = Hidden(focal_scale=lambda t: np.where(np.asarray(t) < at_s, 1.0, 1 + part))
    return UnknownEffect(hidden, expected=(_either(("scale", "time")),), lasting=False)


def _wandering(rng: np.random.Generator, size: float) -> UnknownEffect:
    """Timestamps of a clock that drifts back and forth."""
    late_s, hz, phase = 1.5e-3 * size * rng.uniform(0.8, 1.25), rng.uniform(0.35, 0.7), rng.uniform(0, 2 * np.pi)
    hidden = Hidden(clock_s=lambda stamp_s: late_s * np.sin(2 * np.pi * hz * stamp_s + phase))
    return UnknownEffect(hidden, expected=(_either(("delay", "time")),), lasting=False)


def _shading(rng: np.random.Generator, size: float) -> UnknownEffect:
    """An off-centre vignette, or an object in front of one side of the lens."""
    part, turn, kind = 0.05 * size * rng.uniform(0.8, 1.25), rng.uniform(0, 2 * np.pi), int(rng.integers(2))
    way = np.cos(turn), np.sin(turn)

    def light(x: Array, y: Array) -> Array:
        along = 2 * ((x - 0.5) * way[0] + (y - 0.5) * way[1])
        return np.asarray(1 - part * (along + 1) / 2 if kind else 1 - 1.5 * part * np.clip(along, 0, None) ** 2)

    return UnknownEffect(Hidden(light=light), expected=(_either(("gain", "x, y")),), lasting=False)


def _passing(rng: np.random.Generator, size: float) -> UnknownEffect:
    """A soft shadow on one side for a while, or a moving shadow band; no field describes it."""
    part, turn, kind = 0.1 * size * rng.uniform(0.8, 1.25), rng.uniform(0, 2 * np.pi), int(rng.integers(2))
    way, at_s, lasting_s = (np.cos(turn), np.sin(turn)), rng.uniform(1.0, 2.0), rng.uniform(0.5, 0.9)

    def shadow(stamp_s: float, x: Array, y: Array) -> Array:
        along, since = 2 * ((x - 0.5) * way[0] + (y - 0.5) * way[1]), (stamp_s - at_s) / lasting_s
        side = np.exp(-(since**2)) / (1 + np.exp(-along / 0.15))
        return np.asarray(1 - part * (np.exp(-(((along - since) / 0.4) ** 2)) if kind else side))

    return UnknownEffect(Hidden(shadow=shadow), nameless=True, lasting=False)


def _hunting(rng: np.random.Generator, size: float) -> UnknownEffect:
    """A hunting autofocus without a log of the focus distance."""
    part, hz, phase = 0.003 * size * rng.uniform(0.8, 1.25), rng.uniform(1.0, 1.8), rng.uniform(0, 2 * np.pi)
    hidden = Hidden(focal_scale=lambda t: 1 + part * np.sin(2 * np.pi * hz * np.asarray(t) + phase))
    return UnknownEffect(hidden, expected=(_either(("scale", "time")),), lasting=False)


def _sticking(rng: np.random.Generator, size: float) -> UnknownEffect:
    """Dead zone of the gyroscope: rates below a threshold read 0, larger ones are reduced by it."""
    threshold = 0.008 * size * rng.uniform(0.8, 1.25)

    def stuck(_time: Array, reading: Array, _force: Array) -> Array:
        return np.asarray(np.sign(reading) * np.maximum(np.abs(reading) - threshold, 0.0))

    return UnknownEffect(Hidden(gyro=stuck), expected=(_either(("rate", "rate")),))


def _changing_readout(rng: np.random.Generator, size: float) -> UnknownEffect:
    """A readout time that changes during the capture."""
    longer_s, at_s = _sign(rng) * 1.2e-3 * size * rng.uniform(0.8, 1.25), rng.uniform(0.9, 2.0)
    hidden = Hidden(row_delay_at=lambda t, fraction: longer_s * fraction / (1 + np.exp(-(t - at_s) / 0.1)))
    return UnknownEffect(hidden, expected=(_either(("delay", "row, time")),), lasting=False)


def _exposed_readout(rng: np.random.Generator, size: float) -> UnknownEffect:
    """A readout that takes longer at long exposures: in proportion to them, or above 8 ms."""
    part, kind = _sign(rng) * 0.1 * size * rng.uniform(0.8, 1.25), int(rng.integers(2))

    def delay_s(exposure_s: float, fraction: Array) -> Array:
        return part * fraction * (exposure_s if kind else 0.01 / (1 + np.exp(-(exposure_s - 0.008) / 0.0005)))

    hidden = Hidden(row_delay_exposed=delay_s)
    exposures_s = tuple(float(e) for e in np.geomspace(0.004, 0.014, 23)[np.arange(23) * 7 % 23])
    return UnknownEffect(hidden, expected=(_either(("delay", "row, exposure")),), exposures_s=exposures_s)


def _late_exposures(rng: np.random.Generator, size: float) -> UnknownEffect:
    """Exposures that change smoothly, logged one or two frames late or early."""
    hidden = Hidden(exposures_late_frames=int(_sign(rng)) * (2 if size > 1 else 1))
    period, phase = rng.uniform(9, 15), rng.uniform(0, 2 * np.pi)
    exposures_s = 0.01 * (1 + 0.5 * np.sin(2 * np.pi * np.arange(FRAMES) / period + phase))
    expected = (_either(("exposure_rows", "exposure")),)
    return UnknownEffect(hidden, expected=expected, exposures_s=tuple(exposures_s.tolist()))


def _drifting_bias(rng: np.random.Generator, size: float) -> UnknownEffect:
    """A gyroscope whose bias drifts from the given one: evenly, or settling as it warms up."""
    way, settling_s, kind = rng.normal(size=3), rng.uniform(0.8, 1.6), int(rng.integers(2))
    change_rad_s = 0.012 * size * rng.uniform(0.8, 1.25) * way / np.linalg.norm(way)

    def drifted(time_s: Array, reading: Array, _force: Array) -> Array:
        part = time_s * FPS / FRAMES if kind else 1 - np.exp(-np.maximum(time_s, 0) / settling_s)
        return np.asarray(reading + part[:, None] * change_rad_s)

    return UnknownEffect(Hidden(gyro=drifted), expected=(_either(("rate", "time")),), lasting=False)


def _changing_distortion(rng: np.random.Generator, size: float) -> UnknownEffect:
    """Distortion that drifts and settles as the lens warms up."""
    part, settling_s = _sign(rng) * 0.008 * size * rng.uniform(0.8, 1.25), rng.uniform(0.4, 0.9)

    def scale(time_s: Array, radius_px: Array) -> Array:
        return 1 + part * (np.asarray(radius_px) / 400) ** 2 * (1 - np.exp(-np.maximum(time_s, 0) / settling_s))

    return UnknownEffect(Hidden(radial_scale=scale), expected=(_either(("scale", "radius, time")),), lasting=False)


def _soft_corners(rng: np.random.Generator, size: float) -> UnknownEffect:
    hidden = Hidden(corner_blur_px=float(1.2 * size * rng.uniform(0.8, 1.25)))
    return UnknownEffect(hidden, expected=(_either(("blur", "radius")),), lasting=False)


def _soft_moments(rng: np.random.Generator, size: float) -> UnknownEffect:
    """Loss of focus for about 0.5 s."""
    sigma_px, at_s, lasting_s = 1.0 * size * rng.uniform(0.8, 1.25), rng.uniform(0.8, 2.2), rng.uniform(0.2, 0.3)
    hidden = Hidden(blur_px=lambda t: float(sigma_px * np.exp(-(((t - at_s) / lasting_s) ** 2))))
    return UnknownEffect(hidden, expected=(_either(("blur", "time")),), lasting=False)


def _two(rng: np.random.Generator, size: float) -> UnknownEffect:
    uneven, lens = _uneven(rng, size), _tangential(rng, size)
    return replace(uneven, tangential=lens.tangential, expected=(*uneven.expected, *lens.expected))


def _one_named(rng: np.random.Generator, size: float) -> UnknownEffect:
    effects = (
        f"time_offset={_sign(rng) * rng.uniform(0.004, 0.009):.6f}",
        f"focal_length={1 + _sign(rng) * rng.uniform(0.03, 0.06):.4f}",
        f"radial_distortion={_sign(rng) * rng.uniform(0.03, 0.07):.4f}",
    )
    return replace(_uneven(rng, size), effects=(str(rng.choice(effects)),))


def _nothing(_rng: np.random.Generator, _size: float) -> UnknownEffect:
    return UnknownEffect()


def _named_only(rng: np.random.Generator, _size: float) -> UnknownEffect:
    names = ("time_offset", "readout_time", "gyro_bias", "focal_length", "focal_drift", "radial_distortion",
             "principal_point", "stabilisation", "vignetting", "defocus")  # fmt: skip
    return UnknownEffect(effects=tuple(str(name) for name in rng.choice(names, 2, replace=False)))


EFFECTS: dict[str, Draw] = {
    "uneven": _uneven,
    "tangential": _tangential,
    "clipping": _clipping,
    "gap": _gap,
    "breathing": _breathing,
    "thermal": _thermal,
    "g_sensitivity": _g_sensitivity,
    "lens_switch": _lens_switch,
    "wandering": _wandering,
    "shading": _shading,
    "hunting": _hunting,
    "sticking": _sticking,
    "changing_readout": _changing_readout,
    "changing_distortion": _changing_distortion,
    "soft_corners": _soft_corners,
    "soft_moments": _soft_moments,
    "two": _two,
    "one_named": _one_named,
    "passing": _passing,
    "exposed_readout": _exposed_readout,
    "drifting_bias": _drifting_bias,
    "late_exposures": _late_exposures,
}
NULL, NAMED_ONLY = "nothing", "named_only"
CASES = {**EFFECTS, NULL: _nothing, NAMED_ONLY: _named_only}


# ── captures ─────────────────────────────────────────────────────────────────────────────────────────────────────


def write_case(folder: Path, name: str, seed: int, *, other: bool = False) -> tuple[UnknownEffect, list[str]]:
    """Write a capture unless it exists: its unknown effect and the names of its catalogue effects.

    other: a second capture of the same phone, with another motion, scene and exposure.
    """
    unknown = CASES[name](np.random.default_rng([seed, 11]), 1.0 if seed % 2 else 2.6)
    rng = np.random.default_rng([seed, 12 + other])
    frames = FRAMES_OF_OTHER if other else FRAMES
    distortion = ("radtan", (-0.02, 0.0, 0.0, 0.0, 0.0)) if seed % 3 == 0 else ("none", ())
    size = SIZE if name in EFFECTS else SMALL
    acceleration = name == "g_sensitivity"
    nominal = nominal_camera(
        *size, focal_px=float(np.random.default_rng([seed, 14]).uniform(0.67, 0.97) * size[0]),
        readout_time_s=float(np.random.default_rng([seed, 15]).uniform(0.014, 0.026)),
        response=ResponseCurve("srgb"), distortion=distortion, depth_m=2.0 if acceleration else np.inf,
    )  # fmt: skip
    context = EffectContext(frames, FPS, np.random.default_rng([seed, 16]))
    true, applied = hide_effects(nominal, unknown.effects, context)
    scene, usual_s = str(rng.choice(SCENES)), float(rng.uniform(0.004, 0.012))
    settings = SessionSettings(
        scene=scene,
        frames=frames,
        fps=FPS,
        exposure_s=unknown.exposures_s or (usual_s,),
        rate_rad_s=float(rng.uniform(0.6, 1.5)),
        noise_levels=float(rng.uniform(1.0, 3.0)),
        gyro_noise_rad_s=float(rng.uniform(0.0008, 0.0025)),
        imu_rate_hz=float(rng.choice((100, 200, 400))),
        seed=10 * seed + other,
    )
    named = [effect.name for effect in applied]
    if not (folder / "movie.mp4").exists():
        session = plan_session(nominal, with_tangential(true, unknown.tangential), settings, hidden=unknown.hidden)
        bits_per_px = float(rng.uniform(0.12, 0.4))
        options = RecordingOptions(bits_per_px=bits_per_px, truth_frames=name in EFFECTS and not other)
        write_recording(session, folder, applied=applied, options=options)
    return unknown, named


def with_tangential(profile: CameraProfile, tangential: tuple[float, float]) -> CameraProfile:
    """Set the tangential distortion p1, p2 of the profile's lens."""
    lens = profile.intrinsics
    assert lens is not None
    if not any(tangential):
        return profile
    k1, k2, _, _, k3 = lens.coefficients or (0.0,) * 5
    return replace(profile, intrinsics=replace(lens, model="radtan", coefficients=(k1, k2, *tangential, k3)))


def residuals_px(source: Source, profiles: list[CameraProfile]) -> tuple[list[float], float]:
    """RMS residual of a capture's tracked points with each profile, and the tracking noise."""
    capture = source.capture
    indices = [frame.index for frame in capture.frames if frame.skip_reason is None]
    pairs = track_pairs(source.gray(indices))
    ends = []
    for profile in profiles:
        shown = replace(capture, frames=at_true_times(capture.frames, profile, capture.repeats))
        observed = observe_tracks(shown, pairs, source.profile).covered(capture.imu, source.profile)
        ends.append(climb(make_evidence(capture.imu, observed), profile, (), (), max_rungs=0))
    return [end.final_rms_px for end in ends], ends[-1].noise_px


def picture_gains_db(folder: Path, found: CameraProfile) -> list[float]:
    """PSNR gain of frames restored with the found profile over the capture's own."""
    write_profile(found, folder / "found.yaml")
    with_found = ("--config", str(folder / "found.yaml"))
    runs = [
        run_process(folder, folder / name, "--preset", PRESET, "--frames", RESTORED_FRAMES, *config)
        for name, config in (("nominal", ()), ("extended", with_found))
    ]
    gains = []
    for pair in zip(*(run.lines for run in runs), strict=True):
        both = [[line["valid_px"][k] for line in pair] for k in range(4)]
        valid_px = (max(both[0]), max(both[1]), min(both[2]), min(both[3]))
        truth = truth_frame(folder, pair[0]["frame"])
        before, after = (psnr_db(run.picture(line), truth, valid_px) for run, line in zip(runs, pair, strict=True))
        gains.append(after - before)
    return gains


# ── one case ─────────────────────────────────────────────────────────────────────────────────────────────────────


def judge_case(work: Path, name: str, seed: int) -> Row:
    """Simulate, diagnose and compare; apply the extended profile to another capture of the same phone."""
    folder = work / f"{name}_{seed}"
    unknown, named = write_case(folder, name, seed)
    source = open_source(folder)
    begun = time.process_time()
    found = diagnose_capture(source.capture, source.profile, source.pictures, source.gray)
    seconds = time.process_time() - begun
    gains_db = picture_gains_db(folder, found.extended_profile) if unknown.expected and found.fields else []
    removed = None
    if unknown.lasting and unknown.expected:
        folder = work / f"{name}_{seed}_other"
        write_case(folder, name, seed, other=True)
        (before, after), noise = residuals_px(open_source(folder), [source.profile, found.extended_profile])
        removed = 1 - (after**2 - noise**2) / max(before**2 - noise**2, 1e-9)
    causes = [cause.name for cause in found.causes]
    fields = [(field.kind, ", ".join(field.covariates), field.shape) for field in found.fields]
    return {
        "hidden": name, "seed": seed, "size": "weak" if seed % 2 else "strong", "verdict": found.verdict,
        "named": named, "causes": causes, "fields": fields,
        "right": is_right(unknown, named, found),
        "rms_px": found.nominal.geometry_rms_px, "noise_px": found.nominal.geometry_noise_px,
        "gain": [field.held_out.gain for field in found.fields],
        "gone_elsewhere": removed, "pictures_db": gains_db, "cpu_s": round(seconds, 1),
        "sentences": [field.sentence for field in found.fields],
    }  # fmt: skip


def is_right(unknown: UnknownEffect, named: list[str], found: Diagnosis) -> bool:
    """Whether the fields have the expected kinds and covariates, and each cause or a rival of it was hidden."""
    fields = [(field.kind, ", ".join(field.covariates)) for field in found.fields]
    if len(fields) != len(unknown.expected) or any(set(fields).isdisjoint(pairs) for pairs in unknown.expected):
        return False
    known = [{cause.name, *(rival.name for rival in cause.rivals)} for cause in found.causes]
    if unknown.nameless:
        return not known
    if not named and not fields:
        return found.verdict == CONSISTENT
    return all(names & set(named) for names in known) and len(known) <= len(named)


def fields_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Judge each unknown effect with several seeds, captures with only named effects, and captures without effects."""
    cases = [(name, FIRST_SEED + 10 * k + i) for k in range(SEEDS[scale.name]) for i, name in enumerate(EFFECTS)]
    cases += [(NAMED_ONLY, FIRST_SEED + 500 + k) for k in range(SEEDS[scale.name])]
    cases += [(NULL, FIRST_NULL + k) for k in range(NULLS[scale.name])]
    rows = []
    for case in cases:
        rows.append(judge_case(work, *case))
        CONSOLE.line("  ".join(filter(None, shown(rows[-1]))))
    summary = summarise(rows)
    header = ["hidden", "seed", "size", "verdict", "causes", "fields", "gain", "elsewhere", "frames dB",
              "rms / noise px", "CPU s"]  # fmt: skip
    text = numeric_table(header, [shown(row) for row in rows])
    text += (
        f"\n{summary['right']} of {summary['captures']} right; {summary['solved_elsewhere']} of "
        f"{summary['of_elsewhere']} solved on another capture; frames better in {summary['pictures_better']} of "
        f"{summary['of_pictures']}, a frame worse in {summary['pictures_worse']}; {summary['false_alarms']} false "
        f"alarms in {summary['nulls']} captures without an unknown effect"
    )
    return {"summary": summary, "rows": rows}, f"Effects that no catalogue names, {FRAMES} frames\n{text}"


def summarise(rows: Sequence[Row]) -> dict[str, int]:
    """Counts over all cases."""
    hidden = [row for row in rows if row["hidden"] in EFFECTS]
    elsewhere = [row["gone_elsewhere"] for row in hidden if row["gone_elsewhere"] is not None]
    return {
        "captures": len(hidden),
        "right": sum(bool(row["right"]) for row in hidden),
        "solved_elsewhere": sum(bool(fraction >= SOLVED) for fraction in elsewhere),
        "of_elsewhere": len(elsewhere),
        "pictures_better": sum(bool(np.mean(row["pictures_db"]) > HARM_DB) for row in rows if row["pictures_db"]),
        "pictures_worse": sum(bool(min(row["pictures_db"]) < -HARM_DB) for row in rows if row["pictures_db"]),
        "of_pictures": sum(bool(row["pictures_db"]) for row in rows),
        "false_alarms": sum(bool(row["fields"]) for row in rows if row["hidden"] not in EFFECTS),
        "nulls": len(rows) - len(hidden),
    }


def shown(row: Row) -> list[str]:
    """A row of the table."""
    fields = "; ".join(f"{kind} over {over}: {shape}" for kind, over, shape in row["fields"])
    gains = " ".join(cell(gain) for gain in row["gain"])
    elsewhere = "" if row["gone_elsewhere"] is None else f"{row['gone_elsewhere']:.2f}"
    db = row["pictures_db"]
    pictures = f"{np.mean(db):+.2f} ({min(db):+.2f})" if db else ""
    return [
        row["hidden"] + ("" if row["right"] else " WRONG"), str(row["seed"]), row["size"], row["verdict"],
        ", ".join(row["causes"]), fields, gains, elsewhere, pictures,
        f"{row['rms_px']:.3f} / {row['noise_px']:.3f}", f"{row['cpu_s']:.0f}",
    ]  # fmt: skip
