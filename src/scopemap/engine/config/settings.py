"""What all groups of settings have in common, and the named methods that choose a stage's constants."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, field_validator


class Settings(BaseModel):
    """A group of settings: frozen, validated, no unknown key."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class StageSettings(Settings):
    """Settings of a stage whose `constants` follow from `method`.

    A method is one entry of METHODS, or several joined by "+", of which later ones win: "paper+gauss-newton".
    """

    METHODS: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """The constants that each method changes."""
    method: str

    @field_validator("method")
    @classmethod
    def _known(cls, method: str) -> str:
        for name in method.split("+"):
            if name not in cls.METHODS:
                raise ValueError(f"unknown method '{name}': {hint(name, cls.METHODS)}")
        return method


def constants_of(default: Any, methods: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return the field of a stage's constants: `default`, changed by the stage's method; it is no setting."""

    def chosen(validated: dict[str, Any]) -> Any:
        found = default
        for name in validated.get("method", "").split("+"):
            found = replace(found, **methods.get(name, {}))
        return found

    return Field(default_factory=chosen, exclude=True, repr=False)


def hint(wrong: str, names: Mapping[str, Any] | list[str]) -> str:
    """Return the name that was probably meant, as a question; all names where none is similar."""
    near = difflib.get_close_matches(wrong, names, n=1, cutoff=0.3)
    return f"did you mean '{near[0]}'?" if near else f"choose from {', '.join(names)}"
