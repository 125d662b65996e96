"""Bracketed stills: exposure times from a CSV and from EXIF, and the errors of both."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_writing import CaptureWriter

from virest.capture.folder import read_capture
from virest.capture.stills import ExifExposure, capture_bracket, read_bracket, read_exif_exposure, read_exposures
from virest.errors import CaptureError


def exif_block(order: str = "<", exposure: tuple[int, int] = (1, 125), f_number: tuple[int, int] = (18, 10),
               iso: int = 200) -> bytes:  # fmt: skip
    """A TIFF block with an EXIF directory of exposure time, f-number and ISO."""
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    ifd0 = struct.pack(order + "HHHII I".replace(" ", ""), 1, 0x8769, 4, 1, 26, 0)
    values_at = 26 + 2 + 3 * 12 + 4
    exif = struct.pack(order + "H", 3)
    exif += struct.pack(order + "HHII", 0x829A, 5, 1, values_at)
    exif += struct.pack(order + "HHII", 0x829D, 5, 1, values_at + 8)
    exif += struct.pack(order + "HHIHH", 0x8827, 3, 1, iso, 0) + struct.pack(order + "I", 0)
    return head + ifd0 + exif + struct.pack(order + "IIII", *exposure, *f_number)


def with_exif(jpeg: bytes, block: bytes) -> bytes:
    """A JPEG with an added APP1 segment."""
    body = b"Exif\0\0" + block
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


def write_stills(folder: Path, count: int = 3, suffix: str = ".png", shape: tuple[int, int] = (24, 40)) -> list[str]:
    """Write pictures of random levels; return their names."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(2)
    names = [f"p{i}{suffix}" for i in range(count)]
    for name in names:
        cv2.imwrite(str(folder / name), rng.integers(0, 255, (*shape, 3), dtype=np.uint8))
    return names


@pytest.mark.parametrize("order", ["<", ">"])
def test_exif_is_read_in_both_byte_orders(order: str) -> None:
    """EXIF is read from a JPEG, from a TIFF, and from a PNG chunk."""
    truth = ExifExposure(0.008, 1.8, 200.0)
    block = exif_block(order)
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    png = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    chunk = struct.pack(">I", len(block)) + b"eXIf" + block + b"\0\0\0\0"
    for data in (with_exif(jpeg, block), block, png[:33] + chunk + png[33:]):
        assert read_exif_exposure(data) == truth


def test_damaged_exif_gives_no_exposure() -> None:
    """Truncated or corrupted JPEG headers give no error, no endless loop and no invalid value."""
    jpeg = with_exif(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes(), exif_block())
    rng = np.random.default_rng(0)
    for cut in range(0, 130):
        read_exif_exposure(jpeg[:cut])
    for _ in range(500):
        spoiled = bytearray(jpeg[:160])
        for place in rng.integers(0, 130, 3):
            spoiled[place] = rng.integers(0, 256)
        found = read_exif_exposure(bytes(spoiled))
        assert found.exposure_s is None or (np.isfinite(found.exposure_s) and found.exposure_s > 0)
    assert read_exif_exposure(exif_block(exposure=(1, 0))).exposure_s is None
    assert read_exif_exposure(b"") == ExifExposure()


def test_a_bracket_takes_its_exposures_from_exif(tmp_path: Path) -> None:
    """ISO and f-number also count, relative to the first picture."""
    write_stills(tmp_path, 2, ".jpg")
    for i, block in enumerate((exif_block(), exif_block(exposure=(1, 60), iso=400, f_number=(36, 10)))):
        path = tmp_path / f"p{i}.jpg"
        path.write_bytes(with_exif(path.read_bytes(), block))
    stills, notes = read_bracket(tmp_path)
    assert [s.exposure_s for s in stills] == pytest.approx([1 / 125, 1 / 60])
    assert [s.gain for s in stills] == pytest.approx([1.0, 0.5])
    assert stills[1].exposure == pytest.approx(0.5 / 60)
    assert "ISO" in notes[0]


def test_a_bracket_takes_its_exposures_from_a_csv(tmp_path: Path) -> None:
    """Spaces, column order and an unlisted picture do not matter; colours are read as RGB."""
    names = write_stills(tmp_path)
    picture = np.zeros((24, 40, 3), np.uint8)
    picture[..., 2] = 200
    cv2.imwrite(str(tmp_path / names[0]), picture)
    table = tmp_path / "t.csv"
    table.write_text("exposure_s, file\n0.01, p0.png\n\n0.02,p2.png\n")
    stills, notes = read_bracket(tmp_path, table)
    assert [(s.file, s.exposure_s, s.gain) for s in stills] == [("p0.png", 0.01, 1.0), ("p2.png", 0.02, 1.0)]
    assert stills[0].levels[3, 4].tolist() == [200, 0, 0]
    assert "p1.png" in notes[0]


def test_16_bit_levels_keep_their_fractions(tmp_path: Path) -> None:
    """Levels are floats from 0 to 255; 65535 is 255."""
    cv2.imwrite(str(tmp_path / "a.png"), np.full((10, 12, 3), 12345, np.uint16))
    (tmp_path / "t.csv").write_text("file,exposure_s\na.png,1\n")
    stills, _ = read_bracket(tmp_path, tmp_path / "t.csv")
    assert stills[0].levels.dtype == np.float32
    np.testing.assert_allclose(stills[0].levels, 12345 / 257, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "lists no pictures"),
        ("file,exposure_s\n", "lists no pictures"),
        ("file,exposure\np0.png,1\n", "line 1: unknown column 'exposure'"),
        ("file\np0.png\n", "line 1: columns file"),
        ("file,exposure_s\nmissing.png,1\n", "line 2: no picture 'missing.png'"),
        ("file,exposure_s\n../p0.png,1\n", "no picture"),
        ("file,exposure_s\np0.png,nan\n", "line 2: exposure_s 'nan'"),
        ("file,exposure_s\np0.png,inf\n", "'inf'"),
        ("file,exposure_s\np0.png,-0.1\n", "'-0.1'"),
        ("file,exposure_s\np0.png,0\n", "'0'"),
        ("file,exposure_s\np0.png,soon\n", "'soon'"),
        ("file,exposure_s\np0.png,1,2\n", "line 2: 3 values"),
        ("file,exposure_s\np0.png,1\np0.png,2\n", "line 3: p0.png is listed twice"),
        ("file,exposure_s\n" + "x" * 10_000 + ",1\n", "line 2: 10002 characters"),
        ("file,exposure_s\np0.png,\0\n", "NUL"),
    ],
)
def test_faults_of_the_csv_are_named(tmp_path: Path, text: str, says: str) -> None:
    """The one-line error names the line or the value."""
    write_stills(tmp_path)
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(CaptureError) as refusal:
        read_bracket(tmp_path, tmp_path / "t.csv")
    assert says in str(refusal.value)
    assert len(str(refusal.value)) < 250
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_damaged_picture_is_refused_without_decoder_messages(
    tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """For a truncated file and a PNG with one wrong bit, the decoder prints nothing on standard error."""
    names = write_stills(tmp_path, 2, suffix)
    table = tmp_path / "t.csv"
    table.write_text("file,exposure_s\n" + "".join(f"{n},{i + 1}\n" for i, n in enumerate(names)))
    whole = (tmp_path / names[0]).read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for data in [whole[: len(whole) // 2], bytes(flipped)][: 2 if suffix == ".png" else 1]:
        (tmp_path / names[0]).write_bytes(data)
        with pytest.raises(CaptureError, match=r"damaged|cannot be decoded"):
            read_bracket(tmp_path, table)
    assert capfd.readouterr().err == ""


def test_hidden_files_are_ignored(tmp_path: Path) -> None:
    """macOS leaves a hidden file with the same suffix beside each picture."""
    names = write_stills(tmp_path, 2)
    (tmp_path / f"._{names[0]}").write_bytes(b"\0\5\x16\7")
    table = tmp_path / "t.csv"
    table.write_text("file,exposure_s\n" + "".join(f"{n},{i + 1}\n" for i, n in enumerate(names)))
    stills, notes = read_bracket(tmp_path, table)
    assert len(stills) == 2
    assert notes == []


def test_invalid_brackets_are_refused(tmp_path: Path) -> None:
    """A missing or empty folder, no EXIF, damaged pictures, two sizes, and a missing CSV."""
    with pytest.raises(CaptureError, match="no such folder"):
        read_bracket(tmp_path / "nowhere")
    with pytest.raises(CaptureError, match="no PNG"):
        read_bracket(tmp_path)
    folder = tmp_path / "b"
    names = write_stills(folder)
    with pytest.raises(CaptureError, match=r"no exposure time.*--exposures"):
        read_bracket(folder)
    with pytest.raises(CaptureError, match=r"^exposures\.csv: no such file; check the path given to --exposures$"):
        read_exposures(Path("exposures.csv"), [])
    with pytest.raises(CaptureError, match="no such file"):
        read_bracket(folder, tmp_path / "none.csv")
    table = tmp_path / "t.csv"
    table.write_text("file,exposure_s\n" + "".join(f"{n},{i + 1}\n" for i, n in enumerate(names)))
    write_stills(folder, 1, shape=(24, 50))
    with pytest.raises(CaptureError, match="different sizes"):
        read_bracket(folder, table)
    (folder / names[0]).write_bytes(b"\x89PNG no picture")
    with pytest.raises(CaptureError, match="cannot be decoded"):
        read_bracket(folder, table)
    (folder / names[0]).write_bytes(b"")
    with pytest.raises(CaptureError, match="cannot be decoded"):
        read_bracket(folder, table)


def test_frames_of_equal_exposure_are_averaged(writer: CaptureWriter) -> None:
    """Frames are grouped by exposure × ISO: two settings with the same product give one picture."""
    writer.write()
    path = writer.folder / "movie_metadata.csv"
    head, *rows = path.read_text().splitlines()
    column = head.split(",").index("Exposure time[nanosec]"), head.split(",").index("ISO")
    settings = [(4_000_000, 100), (8_000_000, 100), (8_000_000, 50), (16_000_000, 200)]
    for i, row in enumerate(rows):
        cells = row.split(",")
        cells[column[0]], cells[column[1]] = (str(v) for v in settings[i % 4])
        rows[i] = ",".join(cells)
    path.write_text("\n".join([head, *rows]) + "\n")
    stills, notes = capture_bracket(read_capture(writer.folder))
    lights = np.array([s.exposure for s in stills])
    np.testing.assert_allclose(lights / lights[0], [1, 2, 8], rtol=1e-6)
    assert all(s.file.startswith("frame ") for s in stills)
    assert stills[0].levels.shape == (96, 64, 3)
    assert "3 exposures" in notes[-1]


def test_a_capture_without_exposures_is_refused(writer: CaptureWriter) -> None:
    """The error states that no exposure is logged."""
    writer.write()
    (writer.folder / "movie_metadata.csv").unlink()
    with pytest.raises(CaptureError, match="no frame has a logged exposure"):
        capture_bracket(read_capture(writer.folder))
