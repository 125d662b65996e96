"""Figures of a diagnosis: PNG files that show their data."""

import cv2
import numpy as np
import pytest

from virest.report.figures import _draw_rung, canvas, comparison_figure, ladder_figure, residual_figure


def decoded(data):
    """The picture in a PNG file."""
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture[..., ::-1].astype(int)


def test_a_difference_is_red_where_the_measured_picture_is_brighter():
    """It is blue where the measured picture is darker; equal pictures have neither colour."""
    flat = np.full((60, 90, 3), 120, np.uint8)
    changed = flat.copy()
    changed[:, :30] = 60
    rows = [("same", flat, flat), ("changed", flat, changed)]
    drawn = decoded(comparison_figure(rows, "trip: $ frame 3"))
    red = (drawn[..., 0] > drawn[..., 2] + 60).sum()
    same = decoded(comparison_figure(rows[:1]))
    assert red > 1.3 * (same[..., 0] > same[..., 2] + 60).sum() + 500
    assert drawn.shape[0] > 1.5 * same.shape[0]


def test_residuals_are_drawn_before_and_after(rng):
    """More covariates make a wider figure; NaN values are skipped."""
    number = 400
    before = {name: rng.uniform(size=number) for name in ("row", "time", "radius", "rate", "pair")}
    before |= {"x_px": rng.normal(size=number), "y_px": 2.0 * before["row"]}
    before["x_px"][3] = np.nan
    after = {**before, "y_px": np.zeros(number)}
    four = decoded(residual_figure(before, after, "trip"))
    two = decoded(residual_figure({k: before[k] for k in ("row", "rate", "x_px", "y_px")}, {}))
    assert four.shape[1] > 1.6 * two.shape[1]
    steel = np.abs(four - np.array([70, 130, 180])).sum(axis=-1) < 30
    assert steel.sum() > 200
    assert not (np.abs(two - np.array([70, 130, 180])).sum(axis=-1) < 30).any()


def test_empty_data_gives_an_empty_figure():
    """Few or no residuals and an empty ladder raise no error."""
    one = {"row": np.zeros(3), "x_px": np.ones(3), "y_px": np.ones(3)}
    assert decoded(residual_figure(one, {})).size
    assert decoded(residual_figure({}, {})).size
    assert decoded(ladder_figure([])).size


@pytest.mark.parametrize(("tried", "mark"), [({"flicker": 0.01}, ", held-out frames"), ({}, "")])
def test_the_axis_label_names_held_out_frames(tried, mark):
    """Brightness causes are judged on held-out frames like all others; without a candidate only the fit is shown."""
    axes = canvas(4.0, 3.0).subplots()
    _draw_rung(axes, ("photometric_rms", 0.02, tried, None), 1, "")
    assert axes.get_xlabel().replace("\\_", "_") == f"photometric_rms{mark}"


def test_the_cause_that_entered_is_highlighted():
    """Its bar is blue; without such a cause no bar is. A candidate without a value is left out."""
    tried = {"time_offset": 0.2, "readout_time": 0.9, "gyro_bias": float("nan")}
    blue = [
        (np.abs(decoded(ladder_figure([("geometry_rms_px", 1.0, tried, name)])) - [70, 130, 180]).sum(-1) < 30).sum()
        for name in ("readout_time", "time_offset", None)
    ]
    assert blue[0] > 2 * blue[1] > 0
    assert blue[2] == 0
