"""What all groups of settings have in common, advanced settings, and the named methods that choose these."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

Share = Annotated[float, Field(ge=0, le=1)]
Methods = Mapping[str, Mapping[str, Any]]
"""The methods of a stage by name, each with the advanced settings that it changes."""


class Settings(BaseModel):
    """A group of settings: frozen, validated, no unknown key."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def sources(cls) -> dict[str, str]:
        """Return the advanced settings by name, with where their defaults come from."""
        extras = {name: field.json_schema_extra for name, field in cls.model_fields.items()}
        return {name: str(extra["source"]) for name, extra in extras.items() if isinstance(extra, dict)}


class StageSettings(Settings):
    """Settings of a stage, whose `method` chooses its advanced ones where these are not given themselves.

    A method is one entry of METHODS, or several joined by "+", of which later ones win: "paper+least-squares". One that
    changes no advanced setting is asked for by `has`, where the stage leaves a part out.
    """

    METHODS: ClassVar[Methods] = {}
    method: str

    def has(self, method: str) -> bool:
        """Return whether a method is the stage's, or one of those that are joined."""
        return method in self.method.split("+")

    @model_validator(mode="before")
    @classmethod
    def _of_method(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        chosen: dict[str, Any] = {}
        for name in str(given.get("method", cls.model_fields["method"].default)).split("+"):
            chosen |= cls.METHODS.get(name, {})
        return chosen | given

    @field_validator("method")
    @classmethod
    def _known(cls, method: str) -> str:
        for name in method.split("+"):
            if name not in cls.METHODS:
                raise ValueError(f"unknown method '{name}': {hint(name, cls.METHODS)}")
        return method


def advanced(default: Any, description: str, source: str) -> Any:
    """Return the field of an advanced setting: few users need it. `source` says where its default comes from."""
    return Field(default, description=description, json_schema_extra={"source": source})


def hint(wrong: str, names: Mapping[str, Any] | list[str]) -> str:
    """Return the name that was probably meant, as a question; all names where none is similar."""
    near = difflib.get_close_matches(wrong, names, n=1, cutoff=0.3)
    return f"did you mean '{near[0]}'?" if near else f"choose from {', '.join(names)}"
