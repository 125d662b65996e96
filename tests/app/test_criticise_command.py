"""``virest criticise``: residuals of any calibration, in files written by other programs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from virest.app import cli
from virest.app.criticise import read_columns
from virest.diagnosis.field.residual_table import criticise

Table = dict[str, np.ndarray[Any, Any]]


def residuals(seed: int, **sizes: float) -> Table:
    """40 frames of 60 points with noise of 0.15 px and 2 % outliers; ``sizes`` sets the hidden effects."""
    rng, count = np.random.default_rng(seed), 40 * 60
    x, y = rng.uniform(0, 640, count), rng.uniform(0, 480, count)
    frame = np.repeat(np.arange(40.0), 60)
    vx, vy = (np.repeat(rng.normal(0, 150, 40), 60) for _ in "xy")
    dx, dy = rng.normal(0, 0.15, (2, count))
    u, v, row = (x - 320) / 320, (y - 240) / 320, y / 480
    lens = sizes.get("lens", 0.0)
    late_s = sizes.get("late_s", 0.0) * 4 * row * (1 - row)
    dx, dy = dx + lens * 2 * u * v + vx * late_s, dy + lens * (u * u + 3 * v * v) + vy * late_s
    lost = rng.random(count) < 0.02
    dx[lost] += rng.normal(0, 10, lost.sum())
    return {"x": x, "y": y, "dx": dx, "dy": dy, "row": row, "frame": frame, "vx": vx, "vy": vy}


@pytest.fixture
def written(tmp_path: Path) -> Callable[[Table], Path]:
    """Write a table."""

    def write(table: Table) -> Path:
        path = tmp_path / "residuals.csv"
        np.savetxt(path, np.stack(list(table.values()), axis=1), delimiter=",", header=",".join(table), comments="")
        return path

    return write


def test_hidden_effects_in_residuals_are_described(
    written: Callable[[Table], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """The JSON names covariates, shapes and sizes of a decentred lens and of uneven row times."""
    path = written(residuals(1, lens=0.3, late_s=2e-3))
    assert cli.run(["criticise", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    by_kind = {field["kind"]: field for field in found["fields"]}
    assert set(by_kind) == {"delay", "displacement"}
    assert by_kind["displacement"]["shape"] == "growing with its square"
    assert by_kind["delay"]["shape"] == "a parabola"
    delay = np.ptp(np.array(by_kind["delay"]["values"]))
    assert delay == pytest.approx(2e-3, rel=0.1)
    assert found["left_px"] == pytest.approx(0.15, rel=0.05)
    for field in found["fields"]:
        assert field["held_out"]["after"] < field["held_out"]["before"]
        assert field["p_value"] < found["false_alarm_rate"]


def test_the_text_describes_the_effect_in_a_sentence(
    written: Callable[[Table], Path], capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    """It adds a possible cause."""
    assert cli.run(["criticise", str(written(residuals(2, lens=0.3)))]) == 0
    said = capsys.readouterr().out
    assert "a lens that is not centred (tangential distortion)" in said
    assert "likely: a lens element off centre" in said


def test_an_interaction_is_described_after_the_single_covariates() -> None:
    """Distortion and focal length both depend on the focus: the pair of radius and focus comes last."""
    table = residuals(3)
    u, v = (table["x"] - 320) / 320, (table["y"] - 240) / 320
    focus = np.random.default_rng(4).uniform(0, 2, 40)[table["frame"].astype(int)]
    grown = 0.6 * focus * (u * u + v * v - 0.3) + 0.3 * focus
    found = criticise({**table, "focus": focus, "dx": table["dx"] + grown * u, "dy": table["dy"] + grown * v})
    assert found.findings[0].covariates == ("focus",)
    assert found.findings[-1].covariates == ("radius", "focus")
    assert found.findings[-1].shape.endswith("times a straight line of the focus")
    assert found.left_px == pytest.approx(0.15, rel=0.05)
    assert not criticise({**table, "focus": focus}).findings


def test_pure_noise_gives_no_finding() -> None:
    """None of eight tables of noise has a finding; the false-alarm rate is at most 1e-3 each."""
    assert not any(criticise(residuals(seed)).findings for seed in range(10, 18))


def test_a_missing_column_is_named_with_a_suggestion(
    written: Callable[[Table], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 4, and the error suggests a column to rename."""
    table = residuals(3)
    table["dx_px"] = table.pop("dx")
    assert cli.run(["criticise", str(written(table))]) == 4
    said = capsys.readouterr().err
    assert "no column dx" in said
    assert "rename 'dx_px' for 'dx'?" in said


FORMS = {
    "semicolons": lambda text: text.replace(",", ";"),
    "decimal commas": lambda text: text.replace(",", ";").replace(".", ","),
    "tabs": lambda text: text.replace(",", "\t"),
    "vnlog": lambda text: "#! a tool\n## its notes\n# " + text.replace(",", " "),
    "a byte order mark": lambda text: "\ufeff" + text,
}


@pytest.mark.parametrize("form", FORMS)
def test_a_table_reads_the_same_in_every_form(tmp_path: Path, form: str) -> None:
    """Semicolons, decimal commas, tabs, a vnlog legend or a byte order mark give the same columns and values."""
    text = "x,y,dx,dy,temp\n1.5,2.0,-0.25,0.5,30.0\n3.5,4.0,0.75,-1e-2,31.5\n"
    path = tmp_path / "residuals.csv"
    path.write_text(FORMS[form](text), encoding="utf-8")
    columns = read_columns(path)
    assert list(columns) == ["x", "y", "dx", "dy", "temp"]
    np.testing.assert_allclose(columns["dy"], (0.5, -0.01))
    np.testing.assert_allclose(columns["temp"], (30.0, 31.5))


@pytest.mark.parametrize(
    ("column", "value", "said"), [("dx", 1e300, "1e+300 px in column dx"), ("dx", 0.0, "all residuals are 0")]
)
def test_impossible_residuals_are_rejected(
    written: Callable[[Table], Path], capsys: pytest.CaptureFixture[str], column: str, value: float, said: str
) -> None:
    """Overflowing values and columns of zeros are errors."""
    table = residuals(4)
    table[column] = np.full_like(table[column], value)
    table["dy"] = np.zeros_like(table["dy"])
    assert cli.run(["criticise", str(written(table))]) == 4
    assert said in capsys.readouterr().err


def test_points_on_one_line_have_no_map() -> None:
    """A constant x is not used as a covariate and is no error."""
    table = residuals(5)
    table["x"] = np.full_like(table["x"], 100.0)
    assert "displacement over x, y" not in criticise(table).forms


@pytest.mark.parametrize(
    "content", ["", "x,y,dx,dy\n1,2,3,4\n", "x,y,dx,dy\na,b,c,d\n", "x,x,dx,dy\n1,1,1,1\n", "1,2,3,4\n5,6,7,8\n"]
)
def test_a_file_that_is_not_a_table_gives_one_line(
    tmp_path: Path, content: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """An empty file, one row, words, a repeated column, or no column names."""
    path = tmp_path / "residuals.csv"
    path.write_text(content, encoding="utf-8")
    assert cli.run(["criticise", str(path)]) == 4
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
