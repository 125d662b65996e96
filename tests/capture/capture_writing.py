"""Write tiny captures with known content."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

START_NS = 28_670_339_410_000
PERIOD_NS = 33_400_000
GYRO_7 = "Timestamp[nanosec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]"
METADATA_11 = (
    "Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec],Sensor frame duration[nanosec],"
    "Frame readout time[nanosec],ISO,Focal length,Focus distance,AF mode"
)


def write_movie(path: Path, pictures: list[np.ndarray], pts_ns: list[int], **options: str) -> None:
    """An H.264 movie of grey frames (h, w) with exact PTS on a 90 kHz clock."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.height, stream.width = pictures[0].shape
        stream.pix_fmt = "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 90_000)
        stream.options = {"preset": "ultrafast", "crf": "10", "g": "10", "bf": "0", **options}
        for picture, time_ns in zip(pictures, pts_ns, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = round(time_ns * 9 / 100_000), Fraction(1, 90_000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def moving_pictures(count: int, repeats: tuple[int, ...] = (), width: int = 64, height: int = 96) -> list[np.ndarray]:
    """A texture that moves 3 px per frame; frames in ``repeats`` repeat their predecessors."""
    scene = np.random.default_rng(5).integers(40, 216, (height, width + 4 * count), dtype=np.uint8)
    pictures: list[np.ndarray] = []
    for i in range(count):
        pictures.append(pictures[-1] if i in repeats else scene[:, 3 * i : 3 * i + width])
    return pictures


@dataclass
class CaptureWriter:
    """A capture to be written; a test can damage its parts first."""

    folder: Path
    count: int = 30
    repeats: tuple[int, ...] = ()
    rate_rad_s: float = 1.5
    stamps_ns: list[int] = field(default_factory=list)
    metadata_ns: list[int] = field(default_factory=list)
    imu_ns: list[int] = field(default_factory=list)
    fx: tuple[float, float] = (80.0, 81.0)
    readout_ns: str = "20000000"
    exposure_ns: str = "5000000"
    width: int = 64
    height: int = 96

    def __post_init__(self) -> None:
        self.folder.mkdir(exist_ok=True)
        # one long step makes the alignment unique
        steps = [i * PERIOD_NS + (17_000_000 if i > 7 else 0) for i in range(self.count)]
        self.stamps_ns = [START_NS + step for step in steps]
        self.metadata_ns = [stamp + 437 for stamp in self.stamps_ns]
        self.imu_ns = list(range(START_NS - 200_000_000, self.stamps_ns[-1] + 300_000_000, 5_000_000))

    def write(self) -> Path:
        self.write_movie()
        self.write_stamps()
        self.write_metadata()
        self.write_gyro()
        return self.folder

    def write_movie(self, **options: str) -> None:
        pictures = moving_pictures(self.count, self.repeats, self.width, self.height)
        steps = [i * PERIOD_NS + (17_000_000 if i > 7 else 0) for i in range(self.count)]
        write_movie(self.folder / "movie.mp4", pictures, steps, **options)

    def write_stamps(self) -> None:
        rows = [f"{stamp // 1000 * 1000}" for stamp in self.stamps_ns]
        self.text("frame_timestamps.txt", ["Frame timestamp[nanosec]", *rows])

    def write_metadata(self) -> None:
        rows = [
            f"{t},{self.fx[0]},{self.fx[1]},{n + 200},{self.exposure_ns},33333333,{self.readout_ns},144,3.95,0.1,3"
            for n, t in enumerate(self.metadata_ns)
        ]
        self.text("movie_metadata.csv", [METADATA_11, *rows])

    def write_gyro(self) -> None:
        rows = [f"{t},{0.1},{self.rate_rad_s},-8.2E-4,0.1,9.7,-0.3" for t in self.imu_ns]
        self.text("gyro_accel.csv", [GYRO_7, *rows])

    def text(self, name: str, lines: list[str], end: str = "\n") -> Path:
        path = self.folder / name
        path.write_bytes((end.join(lines) + end).encode())
        return path
