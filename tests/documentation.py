"""The README and docs/ as read by the tests: pages, fences, sessions, links and headings."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
DOCS = ROOT / "docs"
PAGES = [README, *sorted(DOCS.rglob("*.md"))]


@dataclass(frozen=True)
class Fence:
    """One fenced block: its page, language and text."""

    page: Path
    language: str
    text: str


def read(page: Path) -> str:
    """The text of a page."""
    return page.read_text(encoding="utf-8")


def name_of(page: Path) -> str:
    """Path of a page in the repository."""
    return page.relative_to(ROOT).as_posix()


def fences(page: Path) -> list[Fence]:
    """Fenced blocks of a page."""
    found = re.findall(r"^```([a-z]*)\n(.*?)^```", read(page), re.MULTILINE | re.DOTALL)
    return [Fence(page, language, text) for language, text in found]


def prose(page: Path) -> str:
    """The page without its fences."""
    return re.sub(r"^```.*?^```", "", read(page), flags=re.MULTILINE | re.DOTALL)


def typed_lines(fence: Fence) -> list[str]:
    """Lines that a reader would type: those after a prompt in a session, all lines of a script."""
    lines = fence.text.replace("\\\n", " ").splitlines()
    prompted = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    return prompted or ([] if fence.language == "console" else lines)


def links(page: Path) -> list[str]:
    """Targets of the links and pictures of a page, without those on other hosts."""
    found = re.findall(r"\]\(([^)\s]+)\)", prose(page))
    return [target for target in found if not re.match(r"[a-z]+:", target)]


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as made by GitHub and mkdocs."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    words = [re.sub(r"[^\w\- ]", "", heading.lower().replace("`", "")) for heading in headings]
    return {re.sub(r" +", "-", word.strip()) for word in words}
