"""The Python blocks of the documentation and the notebook run and give the stated results."""

import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest
from documentation import DOCS, README, ROOT, fences

PYTHON = [fence for page in (README, DOCS / "python.md") for fence in fences(page) if fence.language == "python"]


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the samples, as a reader would have it."""
    (tmp_path / "sample_data").symlink_to(ROOT / "sample_data")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("number", range(len(PYTHON)))
def test_a_python_block_runs(number: int, workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each block runs alone and prints output if it calls print."""
    exec(compile(PYTHON[number].text, str(PYTHON[number].page), "exec"), {})
    assert "print(" not in PYTHON[number].text or capsys.readouterr().out


def test_the_notebook_runs(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It leads from a capture to a restored frame, and to an extended profile with the hidden readout time."""
    mpl.use("Agg")
    notebook = json.loads((ROOT / "examples" / "capture_to_profile.ipynb").read_text("utf-8"))
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    assert names["restored"].status == "restored"
    assert [cause["name"] for cause in names["diagnosis"]["causes"]] == ["readout_time"]
    assert names["better"].profile.shutter.readout_time_s == pytest.approx(0.012, abs=5e-4)
    made = {path.name for path in workplace.iterdir()}
    assert made == {"sample_data", "walk", "extended.yaml"}
