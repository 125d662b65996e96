"""Published figures are those that the program prints: marked blocks, and the prose that repeats them."""

from __future__ import annotations

import inspect
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from documentation import DOCS, PAGES, README, ROOT, name_of, read
from fork_server import ForkServer

from virest import __version__
from virest.app import pages
from virest.app.cli import program
from virest.app.gallery import gallery_page

BLOCKS = [block for page in PAGES for block in pages.blocks(page)]
MOST_S = {README: 30.0}
"""CPU time of the sessions that the tests run, by page; of other pages OTHERS_S."""
OTHERS_S = 4.0
SESSIONS = [block for block in BLOCKS if block.took_s is not None and block.took_s <= MOST_S.get(block.page, OTHERS_S)
            and not any("-m virest.app.bench" in command for command in block.commands)]  # fmt: skip
"""Blocks that the tests run. Longer ones and benches are left to `make readme`."""
WITHOUT_INPUT = ("import", "doctor")
"""Commands without an input in the repository: a bag, the machine."""
GALLERY = DOCS / "gallery.md"
"""Written completely by `make figures`."""
FIGURE = re.compile(
    r"([-+−]?\d[\d,.]*)(?:(?:\s(?:to|and|or)\s|–)([-+−]?\d[\d,.]*))?\s?(?:dB|px|frames/s|°|mm|MB|%)(?!\w)"
)
SETTINGS = {
    "0.1 dB": "MIN_GAIN_DB: the least gain by the spectra for which frames are deblurred",
    "0.5 dB": "LEAST_CONFIRMED_DB: the least predicted gain for which frames are deblurred",
    "0.05 dB": "bench --compare: what counts as a change",
    "30 px": "the spacing of tracked points",
    "1 px": "the default radius of simulate --sharpen",
    "8 px": "calibrate-curve: how far stills are aligned",
    "128 px": "LEAST_POCKETFFT_PX",
    "2 px": "evaluate deblur: a match that counts as correct",
    "16 px": "evaluate deblur: the border that is left out",
    "16,384 px": "the largest side of a picture",
    "40 million px": "the largest picture",
    "256 MB": "the largest block that FFmpeg gets",
    "1 MB": "the largest profile",
    "100 %": "of the error that is recorded, by definition",
    "15 %": "bench --compare: what counts as a change of time",
    "5 %": "the same of memory",
    "10 %": "the deviation below which a scale of travel is taken; an example in the FAQ",
    "6 MB": "a report's pages",
}
"""Settings and limits of the program with their meanings, which are not measurements."""
FROM_PAPERS = {"0.02°": "Ye et al. 2026, doi:10.3390/s26041189, Table 2", "0.21°": "the same, its baseline"}


def label(block: pages.Block) -> str:
    """Page and last command of a block."""
    return f"{name_of(block.page)}: {block.commands[-1].splitlines()[0][:60]}"


def test_every_mark_belongs_to_a_block() -> None:
    """No comment is mistyped: each block that begins also ends, and is found."""
    for mark in ("figures", "end"):
        assert sum(len(re.findall(rf"^<!-- {mark}:", read(page), re.MULTILINE)) for page in PAGES) == len(BLOCKS) > 20


@pytest.mark.parametrize("block", BLOCKS, ids=label)
def test_a_block_was_printed_by_this_version(block: pages.Block) -> None:
    """Published figures are those of this version; `make readme` updates them."""
    if block.took_s is None and block.needs:
        assert not block.output, "the block shows figures that no run of this command wrote"
        pytest.skip(f"shows no figures yet: needs {', '.join(block.needs)}")
    assert block.version == __version__
    assert block.output.strip(), "the block was never run"


@pytest.mark.scenario
@pytest.mark.skipif(shutil.which("jq") is None, reason="some blocks pipe into jq")
@pytest.mark.parametrize("block", SESSIONS, ids=label)
def test_a_session_prints_what_the_page_shows(
    block: pages.Block, fork_server: ForkServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commands of a block run in an empty folder; clock times and last digits may differ.

    Commands of the README are started as a reader starts them; the others are forked.
    """
    if block.page != README:
        for name, value in fork_server.shell_function().items():
            monkeypatch.setenv(name, value)
    assert not pages.differences(block.session, pages.rerun(block)[0])


def helps(command: Any) -> Iterator[str]:
    """Help texts of all commands, including subcommands."""
    for name, inner in getattr(command, "commands", {}).items():
        if name not in WITHOUT_INPUT:
            yield inner.help or ""
            yield from helps(inner)


def quotes(session: str) -> list[str]:
    """The printed lines of a session in a help text, each up to an omission (...)."""
    outputs = "".join(output for _, output in pages.steps(inspect.cleandoc(session)))
    lines = [line.partition("...")[0] for line in outputs.splitlines()]
    return [" ".join(line.split()) for line in lines if line.strip()]


QUOTED = [(part.split("\n")[0], quotes(part)) for text in helps(program())
          for part in text.split("\b\n")[1:] if quotes(part)]  # fmt: skip


@pytest.mark.parametrize(("first", "lines"), QUOTED, ids=[first.strip() for first, _ in QUOTED])
def test_help_shows_what_the_pages_show(first: str, lines: list[str]) -> None:
    """A session of `--help` is an excerpt of a block: some page shows all its output."""
    shown = "\n".join(" ".join(line.split()) for block in BLOCKS for line in block.session.splitlines())
    assert not [line for line in lines if f"\n{line}" not in shown]


# ── figures in prose ─────────────────────────────────────────────────────────────────────────────────────────────


def sections(page: Path) -> Iterator[tuple[list[str], list[pages.Block]]]:
    """Pieces of prose under one heading (paragraphs, list items, table rows), and the blocks there."""
    for part in re.split(r"^(?=#)", read(page), flags=re.MULTILINE):
        here = [block for block in BLOCKS if block.page == page and block.session in part]
        bare = re.sub(r"^```.*?^```", "", pages.BLOCK.sub("", part), flags=re.MULTILINE | re.DOTALL)
        yield re.split(r"\n\s*\n|\n(?=\s*[-*|\d]+\.?\s)|\n(?=\|)", bare), here


def named(piece: str) -> list[pages.Block]:
    """Blocks of the commands that a piece of prose names."""
    codes = [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", piece)]
    return [block for block in BLOCKS if any(code in block.commands for code in codes)]


def required(piece: str) -> str:
    """Sources of the tests that a piece of prose names."""
    return "\n".join(read(ROOT / path) for path in re.findall(r"tests/\S+?\.py", piece))


def printed(number: str, output: str) -> bool:
    """Whether an output has this number, rounded to its digits; signs are words in prose."""
    wanted, half = abs(pages.value(number)), 0.5001 * pages.last_digit(number)
    return any(abs(abs(pages.value(found[0])) - wanted) <= half for found in pages.NUMBER.finditer(output))


@pytest.mark.parametrize("page", [page for page in PAGES if page != GALLERY], ids=name_of)
def test_a_figure_in_prose_is_printed_by_a_block(page: Path) -> None:
    """A figure outside a block repeats one of a block in its section or of a command named beside it."""
    for pieces, here in sections(page):
        for piece in pieces:
            output = "\n".join([*(block.output for block in [*here, *named(piece)]), required(piece)])
            for figure in FIGURE.finditer(piece):
                if figure[0] in {**SETTINGS, **FROM_PAPERS}:
                    continue
                unknown = [number for number in figure.groups() if number and not printed(number.rstrip(".,"), output)]
                assert not unknown, f"{name_of(page)}: {figure[0]!r} in {' '.join(piece.split())[:160]!r}"


def test_the_gallery_is_generated_from_its_results() -> None:
    """The page is the one that `make figures` makes from the results beside its pictures, with no typed figure."""
    results = json.loads((DOCS / "images" / "gallery" / "results.json").read_text("utf-8"))
    assert read(GALLERY) == gallery_page(results)


@pytest.mark.parametrize(
    ("prose", "found"),
    [
        ("9.5 px", True),
        ("9.46 px", True),
        ("9.47 px", False),
        ("−9 px", True),
        ("8 to 9 px", False),
        ("9 to 9.5 px", True),
    ],
)
def test_a_figure_matches_as_rounded(prose: str, found: bool) -> None:
    """All digits that are shown must be the block's."""
    numbers = [number for number in FIGURE.search(prose).groups() if number]
    assert all(printed(number, "blur 9.459 px, at 12 s") for number in numbers) == found


# ── the tool itself ──────────────────────────────────────────────────────────────────────────────────────────────

PAGE = """# A page

<!-- figures: new -->
```console
$ echo "capture  frames/s"; echo "walk          {rate}"
$ printf 'one\\ntwo\\n' \\
    | tail -1   # the last
```
<!-- end: virest 0.0.0 -->

The end.
"""


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """A page with one block that was never run."""
    path = tmp_path / "page.md"
    path.write_text(PAGE.replace("{rate}", "2.5"))
    return path


def test_a_block_is_run_and_written(page: Path) -> None:
    """Commands stay as they are, new output replaces the old, and the machine is given below speeds."""
    pages.main([str(page)])
    text = page.read_text()
    block = next(pages.blocks(page))
    assert block.version == __version__
    assert block.output == "capture  frames/s\nwalk          2.5\ntwo\n"
    assert block.commands[1] == "printf 'one\\ntwo\\n' \\\n    | tail -1   # the last"
    assert re.search(r"^\*.* cores?\*$", text, re.MULTILINE)
    assert text.startswith("# A page\n")
    assert text.endswith("\n\nThe end.\n")
    before = page.read_bytes()
    assert pages.main([str(page), "--check"]) == 0
    assert page.read_bytes() == before


def test_an_outdated_page_is_found(page: Path) -> None:
    """Another speed does not make a page outdated; another word does."""
    pages.main([str(page)])
    page.write_text(page.read_text().replace('"walk          2.5"', '"walk          9.9"'))
    assert pages.main([str(page), "--check"]) == 0
    page.write_text(page.read_text().replace("'one\\ntwo\\n'", "'one\\nthree\\n'"))
    assert pages.main([str(page), "--check"]) == 1


def test_a_failing_command_does_not_change_the_page(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """If a command fails, the page stays as it is, and the error gives the exit code."""
    page.write_text(page.read_text().replace("| tail -1", "| false"))
    before = page.read_bytes()
    assert pages.main([str(page)]) == 1
    assert "exit code 1" in capsys.readouterr().err
    assert page.read_bytes() == before


@pytest.mark.parametrize(
    ("shown", "now", "same"),
    [
        ("residual 0.254 px, 2568 tracks", "residual 0.255 px, 2570 tracks", True),
        ("residual 0.254 px", "residual 0.354 px", False),
        ("12 restored in 4.2 s", "12 restored in 9.2 s", True),
        ("12 restored", "11 restored", False),
        ("verdict: consistent", "verdict: explained", False),
        ("std 4.3e-05", "std 4.4e-05", True),
        ("std 4.3e-05", "std 4.3e-04", False),
        ("a  1", "a    1", True),
    ],
)
def test_equal_outputs_are_recognised(shown: str, now: str, same: bool) -> None:
    """Clock times are ignored, last digits may differ, words and counts may not."""
    assert bool(pages.differences(shown, now)) != same
