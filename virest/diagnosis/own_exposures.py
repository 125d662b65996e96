"""Exposure times other than the logged ones: those of other rows of the table, or ones that change as brightness does.

A timestamp marks an instant of the exposure, so a frame whose exposure time is logged wrongly is seen earlier or later
than its stamp says: a delay of each frame, with no number of its own.  The capture is then diagnosed again with the
frames' own exposures, and the better account is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.camera.shutter import STAMP_FRACTION
from virest.capture.records import Capture, Frame
from virest.diagnosis.candidates import varies
from virest.diagnosis.cross_validation import JUDGE_POINTS, LAGGING_BLOCK
from virest.diagnosis.field.forms import TIME
from virest.diagnosis.field.screening import RIVAL_GAIN_FRACTION
from virest.diagnosis.findings import (
    EXPLAINED,
    GEOMETRY,
    UNEXPLAINED,
    Diagnosis,
    FieldFinding,
    HeldOutGain,
)
from virest.diagnosis.geometric_evidence import Evidence, Model
from virest.diagnosis.geometric_verdict import GeometricVerdict
from virest.diagnosis.photometry_effects import GainDrift
from virest.diagnosis.photometry_fit import fit_photometry
from virest.diagnosis.picture_ladder import PictureVerdict
from virest.diagnosis.restoration_gain import Reader, decodable
from virest.diagnosis.selection import WORD_LEVELS
from virest.image_formation.point_model import TrackTable
from virest.image_formation.row_clock import RowClock
from virest.inference.chance import chance_of
from virest.inference.frame_exposures import (
    LEAST_GAIN_STD,
    ROWS_LATE,
    OwnExposures,
    by_brightness,
    unlogged_log_light,
)
from virest.inference.hold_out import group_means, loss
from virest.inference.profile_terms import TERMS
from virest.inference.track_fit import TrackFit
from virest.restoration.capture_estimation import plan_restoration
from virest.restoration.frame_time_plan import rows_apart
from virest.restoration.settings import PRESETS

TABLE = "exposure_rows"
"""Kind of the finding for an exposure table that is some rows off; ``extensions.exposures_late_frames`` holds it."""
UNLOGGED = "exposure_gain"
"""Kind of the finding for exposure times that change unlogged; ``extensions.exposure_gain`` holds them."""
LEAST_FRAMES = 3
"""Least frames whose delays are compared with exposures: an offset and a factor are fitted to them."""
FROM_ONE = 0.25
"""Largest difference from 1 of the factor by which gains follow another frame's exposure × ISO: half way to the factor
of an encoder that is late by half a frame (DELAY_FRAMES)."""
CLOCKS, SURE = ("time_offset", "clock_skew"), 3.0
"""Terms of the clocks, and the standard deviations from which the given ones are wrong."""
DELAYED_P = 0.01
"""p value of exposures of other rows from which the capture is diagnosed with them; what they leave decides."""


def rows_late(finding: FieldFinding, frames: Sequence[Frame], profile: CameraProfile) -> int:
    """Rows by which the exposure table is off if a delay of frames has the shape and size of that; else 0.

    frames: all of the movie, by index.  With the exposure of the frame that is N rows away, mid-exposures move by
    half of the difference if a timestamp marks the exposure's start.
    """
    if (finding.kind, finding.covariates) != ("delay", (TIME,)):
        return 0
    (late,), shutter, clock = finding.fields, profile.shutter, RowClock(profile)
    exposure_s = np.array([frame.exposure_s or np.nan for frame in frames])
    start_s = np.array([clock.start_on_camera_s(frame.time_s, frame.exposure_s or 0.0) for frame in frames])
    seen = (start_s >= late.knots[0][0]) & (start_s <= late.knots[0][-1])
    if seen.sum() < LEAST_FRAMES:  # a step has its two knots between two frames
        return 0
    found_s = late.at_time(start_s[seen])[:, 0]
    for rows in ROWS_LATE:
        moved = np.clip(np.arange(len(frames)) + rows, 0, len(frames) - 1)
        other_s = (0.5 - STAMP_FRACTION[shutter.timestamp]) * shutter.true_exposure_s(exposure_s[moved] - exposure_s)
        expected_s = other_s[seen] - np.mean(other_s[seen])
        if not np.isfinite(expected_s).all() or not np.any(expected_s):
            continue
        factor = float(expected_s @ found_s / (expected_s @ expected_s))
        left_s = found_s - np.mean(found_s) - factor * expected_s
        if np.var(left_s) < (1 - RIVAL_GAIN_FRACTION) * np.var(found_s) and abs(factor - 1) < FROM_ONE:
            return rows
    return 0


def with_late_exposures(finding: FieldFinding, rows: int) -> FieldFinding:
    """A delay of frames with the exposure table, ``rows`` off, as rival; 0: it is none."""
    if not rows:
        return finding
    rival = f"exposure times logged {rows_apart(rows)}"
    sentence = f"{finding.sentence}; {rival} would explain it"
    return replace(finding, confounded=(*finding.confounded, rival), sentence=sentence)


def exposures_of_points(
    geometric: GeometricVerdict, frames: Sequence[Frame], measured: Array | None, delays: bool
) -> OwnExposures | None:
    """Exposures with which the points agree better than with the logged ones: of other rows, or as brightness changes.

    frames: all of the movie, by index.  measured: log light of the frames over the logged one, up to a constant, NaN if
    unknown; None: that of tracked frames.  delays: whether frames are late by times of their own, which rows of a table
    may explain.

    A frame whose exposure time changes unlogged is brighter or darker, and its points are seen earlier or later, by
    half of the change where stamps mark its start.  Points are compared with the model at the ladder's end, and with
    the given one, without and with its clocks, since a cause may have taken the delays' place.  Rows need less evidence
    here, since what they leave of the delays is judged again; an exposure is shorter than a frame.
    """
    evidence = geometric.evidence
    if evidence is None or not evidence.observed.exposure_known:
        return None
    tried: list[tuple[int, Array]] = []
    exposure_s = np.array([frame.exposure_s or np.nan for frame in frames])
    if delays and np.isfinite(exposure_s).all() and varies(exposure_s):
        moved = (np.clip(np.arange(len(frames)) + rows, 0, len(frames) - 1) for rows in ROWS_LATE)
        tried += [(rows, exposure_s[m] / exposure_s) for rows, m in zip(ROWS_LATE, moved, strict=True)]
    pairs, curve = evidence.observed.pairs, geometric.model.profile.curve
    if measured is None:
        gain = np.array(by_brightness(frames, pairs, curve).gain)
    else:
        gain = np.exp(np.nan_to_num(unlogged_log_light(frames, pairs, curve, measured)))
    if gain.std() > LEAST_GAIN_STD * gain.mean():
        tried.append((0, gain))
    models = geometric.nominal, _with_terms(geometric.nominal, *CLOCKS), geometric.model
    found = []
    for model in (_with_terms(model, "exposure_time") for model in models):
        logged = evidence.table(model, JUDGE_POINTS)
        as_logged = evidence.fit(model, model.terms, logged)
        for rows, gain in tried:
            scaled, p_value = _compared_exposures(evidence, model, logged, as_logged, gain / gain.mean())
            p_value *= len(tried) * len(models)
            if rows and p_value < DELAYED_P:
                found.append((p_value, OwnExposures(rows)))
            fits = evidence.exposure_s * max(scaled) < evidence.period_s
            if not rows and fits and WORD_LEVELS.significant(p_value):
                found.append((p_value, OwnExposures(gain=scaled, p_value=p_value)))
    return min(found, key=lambda one: one[0])[1] if found else None


def exposures_of_blur(capture: Capture, profile: CameraProfile, gray: Reader) -> OwnExposures | None:
    """Exposures that delay frames as found, if `process` finds that the length of their blur confirms them."""
    plan = plan_restoration(capture, profile, PRESETS["fast"], lambda numbers: decodable(gray, numbers))
    if plan.profile.extensions.exposure_gain == profile.extensions.exposure_gain:
        return None
    frames = range(len(capture.frames))
    own, given = (one.extensions.exposure_gain_of(frames) for one in (plan.profile, profile))
    return OwnExposures(gain=tuple((own / given).tolist()))


def _with_terms(model: Model, *names: str) -> Model:
    """A model that is fitted with further causes."""
    known = {term.name for term in model.terms}
    return replace(model, terms=(*model.terms, *(TERMS[name] for name in names if name not in known)))


def _compared_exposures(
    evidence: Evidence, model: Model, logged: TrackTable, as_logged: TrackFit, gain: Array
) -> tuple[tuple[float, ...], float]:
    """(factors proportional to ``gain`` that fit best, p value of a smaller loss with them).

    The loss is compared with that of the logged exposures in each two pairs: neighbours share a frame and its exposure.
    The exposures' scale is fitted in both.  A longer exposure resembles an offset, so clocks that are right as given
    are not fitted beside the scale.
    """
    own = replace(
        logged,
        first_exposure_s=logged.first_exposure_s * gain[logged.first],
        second_exposure_s=logged.second_exposure_s * gain[logged.second],
    )
    fitted = evidence.fit(model, model.terms, own)
    scale = min(as_logged.scale, fitted.scale)
    before, after = (
        group_means(loss(fit.distance, scale), logged.pair // LAGGING_BLOCK) for fit in (as_logged, fitted)
    )
    clocks = [name for name in CLOCKS if name in fitted.slices]
    if clocks and all(np.all(np.abs(fitted.value(name)) < SURE * fitted.std(name)) for name in clocks):
        fitted = evidence.fit(model, [term for term in model.terms if term.name not in clocks], own)
    longer = fitted.profile.shutter.exposure_scale / model.profile.shutter.exposure_scale
    return tuple((longer * gain).tolist()), chance_of(before - after)


def measured_log_light(light: PictureVerdict, movie_frames: int) -> Array | None:
    """Log light (frames,) of a movie's frames over the logged one, from its patches; NaN: not measured.

    It is fitted whether or not a gain was found: exposure × ISO that alternates while the light does not is no gain for
    certain, since an encoder that lags would show the same.  The curve is that of the patches alone, since blur gives a
    wrong one where exposures are wrong.  None: too few patches.
    """
    if light.observations is None or not light.observations.product_known:
        return None
    gains = GainDrift(tuple(light.observations.frames.tolist()), movie_frames)
    fitted = fit_photometry(light.observations, light.profile, [gains])
    seen, given = gains.seen_in(light.observations).frames, light.nominal or light.profile
    log_light = np.full(movie_frames, np.nan)
    log_light[list(seen)] = fitted.values - np.log(given.extensions.gain_of(seen))
    return log_light


def with_own_exposures_told(found: Diagnosis, given: Diagnosis, own: OwnExposures) -> Diagnosis:
    """One of two diagnoses: of the capture as logged, and with each frame's own exposure.

    A table that is off has no free number besides its rows, and exposures that follow the light have none.  They are
    the better account if they remove as much as a rival of a delay of each frame must.  With other rows, nothing may be
    left in the points that was not before; with exposures of their own, no delay of frames, and no gain of the light if
    they follow the brightness: those that the delays show were compensated by an ISO that the log lacks as well.
    """
    delay = delay_of_frames(found)
    nominal = found.nominal
    held_out = HeldOutGain(GEOMETRY, nominal.geometry_rms_px, _points_left_px(found), nominal.geometry_noise_px)
    held_out = held_out if delay is None else delay.held_out
    gain = replace(held_out, after=_points_left_px(given), noise=given.nominal.geometry_noise_px)
    if (gain.gain or 0.0) < RIVAL_GAIN_FRACTION * (held_out.gain or 0.0):
        return found
    of_brightness = own.p_value is not None
    drifts = of_brightness and any(cause.name == "gain_drift" for cause in given.causes)
    remains = drifts or delay_of_frames(given) is not None
    if remains if own.gain else given.unexplained.significant and not found.unexplained.significant:
        return found
    if own.gain:
        own, given = _with_one_scale(own, given)
    points = f"(points {gain.before:.3f} px → {gain.after:.3f} px): with its own, each frame is where the points are"
    if own.gain:
        size = max(own.gain, key=lambda g: abs(g - 1)) - 1
        p_value = own.p_value if delay is None or of_brightness else delay.p_value
        told = FieldFinding(
            ("exposure",), UNLOGGED, f"as the {'brightness' if of_brightness else 'delays of frames'}",
            f"exposure times change as {'the brightness does' if of_brightness else 'frames are late'}, up to "
            f"{abs(size):.0%} {'longer' if size > 0 else 'shorter'} than logged {points}",
            size, "1", None, gain, p_value, (), None,
            "a sensor that alternates exposures (HDR), or a log of the exposures that were asked for",
            "film an LED display that counts milliseconds, and compare the counts in a frame with its exposure time",
        )  # fmt: skip
    else:
        apart = rows_apart(own.rows_late)
        told = FieldFinding(
            ("exposure",), TABLE, apart, f"exposure times and ISO values are logged {apart} {points}",
            float(own.rows_late), "frames", None, gain, None if delay is None else delay.p_value, (), None,
            "a recorder that joins two queues, or an encoder that drops its first frames",
            "film a lamp that is switched on, and compare the row of the jump with the frame of the jump",
        )  # fmt: skip
    verdict = UNEXPLAINED if given.unexplained.significant else EXPLAINED
    return replace(
        given,
        verdict=verdict,
        nominal=found.nominal,
        nominal_profile=found.nominal_profile,
        fields=(told, *given.fields),
        residuals={**given.residuals, "before": found.residuals["before"]},
    )


def delay_of_frames(found: Diagnosis) -> FieldFinding | None:
    """The delays of frames that a diagnosis found."""
    over_time = (field for field in found.fields if (field.kind, field.covariates) == ("delay", (TIME,)))
    return next(over_time, None)


def _with_one_scale(own: OwnExposures, given: Diagnosis) -> tuple[OwnExposures, Diagnosis]:
    """The exposures, and the diagnosis with them, where a common factor that it found is in theirs.

    Brightness determines them up to a factor, so a further scale of all exposures is no cause of its own.
    """
    nominal, extended = given.nominal_profile, given.extended_profile
    longer = extended.shutter.exposure_scale / nominal.shutter.exposure_scale
    causes = tuple(cause for cause in given.causes if cause.name != "exposure_time")
    if len(causes) == len(given.causes):
        return own, given
    gains = (tuple((longer * np.array(gain)).tolist()) for gain in (own.gain, extended.extensions.exposure_gain))
    own_gain, whole_gain = gains
    extended = extended.with_shutter(exposure_scale=nominal.shutter.exposure_scale)
    extended = extended.with_extensions(exposure_gain=whole_gain)
    return replace(own, gain=own_gain), replace(given, causes=causes, extended_profile=extended)


def _points_left_px(found: Diagnosis) -> float:
    """Held-out rms of the points with all that a diagnosis adds."""
    fields = [field.held_out.after for field in found.fields if field.held_out.quantity == GEOMETRY]
    rungs = [rung.tried.get(rung.entered or "", rung.before) for rung in found.ladder if rung.quantity == GEOMETRY]
    return min(fields) if fields else [found.nominal.geometry_rms_px, *rungs][-1]
