"""The words of `protocols.toml` on each protocol: light, for the help of commands."""

from __future__ import annotations

import tomllib
from importlib import resources

_TEXT = (resources.files("scopemap_bench") / "protocols.toml").read_text(encoding="utf-8")
PROTOCOL_WORDS: dict[str, dict[str, str]] = tomllib.loads(_TEXT)
"""`description` and `source` of each protocol, by its name."""
