"""Fields: interpolation between knots, storage in a profile, and their effect on lens and shutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from virest.camera.field import Field
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import format_profile, parse_profile
from virest.camera.shutter import Shutter
from virest.errors import SettingsError

ROWS = (0.0, 0.2, 0.45, 0.8, 1.0)
LATE = Field("delay", ("row",), (ROWS,), tuple((0.006 * r * (1 - r) + 0.001 * r,) for r in ROWS))
TIMES = (0.0, 0.5, 1.0)
PAIRS = (
    Field(
        "delay",
        ("row", "time"),
        ((0.0, 0.5, 1.0), TIMES),
        tuple((1e-3 * r * t,) for r in (0, 1, 2) for t in (0, 1, 3)),
        (),
        77,
    ),
    Field(
        "scale",
        ("radius", "time"),
        ((0.0, 200.0, 400.0), TIMES),
        tuple((0.01 * r * t,) for r in (0, 1, 3) for t in (0, 1, 2)),
        (),
        77,
    ),
    Field(
        "rate",
        ("rate_x", "time"),
        ((-2.0, 2.0), TIMES),
        tuple((0.02 * r * t, 0.0, 0.0) for r in (-1, 1) for t in (0, 1, 2)),
        (),
        77,
    ),
)
LENS = Intrinsics(640, 480, 510.0, 505.0, 322.0, 236.0, "radtan", (-0.05, 0.01, 0.001, -0.002, 0.0))


def bent() -> Field:
    """An asymmetric displacement of a few pixels."""
    x, y = (0.0, 200.0, 430.0, 639.0), (0.0, 150.0, 479.0)
    values = [(1e-5 * a * b - 0.5, 2e-5 * (b - 200) * a / 2 + 0.3) for a in x for b in y]
    return Field("displacement", ("x", "y"), (x, y), tuple(values))


def every_kind() -> list[Field]:
    """One field of each kind."""
    zoom = Field("scale", ("time",), ((0.0, 1.0, 2.0),), ((0.0,), (0.01,), (0.015,)), ((0.0,), (1e-4,), (2e-4,)), 77)
    rate = Field("rate", ("accel_y",), ((-20.0, 20.0),), ((-0.1, 0.02, 0.03), (0.1, -0.02, -0.03)))
    drift = Field("delay", ("time",), ((0.0, 1.0, 2.0),), ((0.0,), (0.002,), (-0.001,)), (), 77)
    light = Field("gain", ("x", "y"), ((0.0, 639.0), (0.0, 479.0)), ((0.0,), (0.1,), (-0.05,), (0.0,)))
    return [LATE, bent(), zoom, rate, drift, light, *PAIRS]


def camera() -> CameraProfile:
    """A camera without fields."""
    return CameraProfile(640, 480, intrinsics=LENS, shutter=Shutter(0.02, "bottom_to_top"), time_offset_s=0.0)


def test_a_field_interpolates_its_values_and_is_constant_outside() -> None:
    """A cubic spline reproduces a parabola between the knots and does not extrapolate."""
    along = np.linspace(0, 1, 37)
    assert LATE.at(along)[:, 0] == pytest.approx(0.006 * along * (1 - along) + 0.001 * along, abs=1e-12)
    assert LATE.at(np.array([-3.0, 5.0]))[:, 0] == pytest.approx([0.0, 0.001])


def test_a_blur_field_is_piecewise_linear() -> None:
    """A spline through a short blur would oscillate and blur sharp frames."""
    blur = Field("blur", ("time",), ((0.0, 1.2, 1.5, 2.3),), ((0.0,), (0.2,), (2.0,), (0.0,)))
    assert blur.at_time(np.array([0.6, 1.35, 1.9]))[:, 0] == pytest.approx([0.1, 1.1, 1.0])
    with pytest.raises(SettingsError, match="0 or more"):
        blur.with_values(-np.array(blur.values))


def test_over_the_frame_the_second_covariate_varies_fastest() -> None:
    """Values at the knots are as written, and interpolation is exact for a product of both covariates."""
    field = bent()
    assert field.at(430.0, 150.0) == pytest.approx(field.values[2 * 3 + 1])
    assert field.at(np.array([[77.0, 500.0]]), np.array([[33.0, 401.0]]))[0, 1, 0] == pytest.approx(
        1e-5 * 500 * 401 - 0.5
    )  # fmt: skip


def test_a_profile_with_fields_is_read_as_it_was_written() -> None:
    """YAML keeps all numbers and the capture that a field belongs to."""
    profile = replace(camera().with_fields(every_kind()), imu_untrusted_s=((1.4, 1.55),), imu_untrusted_stamp_0_ns=9)
    again = parse_profile(yaml.safe_load(format_profile(profile)))
    assert again.fields == profile.fields
    assert (again.imu_untrusted_s, again.imu_untrusted_stamp_0_ns) == (((1.4, 1.55),), 9)
    assert again.shutter.uneven == LATE
    assert again.intrinsics is not None
    assert again.intrinsics.displaced == bent()
    assert again.with_fields(()) == replace(again, shutter=again.shutter.__class__(0.02, "bottom_to_top"),
        intrinsics=LENS, extensions=replace(again.extensions, field=()))  # fmt: skip


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "delays"}, "kind"),
        ({"covariates": ["focus"]}, "covariates must be"),
        ({"knots": [[0.0, 0.5, 0.5, 0.8, 1.0]]}, "rising knots"),
        ({"values": [[0.0]]}, "1 numbers for each knot"),
        ({"version": 3}, "version"),
    ],
)
def test_an_invalid_field_is_refused(change: dict[str, object], said: str) -> None:
    """A wrong kind, covariate, knot, number of values or version."""
    content = yaml.safe_load(format_profile(camera().with_fields([LATE])))
    content["extensions"]["field"][0].update(change)
    with pytest.raises(SettingsError, match=said):
        parse_profile(content, "camera.yaml")


def test_an_untrusted_interval_must_end_after_its_start() -> None:
    """Such an interval would never apply."""
    content = yaml.safe_load(format_profile(camera()))
    content["imu_untrusted_s"] = [[2.0, 1.0]]
    with pytest.raises(SettingsError, match="end after it starts"):
        parse_profile(content)


def test_uneven_rows_start_later_by_the_delay_field() -> None:
    """The delay adds to an even readout; the row fraction of a point is unchanged."""
    even = Shutter(0.02, "bottom_to_top")
    points = np.array([[10.0, 300.0], [500.0, 40.0]])
    late = replace(even, uneven=LATE)
    fraction = even.readout_fraction(points, 640, 480)
    assert late.row_fraction(points, 640, 480) == pytest.approx(fraction)
    added_s = 0.02 * (late.readout_fraction(points, 640, 480) - fraction)
    assert added_s == pytest.approx(0.006 * fraction * (1 - fraction) + 0.001 * fraction)


def test_a_displaced_lens_inverts_its_rays() -> None:
    """Projection differs from the plain lens by the field's value at the point's undisplaced position."""
    lens = replace(LENS, displaced=bent())
    points = np.stack(np.meshgrid(np.linspace(5, 630, 9), np.linspace(5, 470, 7)), axis=-1)
    assert lens.project(lens.rays(points)) == pytest.approx(points, abs=1e-4)
    rays = LENS.rays(points)
    assert lens.project(rays) - points == pytest.approx(bent().at(points[..., 0], points[..., 1]), abs=1e-6)


def test_a_field_can_be_shifted_in_time() -> None:
    """Values at the same instants stay the same."""
    field = every_kind()[2]
    assert field.later(0.3).at_time(0.4) == pytest.approx(field.at_time(0.7))
    late, drawn, _ = PAIRS
    assert late.later(0.3).at(0.7, 0.4) == pytest.approx(late.at(0.7, 0.7))
    assert drawn.later(0.3).at_time(0.4, 150.0) == pytest.approx(drawn.at_time(0.7, 150.0))


def test_fields_over_two_covariates_have_version_2() -> None:
    """A program that does not know such fields rejects the file instead of misreading it."""
    content = yaml.safe_load(format_profile(camera().with_fields([LATE, *PAIRS])))
    assert [entry["version"] for entry in content["extensions"]["field"]] == [1, 2, 2, 2]
