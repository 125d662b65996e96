"""Simulate and process as a user would, and read the results."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import cv2
import numpy as np

from virest.evaluation.fidelity import psnr_db

Virest = Callable[..., CompletedProcess[str]]
Picture = np.ndarray[Any, np.dtype[np.uint8]]


@dataclass(frozen=True)
class Result:
    """The output of one ``virest process``."""

    folder: Path
    lines: list[dict[str, Any]]
    account: dict[str, Any]
    stderr: str

    def picture(self, line: dict[str, Any]) -> Picture:
        """Read the RGB picture of a line."""
        return read_png(self.folder / line["output"])


def read_png(path: Path) -> Picture:
    """Read an RGB picture."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert picture is not None, path
    return picture[..., ::-1].astype(np.uint8)


def simulate(virest: Virest, folder: Path, *arguments: object) -> Path:
    """Run ``virest simulate`` and return the capture's folder."""
    done = virest("simulate", folder, "-q", *arguments)
    assert done.returncode == 0, done.stderr
    return folder


def process(virest: Virest, capture: Path, out: Path, *arguments: object) -> Result:
    """Run ``virest process``, which must end with exit code 0."""
    done = virest("process", capture, "--out", out, "--jobs", 1, *arguments, timeout=1800)
    assert done.returncode == 0, done.stderr
    folder = out / capture.name
    lines = [json.loads(line) for line in (folder / "parameters.jsonl").read_text(encoding="utf-8").splitlines()]
    return Result(folder, lines, json.loads((folder / "run.json").read_text(encoding="utf-8")), done.stderr)


def truth_picture(capture: Path, frame: int, folder: str = "frames") -> Picture:
    """Read the sharp picture of a global shutter."""
    return read_png(capture / "truth" / folder / f"{frame:06d}.png")


def psnrs_db(result: Result, base: Result, capture: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
    """PSNR of each frame against truth, inside the valid rectangle of ``base``."""
    pairs = zip(result.lines, base.lines, strict=True)
    return np.array([psnr_db(result.picture(a), truth_picture(capture, a["frame"]), b["valid_px"]) for a, b in pairs])
