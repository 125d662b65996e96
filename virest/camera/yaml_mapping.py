"""YAML files of bounded size as plain mappings, with error messages that name the key and the nearest known one."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from virest.errors import SettingsError, printable

MAX_PROFILE_BYTES, MAX_DEPTH = 1_000_000, 20
"""A profile has some kilobytes and four levels; the limits stop files that would exhaust the memory or the stack."""
OPENCV_HEAD = re.compile(r"\A\ufeff?%YAML:1\.0[^\n]*")
"""First line of OpenCV's files, which is not a valid YAML directive."""
MAX_DIGITS = 250
"""Numbers of up to this many digits, even hexadecimal or in base 60, fit in a float and in what Python prints."""
NUMERIC = re.compile(r"[-+]?[\d.][\dA-Fa-fxXoO_:.+-]*")


def load_yaml_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping, by ``safe_load``; aliases are refused. Raises SettingsError."""
    try:
        if not path.is_file():
            what = "is not a regular file" if path.exists() else "no such file"
            raise SettingsError(f"{path}: {what}", hint="pass a YAML file")
        size = path.stat().st_size
        if size > MAX_PROFILE_BYTES:
            raise SettingsError(f"{path.name}: {size} bytes, more than {MAX_PROFILE_BYTES}", hint="is it a profile?")
        text = OPENCV_HEAD.sub("", path.read_text(encoding="utf-8"), count=1)
        _require_plain(text, path.name)
        _require_keys_once(yaml.compose(text, Loader=yaml.SafeLoader), path.name)
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "cannot be read"
        raise SettingsError(f"{path.name}:{where} is not plain YAML: {problem}", hint="see docs/profile.md") from None
    except (UnicodeDecodeError, RecursionError):
        raise SettingsError(f"{path.name}: is not YAML text", hint="is it a profile?") from None
    except (ValueError, LookupError, AttributeError, OverflowError):  # raised by yaml for dates and tagged values
        text = f"{path.name}: a value does not match its form, such as an impossible date"
        raise SettingsError(text, hint="write plain numbers and words, see docs/profile.md") from None
    except OSError as error:
        raise SettingsError(f"{path}: {error.strerror}", hint="check the path and its permissions") from None
    if not isinstance(content, dict):
        raise SettingsError(f"{path.name}: no keys at the top level", hint="see docs/profile.md")
    return content


def commented(lines: Iterable[str]) -> str:
    """Lines as comments at the head of a YAML file; line breaks inside become blanks."""
    return "".join(f"# {' '.join(line.split())}\n" for line in lines)


def _require_plain(text: str, name: str) -> None:
    """Refuse aliases, deep nesting and very long numbers before anything is built from them."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise SettingsError(f"{name}: YAML aliases are not accepted", hint="write the values out")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_DIGITS and NUMERIC.fullmatch(event.value):
            shown = f"{event.value[:20]}…"
            raise SettingsError(f"{name}: {shown} has {len(event.value)} digits", hint=f"at most {MAX_DIGITS} allowed")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise SettingsError(f"{name}: nested more than {MAX_DEPTH} deep", hint="is it a profile?")


def _require_keys_once(node: yaml.Node | None, name: str) -> None:
    """Refuse duplicate keys in a block, of which YAML would silently use the last."""
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _require_keys_once(item, name)
    if not isinstance(node, yaml.MappingNode):
        return
    seen: set[str] = set()
    for key, value in node.value:
        if isinstance(key, yaml.ScalarNode):
            if key.value in seen:
                shown = printable(key.value[:60])
                line = key.start_mark.line + 1
                raise SettingsError(f"{name}: line {line}: '{shown}' is written a second time", hint="keep one of them")
            seen.add(key.value)
        _require_keys_once(value, name)


def explain_validation(error: ValidationError, model: type[BaseModel], name: str) -> SettingsError:
    """One line for the first error of a pydantic validation; for an unknown key, with the nearest known one."""
    first = next((e for e in error.errors() if e["type"] == "extra_forbidden"), error.errors()[0])
    path = _key_path(first)
    where = printable(".".join(path))
    if first["type"] == "extra_forbidden":
        known = _keys_at(model, path[:-1])
        near = _nearest(path[-1], known)
        hint = f"did you mean '{near}'?" if near else f"known keys: {', '.join(known)}"
        return SettingsError(f"{name}: unknown key '{where[:80]}', {hint}")
    found = first.get("input")
    value = "" if isinstance(found, dict) else ", got null" if found is None else f", got {str(found)[:60]!r}"
    message = printable(first["msg"].removeprefix("Value error, ").split(" or instance of")[0])[:200]
    return SettingsError(f"{name}: {where or 'top level'}: {message}{value}", hint="see docs/profile.md")


def _key_path(fault: Any) -> list[str]:
    """The keys of a pydantic error's location, without the type names that pydantic inserts."""
    *above, last = map(str, fault["loc"] or ("",))
    forms = ("_", "literal", "function-", "constrained")
    is_key = last and not last.startswith(forms)
    keys = [part for part in above if not part.startswith(forms)]
    return [*keys, last] if is_key or fault["type"] == "extra_forbidden" else keys  # an unknown key has any name


def _nearest(key: str, known: list[str]) -> str | None:
    """The closest known key; a common prefix takes precedence over mere similarity."""
    alike = [k for k in known if k.startswith(key) or key.startswith(k)]
    return next(iter(alike or difflib.get_close_matches(key, known, n=1, cutoff=0.5)), None)


def _keys_at(model: Any, path: list[str]) -> list[str]:
    for part in path:
        found = model.model_fields.get(part)
        if found is None:
            continue
        candidates = [found.annotation, *getattr(found.annotation, "__args__", ())]
        candidates += [inner for c in candidates for inner in getattr(c, "__args__", ())]
        model = next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), model)
    return sorted(model.model_fields)
