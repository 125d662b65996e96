"""Outputs of a run: films, masks, crops, no frames; batches by name and by shard; dry runs."""

from __future__ import annotations

import json
import shutil
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from laws import RADTAN, phone

from virest.app.film import UPRIGHT, display_matrix, side_by_side, write_film
from virest.app.finish import (
    Finished,
    FinishOptions,
    common_rectangle,
    cropped_profile,
    finish_pictures,
    require_finishable,
)
from virest.app.names import batch_names, shard_of
from virest.app.preview import PreviewOptions, run_preview
from virest.app.run_folder import RunFolder
from virest.camera.field import Field
from virest.capture.video import MovieIndex
from virest.errors import OutputError

FAST = ("--preset", "fast", "--jobs", "1")


def lines_of(run: Path) -> list[dict]:
    """The log of a run."""
    return [json.loads(line) for line in (run / "parameters.jsonl").read_text().splitlines()]


def png(path: Path) -> np.ndarray:
    """A picture as stored."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


def film_frames(path: Path) -> tuple[list[float], list[np.ndarray], int]:
    """Times, frames and rotation of a film."""
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
        return (
            [float(f.pts * f.time_base) for f in frames],
            [f.to_ndarray(format="rgb24") for f in frames],
            frames[0].rotation,
        )


def test_a_film_has_the_times_and_frames_of_the_movie(swing: Path, virest_here, tmp_path: Path) -> None:
    """Restored frames stand beside recorded ones at the movie's times.

    ``--no-frames`` writes no frame, and the log says so.
    """
    film = ("--video", "film.mp4", "--side-by-side", "--no-frames")
    done = virest_here("process", swing, *FAST, "--frames", "2:8", *film)
    assert done.returncode == 0, done.stderr
    assert "wrote film.mp4" in done.stdout
    times, pictures, _ = film_frames(tmp_path / "film.mp4")
    assert len(times) == 6
    np.testing.assert_allclose(np.diff(times), 0.033333, atol=2e-5)
    assert pictures[0].shape == (176, 480, 3)
    run = tmp_path / "virest-out" / "swing"
    assert not list((run / "frames").iterdir())
    lines = lines_of(run)
    assert {line["output"] for line in lines} == {None}
    counts = json.loads((run / "run.json").read_text())["counts"]
    assert counts["straightened"] == sum("straightened" in line["done"] for line in lines) > 0
    assert counts["deblurred"] == sum("deblurred" in line["done"] for line in lines)
    assert json.loads((run / "run.json").read_text())["film"] == "film.mp4"
    whole = virest_here("process", swing, *FAST, "--frames", "2:8", "--out", "again")
    assert whole.returncode == 0
    restored = png(tmp_path / "again" / "swing" / "frames" / "000002.png")[..., ::-1]
    assert np.abs(pictures[0][:, 240:].astype(float) - restored).mean() < 8


@pytest.mark.parametrize("turn", [(0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0), UPRIGHT])
def test_a_film_has_the_rotation_of_the_movie(tmp_path: Path, turn: tuple[int, int, int, int]) -> None:
    """The display matrix of the film is read back by virest and by FFmpeg."""
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:, :20] = 200
    write_film(tmp_path / "film.mp4", [(0, picture), (40_000_000, picture)], 25.0, turn)
    assert display_matrix(tmp_path / "film.mp4") == turn
    _, _, rotation = film_frames(tmp_path / "film.mp4")
    expected = {(0, 1, -1, 0): (-90, 270), (-1, 0, 0, -1): (180, -180), (0, -1, 1, 0): (90, -270), UPRIGHT: (0,)}[turn]
    assert rotation in expected


def test_side_by_side_follows_the_displayed_orientation() -> None:
    """A film displayed with a quarter turn is stacked so that the recorded frame appears left of the restored one."""
    left, right = np.full((4, 6, 3), 10, np.uint8), np.full((4, 6, 3), 20, np.uint8)
    assert side_by_side(left, right, UPRIGHT)[0].tolist() == [[10] * 3] * 6 + [[20] * 3] * 6
    clockwise = side_by_side(
        left, right, (0, 1, -1, 0)
    )  # the stored x axis is displayed downwards, the stored y axis to the left
    assert np.rot90(clockwise, -1)[0, :, 0].tolist() == [10] * 4 + [20] * 4
    assert np.rot90(side_by_side(left, right, (0, -1, 1, 0)), 1)[0, :, 0].tolist() == [10] * 4 + [20] * 4
    assert np.rot90(side_by_side(left, right, (-1, 0, 0, -1)), 2)[0, :, 0].tolist() == [10] * 6 + [20] * 6


def test_masks_and_crop_separate_recorded_from_repeated_pixels(swing: Path, virest_here, tmp_path: Path) -> None:
    """A mask covers valid_px. The crop is the part that all frames share, and the run's profile describes the crop."""
    done = virest_here("process", swing, *FAST, "--mask", "--out", "masked")
    assert done.returncode == 0, done.stderr
    run = tmp_path / "masked" / "swing"
    lines = [line for line in lines_of(run) if line["status"] == "restored"]
    rims = 0
    for line in lines:
        mask = png(run / "masks" / Path(line["output"]).name)
        x0, y0, x1, y1 = line["valid_px"]
        assert mask.shape == (176, 240)
        assert set(np.unique(mask)) <= {0, 255}
        assert mask[y0:y1, x0:x1].min() == 255
        rims += int((mask == 0).any())
    assert rims > len(lines) // 2
    done = virest_here("process", swing, *FAST, "--mask", "--crop", "--out", "cropped", "--json")
    assert done.returncode == 0, done.stderr
    cropped = tmp_path / "cropped" / "swing"
    account = json.loads((cropped / "run.json").read_text())
    x0, y0, x1, y1 = account["crop_px"]
    rectangles = np.array([line["valid_px"] for line in lines])
    assert [x0, y0, x1, y1] == [*rectangles[:, :2].max(0), *rectangles[:, 2:].min(0)]
    assert account["profile"]["image"] == {"width": x1 - x0, "height": y1 - y0}
    assert account["profile"]["intrinsics"]["cx_px"] == pytest.approx(119.5 - x0)
    whole = png(run / lines[3]["output"])
    np.testing.assert_array_equal(png(cropped / lines[3]["output"]), whole[y0:y1, x0:x1])
    assert png(cropped / "masks" / "000003.png").min() == 255
    assert [json.loads(line)["crop_px"] for line in done.stdout.splitlines()] == [[x0, y0, x1, y1]] * len(
        lines_of(cropped)
    )
    exported = virest_here("export", swing, "--restored", cropped, "--out", "slam")
    assert exported.returncode == 0, exported.stderr
    report = virest_here("report", cropped)
    assert report.returncode == 0, report.stderr


@pytest.mark.parametrize("link", [False, True])
def test_outputs_never_replace_the_recording(tiny: Path, tmp_path: Path, link: bool) -> None:
    """A film or preview is refused there, even with --overwrite or through a link."""
    capture, target = shutil.copytree(tiny, tmp_path / "own"), tmp_path / "own" / "movie.mp4"
    before = target.read_bytes()
    if link:
        target = tmp_path / "film.mp4"
        target.symlink_to(capture / "movie.mp4")
    with pytest.raises(OutputError, match="belongs to the recording"):
        require_finishable(FinishOptions(str(target)), "own", tmp_path / "run", [capture / "movie.mp4"], overwrite=True)
    with pytest.raises(OutputError, match="belongs to the recording"):
        run_preview(str(capture), PreviewOptions(target, overwrite=True))
    assert (capture / "movie.mp4").read_bytes() == before


def test_a_run_without_pictures_has_nothing_to_finish(tmp_path: Path) -> None:
    """No film is reported, and skipped frames need no crop."""
    nothing = MovieIndex(16, 16, Fraction(1, 30), np.zeros(1, np.int64), (0,), (0,))
    options = FinishOptions(str(tmp_path / "film.mp4"), crop=True)
    run = RunFolder(tmp_path / "run")
    assert finish_pictures(run, [], tmp_path / "movie.mp4", nothing, options, "run") == Finished()
    assert common_rectangle([{"output": None, "valid_px": None}]) is None


def test_a_crop_keeps_the_lens() -> None:
    """A ray projects to the same point of the cropped frame, including distortion and displacement."""
    bent = Field("displacement", ("x", "y"), ((0.0, 70.0, 199.0), (0.0, 135.0)), ((1.0, 2.0), (0.5, -1.0)) * 3)
    profile = phone(lens=RADTAN).with_fields([bent])
    part = cropped_profile(profile, (12, 8, 180, 130))
    rays = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.0]])
    assert profile.intrinsics is not None
    assert part.intrinsics is not None
    np.testing.assert_allclose(part.intrinsics.project(rays), profile.intrinsics.project(rays) - (12, 8), atol=1e-9)
    assert (part.width, part.height) == (168, 122)


def test_copied_frames_can_be_skipped(tiny: Path, virest_here, tmp_path: Path) -> None:
    """With ``--skip-copied``, a run that only copies writes no PNG, and each line of the log says so."""
    done = virest_here("process", tiny, *FAST, "--deblur", "none", "--shutter", "none", "--skip-copied")
    assert done.returncode == 0, done.stderr
    run = tmp_path / "virest-out" / "tiny"
    assert {(line["status"], line["output"]) for line in lines_of(run)} == {("copied", None)}
    assert not list((run / "frames").iterdir())


def test_a_run_with_other_outputs_is_not_resumed(tiny: Path, virest_here, tmp_path: Path) -> None:
    """``--resume`` also compares the requested outputs."""
    assert virest_here("process", tiny, *FAST, "--frames", "3").returncode == 0
    assert len(lines_of(tmp_path / "virest-out" / "tiny")) == 1
    other = virest_here("process", tiny, *FAST, "--frames", "3", "--mask", "--resume")
    assert other.returncode == 8
    assert "outputs" in other.stderr


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--side-by-side"], "--side-by-side needs --video"),
        (["--no-frames"], "--no-frames needs --video"),
        (["--video", "film.avi"], "an MP4 is written; name it *.mp4"),
        (["--shard", "3/2"], "not a shard"),
        (["--frames", "x"], "not a slice"),
    ],
)
def test_inconsistent_options_are_usage_errors(tiny: Path, virest_here, arguments: list[str], says: str) -> None:
    """The error names what is missing, with exit code 2."""
    done = virest_here("process", tiny, *arguments)
    assert done.returncode == 2
    assert says in done.stderr


def test_a_dry_run_predicts_and_writes_nothing(swing: Path, virest_here, tmp_path: Path) -> None:
    """It predicts frames, time and bytes of a capture; no folder appears."""
    done = virest_here("process", swing, *FAST, "--dry-run", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert (facts["capture"], facts["frames"], facts["skipped"]) == ("swing", 10, 0)
    assert facts["seconds"] > 0
    assert 10 * 20_000 < facts["bytes"] < 10 * 240 * 176 * 3
    assert not (tmp_path / "virest-out").exists()


def test_folders_with_the_same_name_are_named_by_their_paths(tiny: Path, virest_here, tmp_path: Path) -> None:
    """Two captures with one name are both processed; the same folder given twice is an error."""
    for day in ("monday", "tuesday"):
        shutil.copytree(tiny, tmp_path / day / "walk")
    done = virest_here(
        "process",
        "monday/walk",
        "tuesday/walk/movie.mp4",
        *FAST,
        "--frames",
        "0:1",
        "-q",
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert sorted(p.name for p in (tmp_path / "virest-out").iterdir()) == ["monday-walk", "tuesday-walk"]
    twice = virest_here("process", "monday/walk", "monday/../monday/walk")
    assert twice.returncode == 8
    assert "given twice" in twice.stderr


def test_shards_divide_a_batch_and_keep_its_names(tmp_path: Path) -> None:
    """Every capture is in one shard and keeps the name that it has in the whole batch."""
    paths = [str(tmp_path / day / name) for day in ("a", "b") for name in ("walk", f"run-{day}", f"sit-{day}")]
    parts = [shard_of(paths, (part, 4)) for part in (1, 2, 3, 4)]
    assert sorted(path for found, _ in parts for path in found) == sorted(paths)
    assert {name for _, names in parts for name in names} == {
        "a-walk", "run-a", "sit-a", "b-walk", "run-b", "sit-b"}  # fmt: skip
    assert max(len(found) for found, _ in parts) - min(len(found) for found, _ in parts) <= 1
    with pytest.raises(OutputError, match="both be named"):
        batch_names([*paths, str(tmp_path / "c" / "a-walk")])


def test_the_table_fits_a_terminal_and_names_the_next_command(tiny: Path, virest_here, tmp_path: Path) -> None:
    """The table of a batch with long names fits 80 columns; the last line suggests the next command."""
    long = tmp_path / ("a_capture_with_a_rather_long_name_" * 2)
    shutil.copytree(tiny, long)
    done = virest_here("process", tiny, long, *FAST, "--frames", "0:1")
    assert done.returncode == 0, done.stderr
    table = [line for line in done.stdout.splitlines() if not line.startswith(("wrote", "next"))]
    assert len(table) == 3
    assert max(map(len, table)) <= 80
    assert done.stdout.splitlines()[-1].startswith("next: virest report virest-out")
