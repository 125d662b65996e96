"""``virest --man``: a page that roff accepts without a warning and that matches ``--help``."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from virest.app.cli import program
from virest.app.man import EXIT_CODES, man_page

ROOT = Path(__file__).resolve().parents[2]


def plain(roff: str) -> str:
    """The text of a page without its requests."""
    return re.sub(r"^\.[A-Z]+ ?", "", roff, flags=re.MULTILINE).replace("\\-", "-").replace("\\e", "\\")


def commands_of(command: Any, name: str) -> list[tuple[str, Any]]:
    """A command with its path, and its subcommands."""
    own = getattr(command, "commands", {}).items()
    return [(name, command), *(found for inner, sub in own for found in commands_of(sub, f"{name} {inner}"))]


def test_the_page_has_every_command_and_option(virest_here: Any) -> None:
    """Each command has a section with its options and the lines of its examples."""
    done = virest_here("--man")
    assert done.returncode == 0
    sections = dict(zip(*[iter(re.split(r"^\.SS (.*)\n", done.stdout, flags=re.MULTILINE)[1:])] * 2, strict=True))
    sections = {plain(name): plain(text) for name, text in sections.items()}
    found = commands_of(program(), "virest")[1:]
    assert set(sections) == {name for name, _ in found}
    for name, command in found:
        for parameter in command.params:
            for option in (*parameter.opts, *parameter.secondary_opts):
                wanted = option if option.startswith("-") else parameter.metavar or ""
                assert wanted in sections[name], f"{name}: {option}"
        examples = [line for line in (command.help or "").split("\n") if line.startswith("$ ")]
        assert all(line in sections[name] for line in examples), name


def test_exit_codes_are_the_documented_ones() -> None:
    """The page's table matches docs/exit-codes.md."""
    table = re.findall(r"^\| (\d+) \| (.*) \|$", (ROOT / "docs/exit-codes.md").read_text("utf-8"), re.MULTILINE)
    said = [(int(code), re.sub(r" \(.*\)$", "", meaning).replace("`", "")) for code, meaning in table]
    assert said == list(EXIT_CODES)


@pytest.mark.skipif(shutil.which("groff") is None, reason="groff is not installed")
def test_roff_accepts_the_page_without_a_warning() -> None:
    """groff knows every request, and indexers can read the NAME line."""
    page = man_page(program())
    assert re.search(r"^\.SH NAME\nvirest \\- [A-Z]", page, re.MULTILINE)
    done = subprocess.run(
        ["groff", "-ww", "-K", "utf8", "-T", "utf8", "-man"], input=page, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    assert "Undo the lens's distortion" in done.stdout
