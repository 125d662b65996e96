"""The settings of a run: the preset, overridden by the file of ``--settings``, then by options."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from virest.camera.yaml_mapping import explain_validation, load_yaml_mapping
from virest.errors import SettingsError
from virest.restoration.settings import (
    DEBLUR_METHODS,
    MOST_NEIGHBOURS,
    PRESETS,
    REFERENCES,
    SHUTTER_METHODS,
    RestorationSettings,
)

_CHOICES: dict[str, tuple[str, ...]] = {
    "preset": tuple(PRESETS),
    "deblur": DEBLUR_METHODS,
    "shutter": SHUTTER_METHODS,
    "reference": REFERENCES,
}
_RANGES: dict[str, dict[str, float]] = {
    "iterations": {"ge": 1, "le": 1000},
    "joined_iterations": {"ge": 1, "le": 1000},
    "inner_iterations": {"ge": 1, "le": 1000},
    "neighbours": {"ge": 0, "le": MOST_NEIGHBOURS},
    "most_joined": {"ge": 0, "le": 2 * MOST_NEIGHBOURS},
    "tile_px": {"ge": 32, "le": 1024},
    "strength": {"gt": 0, "le": 1000},
    "min_blur_px": {"ge": 0, "le": 1000},
}


def _field_type(name: str, kind: Any) -> Any:
    if name in _CHOICES:
        return Literal[_CHOICES[name]]
    if kind in (int, float):
        finite = {"allow_inf_nan": False} if kind is float else {}
        limits: dict[str, Any] = {**_RANGES.get(name, {"ge": 0}), **finite}
        return Annotated[kind, Field(**limits)]
    return kind


@lru_cache(maxsize=1)
def settings_model() -> type[BaseModel]:
    """The file's schema: one optional key for each field of RestorationSettings, and the schema version."""
    hints = get_type_hints(RestorationSettings)
    keys: dict[str, Any] = {name: (_field_type(name, kind) | None, None) for name, kind in hints.items()}
    keys["virest_settings"] = (Literal[1], 1)
    strict = ConfigDict(extra="forbid", strict=True)
    return create_model("_SettingsFile", __config__=strict, **keys)


def read_settings(path: Path) -> dict[str, Any]:
    """The keys that a settings file sets. Raises SettingsError with the file, the key, and the nearest known key."""
    return checked_settings(load_yaml_mapping(path), path.name)


def checked_settings(content: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The keys that are set, within their ranges; ``name`` is used in messages.  Raises SettingsError."""
    model = settings_model()
    try:
        checked = model.model_validate(dict(content))
    except ValidationError as error:
        raise explain_validation(error, model, name) from None
    chosen = checked.model_dump(exclude={"virest_settings"}, exclude_unset=True)
    return {key: value for key, value in chosen.items() if value is not None}


def compose_settings(file: Path | None, **options: Any) -> RestorationSettings:
    """Settings from the preset, overridden by the file, then by options; an option of None is not set."""
    content = read_settings(file) if file else {}
    chosen = {name: value for name, value in options.items() if value is not None}
    if "neighbours" in chosen:
        chosen.setdefault("most_joined", 2 * chosen["neighbours"])
    preset = chosen.get("preset") or content.get("preset") or "balanced"
    if preset not in PRESETS:
        raise SettingsError(f"preset '{preset}' is unknown", hint=f"choose from {', '.join(PRESETS)}")
    return dataclasses.replace(PRESETS[preset], **{**content, **chosen, "preset": preset})
