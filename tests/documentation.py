"""The README and docs/ as the tests read them: pages, fences, sessions, links and headings."""

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
    """One fenced block: the page, its language, its text."""

    page: Path
    language: str
    text: str


def read(page: Path) -> str:
    """A page's text."""
    return page.read_text(encoding="utf-8")


def name_of(page: Path) -> str:
    """A page's path below the repository."""
    return page.relative_to(ROOT).as_posix()


def fences(page: Path) -> list[Fence]:
    """Fenced blocks of a page."""
    found = re.findall(r"^```([a-z]*)\n(.*?)^```", read(page), re.MULTILINE | re.DOTALL)
    return [Fence(page, language, text) for language, text in found]


def prose(page: Path) -> str:
    """The page without its fences."""
    return re.sub(r"^```.*?^```", "", read(page), flags=re.MULTILINE | re.DOTALL)


def typed_lines(fence: Fence) -> list[str]:
    """What a reader would type: of a session only the lines behind a prompt, of a script all of them."""
    lines = fence.text.replace("\\\n", " ").splitlines()
    prompted = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    return prompted or ([] if fence.language == "console" else lines)


def links(page: Path) -> list[str]:
    """Targets of links and pictures of a page, other hosts' left out."""
    found = re.findall(r"\]\(([^)\s]+)\)", prose(page))
    return [target for target in found if not re.match(r"[a-z]+:", target)]


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    words = [re.sub(r"[^\w\- ]", "", heading.lower().replace("`", "")) for heading in headings]
    return {re.sub(r" +", "-", word.strip()) for word in words}
