"""The README and the program say the same: commands, options, profile and settings keys."""

import re
from pathlib import Path
from typing import Any

import typer
from pydantic import BaseModel

from virest.app.bench import __main__ as bench
from virest.app.cli import app
from virest.app.settings import settings_model
from virest.camera import profile

README = Path(__file__).resolve().parent.parent / "README.md"
TEXT = README.read_text(encoding="utf-8")
COMMANDS: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
OTHER_TOOLS = {"--constraint", "--editable", "--depth", "--branch", "--recursive", "--nthreads"}
"""Options of pip, git and dask that a README may name."""


def options_of(command: Any) -> set[str]:
    """Long options of a command and of its own commands."""
    own = {name for p in command.params for name in (*p.opts, *p.secondary_opts) if name.startswith("--")}
    return own.union(*(options_of(sub) for sub in getattr(command, "commands", {}).values()))


def keys_of(model: type[BaseModel]) -> set[str]:
    """All keys that a pydantic model takes, at any depth."""
    keys: set[str] = set()
    for name, field in model.model_fields.items():
        keys.add(name)
        for kind in (field.annotation, *getattr(field.annotation, "__args__", ())):
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                keys |= keys_of(kind)
    return keys


def code_blocks() -> list[str]:
    """The text inside the README's fences."""
    return re.findall(r"^```[a-z]*\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)


def typed(block: str) -> list[str]:
    """Lines of a fence; of a session only those behind a prompt."""
    lines = block.replace("\\\n", " ").splitlines()
    prompted = [line for line in lines if line.startswith("$ ")]
    return prompted or lines


def shell_lines() -> list[str]:
    """Code of the README that calls virest: lines of fences, and inline code."""
    lines = [line for block in code_blocks() for line in typed(block)]
    prose = re.sub(r"^```.*?^```", "", TEXT, flags=re.MULTILINE | re.DOTALL)
    return [
        line for line in [*lines, *re.findall(r"`([^`\n]+)`", prose)] if re.search(r"(^|[\s|/])virest\s+[a-z-]", line)
    ]


def test_every_command_in_the_readme_exists() -> None:
    """A command and its options, as the README writes them, can be typed."""
    for line in shell_lines():
        for name, rest in re.findall(r"(?:^|[\s|/])virest\s+([a-z][a-z-]*)([^|&;#]*)", line):
            assert name in COMMANDS, f"README: virest {name}"
            unknown = set(re.findall(r"(?<!\S)(--[a-z][a-z-]*)", rest)) - options_of(COMMANDS[name])
            assert not unknown, f"README: virest {name} has no {', '.join(unknown)}"


def test_every_option_in_the_readme_exists() -> None:
    """An option that the README names anywhere belongs to some command, or to the bench."""
    known = set.union(*(options_of(command) for command in COMMANDS.values())) | OTHER_TOOLS | {"--help", "--version"}
    known |= set(re.findall(r'add_argument\(\s*"(--[a-z-]+)"', Path(bench.__file__).read_text(encoding="utf-8")))
    assert not set(re.findall(r"`(--[a-z][a-z-]*)", TEXT)) - known


def test_every_command_is_in_the_readme() -> None:
    """No command is left untold."""
    for name in COMMANDS:
        assert re.search(rf"virest {name}\b", TEXT), name


def test_every_option_of_process_is_in_the_readme() -> None:
    """The main command's options are all explained."""
    missing = {option for option in options_of(COMMANDS["process"]) if not re.search(rf"{option}(?![a-z-])", TEXT)}
    assert not missing


def test_every_profile_and_settings_key_is_in_the_readme() -> None:
    """A key that a YAML file may hold is named in the README."""
    keys = keys_of(profile._Profile) | keys_of(settings_model())
    assert not {key for key in keys if not re.search(rf"\b{re.escape(key)}\b", TEXT)}


def test_every_key_of_the_readmes_profile_exists() -> None:
    """A YAML block of the README that shows a profile or settings names only known keys."""
    known = keys_of(profile._Profile) | keys_of(settings_model())
    for block in code_blocks():
        if not re.search(r"^virest_(profile|settings):", block, re.MULTILINE):
            continue
        bare = re.sub(r"#.*", "", block)
        inside = re.sub(r"^estimates:.*(\n\s+.*)*", "estimates:", bare, flags=re.MULTILINE)
        assert not set(re.findall(r"(?:^\s*|[{,]\s*)([A-Za-z_]\w*):", inside, re.MULTILINE)) - known
