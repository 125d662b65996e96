"""``process --undistort``: straight lines are straight, frames match the truth, and outputs describe these frames."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import yaml

from virest.app.simulate import simulate_command
from virest.evaluation.boards import Board, find_board
from virest.evaluation.fidelity import point_distances_px

FAST = ("--preset", "fast", "--jobs", "1")
COPY = (*FAST, "--deblur", "none", "--shutter", "none")
BARREL = (-0.3, 0.08, 0.0, 0.0, 0.0)
PINCUSHION = {"model": "radtan", "k1": 0.25, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}


@pytest.fixture(scope="module")
def barrel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of a board from a turning phone whose lens bends lines by 10 px."""
    folder = tmp_path_factory.mktemp("captures") / "barrel"
    simulate_command(folder, scene="board", width=360, height=480, frames=3, exposure_ms=1.0, rate_rad_s=0.8,
                     focal_px=330.0, distortion=("radtan", BARREL), seed=5, bitrate_bits_per_px=3.0,
                     noise_levels=0.5)  # fmt: skip
    return folder


def png(path: Path) -> Any:
    """A picture as stored."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None, path
    return picture


def lines_of(run: Path) -> list[dict[str, Any]]:
    """The log of a run."""
    return [json.loads(line) for line in (run / "parameters.jsonl").read_text().splitlines()]


def bend_px(board: Board) -> float:
    """Typical distance of a board's corners from straight lines through its rows and columns.

    The median is used because OpenCV misplaces corners by pixels where the border of the frame cuts a square.
    """
    off = []
    for line in (*board.points_px, *board.points_px.swapaxes(0, 1)):
        centred = line - line.mean(0)
        off.append(centred @ np.linalg.svd(centred)[2][1])
    return 1.4826 * float(np.median(np.abs(np.concatenate(off))))


def with_lens(capture: Path, place: Path, **lens: Any) -> Path:
    """The capture's profile with another lens, as a file."""
    profile = yaml.safe_load((capture / "camera.yaml").read_text())
    profile["intrinsics"].update(lens)
    place.write_text(yaml.safe_dump(profile))
    return place


def test_undistorted_frames_match_the_truth_and_export_without_distortion(
    barrel: Path, virest_here: Any, tmp_path: Path
) -> None:
    """One warp corrects rolling shutter and lens.

    The frames match OpenCV's undistorted truth, and run.json describes this pinhole camera.
    """
    for out, options in (("bent", ()), ("flat", ("--undistort",))):
        done = virest_here("process", barrel, *FAST, *options, "--out", out)
        assert done.returncode == 0, done.stderr
    run = tmp_path / "flat" / "barrel"
    account = json.loads((run / "run.json").read_text())
    recorded = account["recorded_intrinsics"]
    assert account["profile"]["intrinsics"] == {**recorded, "distortion": "none"}
    assert recorded["distortion"]["k1"] == BARREL[0]
    assert (account["counts"]["undistorted"], account["settings"]["undistort"]) == (3, True)
    lens = np.array([[330.0, 0, 179.5], [0, 330.0, 239.5], [0, 0, 1]])
    bends = []
    for line in lines_of(run):
        assert line["done"] == ["straightened", "undistorted"]
        restored, x, y = png(run / line["output"]), *line["valid_px"][:2]
        assert (x, y) == (0, 0), "the pinhole frame of a barrel lens lies inside the recorded frame"
        truth = png(barrel / "truth" / "frames" / Path(line["output"]).name)
        flat = cv2.undistort(truth, lens, np.array(BARREL))
        assert np.median(point_distances_px(restored, flat, line["valid_px"])) < 0.1
        boards = [find_board(cv2.cvtColor(p, cv2.COLOR_BGR2GRAY), "chessboard")
                  for p in (restored, png(tmp_path / "bent" / "barrel" / line["output"]))]  # fmt: skip
        if all(boards):
            bends.append([bend_px(board) for board in boards if board])
    straight, bent = np.max(bends, axis=0)
    assert straight < 0.25
    assert bent > 8 * straight
    for kind in ("colmap", "nerfstudio", "euroc", "tum"):
        assert virest_here("export", barrel, "--restored", run, "--format", kind, "--out", kind).returncode == 0
    assert " PINHOLE 360 480 330 330 180 240" in (tmp_path / "colmap/barrel/sparse/0/cameras.txt").read_text()
    transforms = json.loads((tmp_path / "nerfstudio/barrel/transforms.json").read_text())
    assert not any(transforms.get(name) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    for kind in ("euroc", "tum"):
        chain = yaml.safe_load((tmp_path / kind / "barrel" / "camchain-imucam.yaml").read_text())
        assert set(chain["cam0"]["distortion_coeffs"]) == {0.0}


def test_copied_frames_masks_crops_and_films_share_the_pinhole_camera(
    barrel: Path, virest_here: Any, tmp_path: Path
) -> None:
    """With a pincushion lens the corners have no data, which mask, valid_px and crop show.

    Copied frames in a film are undistorted too.
    """
    config = with_lens(barrel, tmp_path / "lens.yaml", distortion=PINCUSHION)
    assert virest_here("process", barrel, *COPY, "--out", "raw").returncode == 0
    options = ("--config", config, "--undistort", "--mask", "--crop", "--video", "all.mp4")
    done = virest_here("process", barrel, *COPY, *options, "--out", "flat")
    assert done.returncode == 0, done.stderr
    lens = np.array([[330.0, 0, 179.5], [0, 330.0, 239.5], [0, 0, 1]])
    k = np.array([PINCUSHION[name] for name in ("k1", "k2", "p1", "p2", "k3")])
    maps = cv2.initUndistortRectifyMap(lens, k, None, lens, (360, 480), cv2.CV_32FC1)
    run = tmp_path / "flat" / "barrel"
    account = json.loads((run / "run.json").read_text())
    x0, y0, x1, y1 = account["crop_px"]
    assert (x0 > 10, y0 > 10) == (True, True)
    assert account["profile"]["intrinsics"]["cx_px"] == 179.5 - x0
    assert account["profile"]["intrinsics"]["distortion"] == "none"
    inside = (maps[0] > -0.5) & (maps[0] < 359.5) & (maps[1] > -0.5) & (maps[1] < 479.5)
    assert inside[y0:y1, x0:x1].all()
    for line in lines_of(run):
        assert (line["status"], line["done"]) == ("copied", ["undistorted"])
        raw = png(tmp_path / "raw" / "barrel" / line["output"])
        flat = cv2.remap(raw, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)[y0:y1, x0:x1]
        assert (
            np.abs(png(run / line["output"]).astype(int) - flat).max() <= 4
        )  # OpenCV's tables have a resolution of 1/32 px
        np.testing.assert_array_equal(png(run / "masks" / Path(line["output"]).name), 255)
    done = virest_here("process", barrel, *COPY, *options[:-1], "film.mp4", "--skip-copied", "--out", "film")
    assert done.returncode == 8  # --crop without a picture
    options = ("--config", config, "--undistort", "--skip-copied", "--video", "film.mp4")
    done = virest_here("process", barrel, *COPY, *options, "--out", "skipped")
    assert done.returncode == 0, done.stderr
    assert {tuple(line["done"]) for line in lines_of(tmp_path / "skipped" / "barrel")} == {()}
    with av.open(str(tmp_path / "film.mp4")) as film, av.open(str(tmp_path / "all.mp4")) as cropped:
        whole, part = (next(f.decode(video=0)).to_ndarray(format="rgb24") for f in (film, cropped))
    height, width = part.shape[:2]
    assert np.abs(whole[y0 : y0 + height, x0 : x0 + width].astype(int) - part).mean() < 3


def test_resume_compares_the_lens_geometry(barrel: Path, virest_here: Any, tmp_path: Path) -> None:
    """``--resume`` does not mix two geometries; a lens that cannot be inverted is refused with exit 3."""
    assert virest_here("process", barrel, *COPY, "--frames", "0").returncode == 0
    other = virest_here("process", barrel, *COPY, "--frames", "0", "--undistort", "--resume")
    assert other.returncode == 8
    assert "undistort False, now True" in other.stderr
    folds = with_lens(barrel, tmp_path / "fold.yaml", distortion={**PINCUSHION, "k1": -1.5})
    refused = virest_here("process", barrel, *COPY, "--config", folds, "--undistort", "--out", "fold")
    assert refused.returncode == 3
    assert "different rays at one place" in refused.stderr


def test_a_lens_without_distortion_changes_no_byte(swing: Path, virest_here: Any, tmp_path: Path) -> None:
    """The frames equal those of a run without the option, and a message says that it has no effect."""
    for out, options in (("plain", ()), ("same", ("--undistort",))):
        done = virest_here("process", swing, *FAST, "--frames", "2:4", *options, "--out", out)
        assert done.returncode == 0, done.stderr
        assert ("--undistort has no effect" in done.stderr) == bool(options)
    for line in lines_of(tmp_path / "same" / "swing"):
        assert "undistorted" not in line["done"]
        plain, same = (tmp_path / out / "swing" / line["output"] for out in ("plain", "same"))
        assert plain.read_bytes() == same.read_bytes()
