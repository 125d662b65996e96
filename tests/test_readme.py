"""README, documentation and program agree on commands, options, keys, links and examples."""

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from documentation import DOCS, PAGES, README, ROOT, anchors, fences, links, name_of, prose, read, typed_lines
from pydantic import BaseModel

from virest import __version__
from virest.app import pages
from virest.app.bench import __main__ as bench
from virest.app.cli import app
from virest.app.gallery import CASES
from virest.app.settings import settings_model
from virest.camera import profile_schema
from virest.effects.table import EFFECTS

TEXT = "\n".join(map(read, PAGES))
PROGRAM: Any = typer.main.get_command(app)
COMMANDS: dict[str, Any] = PROGRAM.commands
OTHER_TOOLS = {"--constraint", "--editable", "--depth", "--branch", "--recursive", "--nthreads", "--array"}
"""Options of pip, git, dask and Slurm that a page may name."""
MOST_BYTES = 8192
LINE = 132
"""Longest entry of the changelog, in characters: a line of a wide terminal."""
SHELL = ("", "sh", "console")


def options_of(command: Any) -> set[str]:
    """Long options of a command and its subcommands."""
    own = {name for p in command.params for name in (*p.opts, *p.secondary_opts) if name.startswith("--")}
    return own.union(*(options_of(sub) for sub in getattr(command, "commands", {}).values()))


def keys_of(model: type[BaseModel]) -> set[str]:
    """All keys of a pydantic model, at any depth."""
    keys: set[str] = set()
    for name, field in model.model_fields.items():
        keys.add(name)
        for kind in (field.annotation, *getattr(field.annotation, "__args__", ())):
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                keys |= keys_of(kind)
    return keys


def calls(page: Path) -> list[str]:
    """Calls of virest in a page's fences, without pipes, redirections and comments."""
    lines = [line for fence in fences(page) if fence.language in SHELL for line in typed_lines(fence)]
    found = [re.search(r"(?:^|[\s|/])(virest [a-z].*)", line) for line in lines]
    return [re.split(r"\s[|&;#>]|\s:::|\s\|\|", match.group(1))[0] for match in found if match]


def inline_calls(page: Path) -> list[str]:
    """Inline code that names a command of virest."""
    return [code for code in re.findall(r"`([^`\n]+)`", prose(page)) if re.match(r"virest [a-z]", code)]


def test_the_readme_is_short() -> None:
    """A reader needs a few minutes for the README; everything else is in docs/."""
    assert len(README.read_bytes()) <= MOST_BYTES


def test_the_changelog_has_one_line_per_change() -> None:
    """It has the form of Keep a Changelog, newest first, above the first version 0.1.0."""
    recent, _, _ = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").partition("## [0.1.0]")
    lines = [line for line in recent.splitlines() if line][3:]
    heads = [line for line in lines if line.startswith("#")]
    assert heads[0] == "## [Unreleased]"
    assert {head for head in heads if head.startswith("### ")} <= {"### Added", "### Changed", "### Fixed"}
    assert not [line for line in lines if not line.startswith(("- ", "#")) or len(line) > LINE]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_example_is_accepted_by_the_parser(page: Path) -> None:
    """The program's own parser accepts every call of virest shown on a page."""
    for call in calls(page):
        filled = re.sub(r'("?)\$(?:\(\([^)]*\)\)|[A-Z_]+)', r"\g<1>1", call)
        words = shlex.split(filled)[1:]
        with PROGRAM.make_context("virest", list(words)) as context:
            name, command, rest = context.command.resolve_command(context, [*context._protected_args, *context.args])
            while hasattr(command, "commands"):
                name, command, rest = command.resolve_command(context, rest)
            with command.make_context(name, list(rest), parent=context):
                pass


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_command_named_in_the_text_exists(page: Path) -> None:
    """Inline code names existing commands and options."""
    for call in inline_calls(page):
        words = call.split()
        assert words[1] in COMMANDS, f"{name_of(page)}: {call}"
        unknown = set(re.findall(r"(?<!\S)(--[a-z][a-z-]*)", call)) - options_of(COMMANDS[words[1]]) - OTHER_TOOLS
        assert not unknown, f"{name_of(page)}: {call}: {unknown}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_option_named_in_the_text_exists(page: Path) -> None:
    """An option on a page belongs to a command, to the program, to the bench, or to `make readme`."""
    known = options_of(PROGRAM) | OTHER_TOOLS | {"--help", "--version", "--install-completion", "--show-completion"}
    for tool in (bench, pages):
        known |= set(
            re.findall(r'add_argument\(\s*"(--[a-z-]+)"', Path(str(tool.__file__)).read_text(encoding="utf-8"))
        )
    assert not set(re.findall(r"`(--[a-z][a-z-]*)", prose(page))) - known


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_has_its_page_with_every_option(name: str) -> None:
    """A command has its own page, linked from the README, that names each option."""
    page = DOCS / "commands" / f"{name}.md"
    assert f"docs/commands/{name}.md" in read(README)
    shared = {"--json", "--quiet", "--verbose", "--version", "--help"}
    missing = {o for o in options_of(COMMANDS[name]) - shared if not re.search(rf"{o}(?![a-z-])", read(page))}
    assert not missing


def test_every_profile_and_settings_key_is_documented() -> None:
    """The page on profiles names every key allowed in a YAML file."""
    page = read(DOCS / "profile.md")
    keys = keys_of(profile_schema.ProfileFile) | keys_of(settings_model())
    assert not {key for key in keys if not re.search(rf"\b{re.escape(key)}\b", page)}


def test_every_effect_is_documented_and_in_the_gallery() -> None:
    """Each effect has a line in the profile's table, and each case a section in the gallery."""
    for name in EFFECTS:
        assert f"| `{name}` |" in read(DOCS / "profile.md")
    for name in CASES:
        assert re.search(rf"^## {name}$", read(DOCS / "gallery.md"), re.MULTILINE), name


def test_every_key_of_a_shown_profile_exists() -> None:
    """A YAML block with a profile or settings has only known keys."""
    known = keys_of(profile_schema.ProfileFile) | keys_of(settings_model())
    for fence in (fence for page in PAGES for fence in fences(page)):
        if not re.search(r"^virest_(profile|settings):", fence.text, re.MULTILINE):
            continue
        bare = re.sub(r"#.*", "", fence.text)
        inside = re.sub(r"^estimates:.*(\n\s+.*)*", "estimates:", bare, flags=re.MULTILINE)
        assert not set(re.findall(r"(?:^\s*|[{,]\s*)([A-Za-z_]\w*):", inside, re.MULTILINE)) - known


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_no_link_is_dead(page: Path) -> None:
    """A link or picture leads to a file of the repository, and to a heading in it."""
    for target in links(page):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.is_file(), f"{name_of(page)}: {target}"
        assert not anchor or anchor in anchors(file), f"{name_of(page)}: {target}"


def test_the_site_lists_every_page() -> None:
    """mkdocs.yml lists each page once, and no missing page."""

    def leaves(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        return [leaf for child in (node.values() if isinstance(node, dict) else node) for leaf in leaves(child)]

    listed = leaves(yaml.safe_load((ROOT / "mkdocs.yml").read_text("utf-8"))["nav"])
    assert sorted(listed) == sorted(page.relative_to(DOCS).as_posix() for page in PAGES if page != README)


def test_every_picture_of_the_site_is_shown() -> None:
    """docs/ has no picture that no page shows."""
    shown = {(page.parent / target).resolve() for page in PAGES for target in links(page)}
    assert not {file for file in DOCS.rglob("*.png") if file.resolve() not in shown}


def test_the_citation_names_this_version() -> None:
    """CITATION.cff repeats the package's version, since citation tools do not look in the package."""
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))["version"] == __version__


def test_the_containers_extras_exist() -> None:
    """pip only warns about a missing extra, and the image would lack it."""
    offered = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    asked = re.findall(r"'\.\[([\w,]+)\]'", (ROOT / "Dockerfile").read_text("utf-8"))
    assert len(asked) == 1
    assert set(asked[0].split(",")) <= set(offered)
