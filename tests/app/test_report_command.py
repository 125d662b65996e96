"""``virest report``: the page of a real run, errors for broken runs, and the page in a real browser."""

import base64
import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from virest.app import cli
from virest.app.simulate import simulate_command
from virest.capture.video import probe_movie, read_frames

HOLE_NS = (245_000_000, 450_000_000)
"""Time from the first frame."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PHONE, DESK = {"width": 390, "height": 844}, {"width": 1280, "height": 900}
HOSTILE = "<img src=x onerror=alert(1)> \"'><script>alert(2)</script> ../../\u202egnp"
CAUSE = {
    "name": "readout_time",
    "parameters": {"readout_time_s": {"nominal": 0.02, "estimate": 0.0149, "std": 5e-5}},
    "held_out": {"quantity": "geometry_rms_px", "before": 1.41, "after": 0.194, "gain": 0.998},
    "rivals": [],
    "p_value": 0.0,
    "figures": ["figures/01_readout_time.png", "../../../secret.png"],
}
DIAGNOSIS = {
    "schema": "virest/diagnosis/1",
    "verdict": "explained",
    "nominal": {"geometry_rms_px": 1.41, "geometry_noise_px": 0.18, "tracks": 10323, "frames": 45},
    "causes": [CAUSE],
    "unexplained": {"p_value": 0.6, "strongest_along": "time"},
    "restoration_gain": {"sharpness_recorded": 6.8, "sharpness_before": 7.8, "sharpness_after": 8.0},
    "extended_profile": "extended.yaml",
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A high-motion capture with a gap in its gyroscope data in ``captures/tiny``, and its run in ``out``."""
    place = tmp_path_factory.mktemp("report")
    capture = place / "captures" / "tiny"
    simulate_command(capture, width=240, height=180, frames=24, exposure_ms=[14.0], rate_rad_s=2.5, seed=5)
    stamp_0 = int((capture / "frame_timestamps.txt").read_text().splitlines()[1].split(",")[0])
    gyro = capture / "gyro_accel.csv"
    head, *rows = gyro.read_text().splitlines(keepends=True)
    kept = [row for row in rows if not HOLE_NS[0] < int(row.partition(",")[0]) - stamp_0 < HOLE_NS[1]]
    gyro.write_text(head + "".join(kept))
    assert cli.run(["process", str(capture), "--out", str(place / "out"), "--jobs", "1", "-q"]) == 0
    return place


@pytest.fixture
def made(finished: Path, tmp_path: Path) -> Path:
    """A copy of ``out/tiny`` for each test; the capture stays where the run found it."""
    shutil.copytree(finished / "out", tmp_path / "out")
    return tmp_path / "out" / "tiny"


@pytest.fixture
def report(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """``report(folder, …)`` returns exit code, standard output and standard error."""

    def run(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = cli.run(["report", *map(str, arguments)])
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def edit(path: Path, **changes: Any) -> None:
    """Change keys of a JSON file."""
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def pictures_of(page: Path) -> list[np.ndarray]:
    """The pictures in a page, RGB, in their order."""
    coded = re.findall(r'<img src="data:image/webp;base64,([^"]*)"', page.read_text())
    data = (np.frombuffer(base64.b64decode(text), np.uint8) for text in coded)
    return [cv2.imdecode(item, cv2.IMREAD_COLOR_RGB).astype(int) for item in data]


def diagnose_into(folder: Path) -> None:
    """Write a diagnosis with a figure into a folder."""
    (folder / "figures").mkdir(parents=True)
    (folder / "diagnosis.json").write_text(json.dumps(DIAGNOSIS))
    (folder / "extended.yaml").write_text("# <b>profile</b>\nvirest_profile: 1\n")
    figure = np.full((80, 120, 3), 200, np.uint8)
    cv2.imwrite(str(folder / "figures" / "residuals.png"), figure)
    cv2.imwrite(str(folder.parent.parent / "secret.png"), figure)


# ── contents of the page ─────────────────────────────────────────────────────────────────────────────────────────


def test_the_page_shows_recorded_and_restored_frames(report, made, finished):
    """The page pairs frames of the movie with frames of the run; the JSON names the frames."""
    code, out, err = report(made, "--json", "--frames", 2)
    facts = json.loads(out)
    (capture,) = facts["captures"]
    assert (code, err) == (0, "")
    assert facts["path"] == str(made / "report.html")
    assert facts["bytes"] == (made / "report.html").stat().st_size
    assert facts["verdict"] == "restored"
    assert facts["counts"] == json.loads((made / "run.json").read_text())["counts"]
    assert facts["counts"]["skipped"] > 2
    movie = finished / "captures" / "tiny" / "movie.mp4"
    pictures = pictures_of(made / "report.html")
    assert len(capture["frames_shown"]) == 2
    for k, frame in enumerate(capture["frames_shown"]):
        ((_, recorded),) = read_frames(movie, probe_movie(movie), frame, frame)
        restored = cv2.imread(str(made / "frames" / f"{frame:06d}.png"), cv2.IMREAD_COLOR_RGB)
        distance = np.abs(restored.astype(int) - recorded).mean()
        assert np.abs(pictures[2 * k] - recorded).mean() < 0.4 * distance
        assert np.abs(pictures[2 * k + 1] - restored).mean() < 0.4 * distance


def test_skipped_frames_are_listed_with_reason_and_range(report, made):
    """The table lists the gap in the gyroscope data with the frames inside it."""
    assert report(made)[0] == 0
    lines = [json.loads(line) for line in (made / "parameters.jsonl").read_text().splitlines()]
    skipped = [line["frame"] for line in lines if line["status"] == "skipped"]
    markup = (made / "report.html").read_text()
    (row,) = re.findall(r'<td data-label="Reason">(falls into the IMU gap.*?)</tr>', markup, re.DOTALL)
    assert f"{skipped[0]}–{skipped[-1]}" in row
    assert f'class="number">{len(skipped)}<' in row


def test_an_existing_page_is_refused_before_any_work_and_replaced_on_request(report, made):
    """Exit 8 without ``--overwrite``, and the old page stays; a folder at the page's path is always refused."""
    (made / "report.html").write_text("old")
    code, out, err = report(made)
    assert (code, out) == (8, "")
    assert "--overwrite" in err
    assert (made / "report.html").read_text() == "old"
    assert report(made, "--overwrite")[0] == 0
    assert report(made, "--out", made)[0] == 8
    assert report(made, "--out", made / "no" / "page.html")[0] == 8
    assert not list(made.glob("*.part"))


def test_a_missing_or_different_movie_is_noted(report, made, finished, tmp_path):
    """Only restored frames are shown then.

    ``--capture`` names the movie's new folder, or the folder that holds the captures.
    """
    edit(
        made / "run.json",
        profile_source="the capture's metadata",
        command="virest process gone/tiny",
        folder=None,
        movie=None,
    )
    code, out, _ = report(made, "--json")
    (capture,) = json.loads(out)["captures"]
    assert code == 0
    assert not capture["recorded_shown"]
    assert "not found" in capture["notes"][0]
    assert "movie was not found" in (made / "report.html").read_text()
    for where in (finished / "captures", finished / "captures" / "tiny"):
        _, out, _ = report(made, "--json", "--overwrite", "--capture", where)
        assert json.loads(out)["captures"][0]["recorded_shown"]
    capture = finished / "captures" / "tiny"
    for known in ({"folder": str(capture)}, {"movie": str(capture / "movie.mp4")}):
        edit(made / "run.json", **known)
        _, out, _ = report(made, "--json", "--overwrite")
        assert json.loads(out)["captures"][0]["recorded_shown"]
    other = tmp_path / "tiny"
    other.mkdir()
    (other / "movie.mp4").write_bytes((finished / "captures" / "tiny" / "movie.mp4").read_bytes()[:-1] + b"x")
    _, out, _ = report(made, "--json", "--overwrite", "--capture", other)
    assert "is not the movie" in json.loads(out)["captures"][0]["notes"][0]


def test_a_diagnosis_is_shown_with_its_run_or_alone(report, made, tmp_path):
    """The page shows verdict, causes and figures of the diagnosis, and no file outside its folder."""
    diagnose_into(made)
    code, out, _ = report(made, "--json", "--frames", 1)
    assert code == 0
    assert json.loads(out)["captures"][0]["causes"] == ["readout_time"]
    assert len(pictures_of(made / "report.html")) == 3
    alone = tmp_path / "elsewhere" / "deeper" / "tiny"
    diagnose_into(alone)
    code, out, _ = report(alone, "--json")
    assert code == 0
    assert json.loads(out)["captures"][0]["verdict"] is None
    markup = (alone / "report.html").read_text()
    assert len(pictures_of(alone / "report.html")) == 1
    assert "14.900 ± 0.050 ms" in markup
    assert "# &lt;b&gt;profile&lt;/b&gt;" in markup


def test_several_captures_make_one_page_with_a_section_each(report, made):
    """For OUT itself the page has a list with links; an unreadable capture is named and the rest is shown (exit 9)."""
    shutil.copytree(made, made.parent / "other")
    edit(made.parent / "other" / "run.json", capture="other")
    assert report(made.parent)[0] == 0
    markup = (made.parent / "report.html").read_text()
    assert re.findall(r'<a href="#(capture-\d)"', markup) == re.findall(r'class="capture" id="([^"]*)"', markup)
    assert markup.count("</bdi></h2>") == 2
    (made.parent / "other" / "run.json").write_text("{")
    code, out, err = report(made.parent, "--overwrite", "--json")
    assert code == 9
    assert [capture["capture"] for capture in json.loads(out)["captures"]] == ["tiny"]
    assert "other" in json.loads(out)["failed"][0]["folder"]
    assert "other/run.json" in err


# ── unusable folders ─────────────────────────────────────────────────────────────────────────────────────────────


def break_by(name: str, folder: Path) -> None:
    """Break a run in one way."""
    run, parameters = folder / "run.json", folder / "parameters.jsonl"
    match name:
        case "no run.json":
            run.unlink()
        case "unfinished":
            run.rename(folder / ".run")
        case "another JSON":
            run.write_text('{"name": "package", "version": "1.0"}')
        case "no object":
            run.write_text("[[1, 2]]")
        case "cut":
            run.write_bytes(run.read_bytes()[:200])
        case "no UTF-8":
            run.write_bytes(b"\xff\xfe{}")
        case "words for counts":
            edit(run, counts={"restored": "many"})
        case "deep":
            run.write_text("[" * 100_000)
        case "a folder":
            run.unlink()
            run.mkdir()
        case "no parameters":
            parameters.unlink()
        case "noise":
            parameters.write_bytes(bytes(range(256)) * 40)
        case "diagnosis of nothing":
            (folder / "diagnosis.json").write_text('{"schema": "other/1"}')


@pytest.mark.parametrize(
    "name",
    ["no run.json", "unfinished", "another JSON", "no object", "cut", "no UTF-8", "words for counts", "deep",
     "a folder", "no parameters", "noise", "diagnosis of nothing"],
)  # fmt: skip
def test_an_unusable_folder_gives_one_line_and_exit_4(report, made, name):
    """No page is written."""
    break_by(name, made)
    code, out, err = report(made)
    assert (code, out) == (4, "")
    assert err.count("\n") == 1
    assert err.startswith("virest: error: ")
    assert not (made / "report.html").exists()


def test_a_truncated_log_gives_a_page_with_a_note(report, made):
    """The last line is incomplete: the page shows the other frames and a note."""
    path = made / "parameters.jsonl"
    path.write_bytes(path.read_bytes()[:-200])
    code, _, err = report(made)
    assert code == 0
    assert "23 of 24 frames; line 24" in err
    assert "23 of 24 frames; line 24" in (made / "report.html").read_text()


def test_extreme_numbers_do_not_break_the_page(report, made):
    """Infinite, huge and missing values are ignored; a line with invalid fields is left out."""
    path = made / "parameters.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    lines[0]["blur"]["tiles"][0].update(length_px=1e308, angle_rad=float("nan"))
    lines[1]["blur"].update(length_px="inf")
    lines[2].update(exposure_s=float("inf"), depth_m="inf", motion=None)
    lines[3]["shutter"].update(max_displacement_px=-1e308)
    lines[4].update(timestamp_ns=10**30)
    lines[5].update(frame=-3)
    lines[6].update(status="<b>")
    path.write_text("\n".join(map(json.dumps, [*lines, {"frame": 24}, []])))
    edit(made / "run.json", profile={"imu": 3, "estimates": [1]}, settings={"a": {"b": [1]}})
    code, _, err = report(made)
    assert code == 0
    assert "21 of 24 frames; line 5 " in err
    assert "1e+308" not in re.sub(r"(?s)data:image[^\"]*", "", (made / "report.html").read_text()).partition("<dl")[0]
    edit(made / "run.json", counts={"restored": 10**15})
    assert report(made, "--overwrite")[0] == 4


def test_a_missing_folder_exits_with_4_and_a_usage_error_with_2(report, tmp_path):
    """An empty folder has nothing to report either."""
    assert report(tmp_path / "nowhere")[0] == 4
    assert report(tmp_path)[0] == 4
    assert report()[0] == 2
    assert report(tmp_path, "--frames", 0)[0] == 2


def test_a_broken_picture_is_left_out(report, made):
    """The other pictures are shown, and a message names the problem."""
    for picture in (made / "frames").iterdir():
        picture.write_bytes(b"no picture")
    code, out, err = report(made, "--json", "--frames", 2)
    assert code == 0
    assert json.loads(out)["captures"][0]["recorded_shown"]
    assert "cannot be read as a picture" in err
    assert len(pictures_of(made / "report.html")) == 2


# ── in a browser ─────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A headless Chromium installed on this machine."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@pytest.fixture
def opened(chromium: Any) -> Iterator[Callable[..., Any]]:
    """``opened(file, …)`` opens a page and collects its requests, errors and dialogs in ``page.complaints``."""
    contexts = []

    def show(file: Path, **settings: Any) -> Any:
        context = chromium.new_context(**{"viewport": DESK, **settings})
        contexts.append(context)
        page = context.new_page()
        page.complaints = []
        asked = ("data:", file.as_uri())
        page.on("request", lambda r: None if r.url.startswith(asked) else page.complaints.append(r.url))
        page.on("console", lambda message: page.complaints.append(message.text))
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.on("dialog", lambda dialog: (page.complaints.append(dialog.message), dialog.dismiss()))
        page.goto(file.as_uri())
        return page

    yield show
    for context in contexts:
        context.close()


def seen(element: Any) -> np.ndarray:
    """A screenshot of an element, RGB."""
    data = np.frombuffer(element.screenshot(), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR_RGB).astype(int)


def test_the_slider_works_by_keyboard_and_the_chooser_by_click(report, made, opened):
    """Home shows the restored frame, End the recorded one; another frame can be selected; the page requests nothing."""
    assert report(made, "--frames", 3)[0] == 0
    page = opened(made / "report.html")
    picture, slider = page.locator("[data-compare]:visible"), page.locator("[data-cut]:visible")
    page.locator("[data-arrows]").uncheck()
    reached = []
    while not reached or ("data-cut" not in reached[-1] and len(reached) < 10):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.getAttributeNames()"))
    assert "data-cut" in reached[-1], reached
    assert [name for names in reached for name in names if name in ("data-full", "data-flicker")] == [
        "data-full",
        "data-flicker",
    ]
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    page.keyboard.press("Home")
    assert slider.input_value() == "0"
    restored = seen(picture)
    page.keyboard.press("End")
    assert slider.get_attribute("aria-valuetext") == "100 percent recorded"
    recorded = seen(picture)
    page.keyboard.press("ArrowLeft")
    assert slider.input_value() == "99"
    inner = np.s_[20:-40, 20:-20]
    assert np.abs(restored - recorded)[inner].mean() > 1.0
    first, second, _ = page.locator("[data-show]").all()
    second.click()
    assert (first.get_attribute("aria-pressed"), second.get_attribute("aria-pressed")) == ("false", "true")
    page.locator("[data-cut]:visible").focus()
    page.keyboard.press("End")
    assert np.abs(seen(picture) - recorded)[inner].mean() > 1.0
    box = picture.bounding_box()
    page.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + 30)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 40)
    page.mouse.up()
    assert abs(int(page.locator("[data-cut]:visible").input_value()) - 25) <= 1
    assert page.complaints == []


def test_arrows_are_drawn_over_the_recorded_picture_until_switched_off(report, made, opened):
    """Yellow strokes appear over the frame and disappear with the switch."""
    assert report(made, "--frames", 1)[0] == 0
    page = opened(made / "report.html")
    page.locator("[data-cut]").fill("100")
    with_arrows = seen(page.locator("[data-compare]"))
    page.locator("[data-arrows]").uncheck()
    without = seen(page.locator("[data-compare]"))
    yellow = np.abs(with_arrows - np.array([255, 226, 107])).sum(axis=-1) < 60
    assert (yellow & (np.abs(with_arrows - without).sum(axis=-1) > 60)).sum() > 40


@pytest.mark.parametrize("viewport", [PHONE, DESK], ids=["phone", "desk"])
def test_nothing_overflows_on_a_phone_or_a_desktop(report, made, opened, viewport):
    """Hostile names and very long words stay text: no dialog, no request, no horizontal scrolling."""
    diagnose_into(made)
    edit(made / "run.json", capture=HOSTILE, verdict=HOSTILE, warnings=[HOSTILE, "endless" * 80], command="x" * 900)
    assert report(made)[0] == 0
    page = opened(made / "report.html", viewport=viewport)
    for fold in page.locator("summary").all():
        fold.click()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.locator("[data-full]").check()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.locator("h1").inner_text() == HOSTILE.replace("\u202e", "\\u202e")
    assert page.locator("img[onerror]").count() == 0
    assert page.complaints == []
    assert seen(page).std() > 10


def test_without_javascript_every_picture_is_shown(report, made, opened):
    """Recorded and restored frames are shown below each other, without controls that have no effect."""
    assert report(made, "--frames", 2)[0] == 0
    page = opened(made / "report.html", viewport=PHONE, java_script_enabled=False)
    boxes = [image.bounding_box() for image in page.locator("figure img").all()]
    assert len(boxes) == 4
    assert all(box and box["width"] > 100 for box in boxes)
    tops = [box["y"] for box in boxes]
    assert tops == sorted(set(tops))
    assert page.locator("input:visible, button:visible").count() == 0


def test_dark_mode_and_print_have_their_own_style(report, made, opened):
    """The page is dark in dark mode; on paper every frame has both pictures and no controls."""
    assert report(made, "--frames", 2)[0] == 0
    light, dark = (opened(made / "report.html", color_scheme=scheme) for scheme in ("light", "dark"))
    assert seen(light)[:20].mean() > 200
    assert seen(dark)[:20].mean() < 60
    light.locator("[data-full]").check()
    light.set_viewport_size({"width": 420, "height": 600})
    light.emulate_media(media="print")
    assert light.locator("input:visible, button:visible").count() == 0
    boxes = [image.bounding_box() for image in light.locator("figure img").all()]
    assert len(boxes) == 4
    assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
    assert boxes[2]["y"] > boxes[0]["y"]
