"""What colours mean, as HTML of the panel."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

_STYLE = "font-size:13px;line-height:1.5;margin:2px 8px"
_BOX = "display:inline-block;width:12px;height:12px;margin-right:6px;vertical-align:-1px;background:"


def words_html(colours: Mapping[str, str]) -> str:
    """Return a legend of colours "#rrggbb" by their words, one a line."""
    lines = (
        f'<div><span style="{_BOX}{colour}"></span>{html.escape(words)}</div>' for words, colour in colours.items()
    )
    return f'<div style="{_STYLE}">{"".join(lines)}</div>'


def ramp_html(title: str, stops: Sequence[str], numbers: Sequence[str]) -> str:
    """Return a bar of colours "#rrggbb" from left to right, with its title above and numbers, evenly spaced, below."""
    bar = f'<div style="height:12px;background:linear-gradient(to right,{",".join(stops)})"></div>'
    below = "".join(f"<span>{html.escape(number)}</span>" for number in numbers)
    row = f'<div style="display:flex;justify-content:space-between">{below}</div>'
    return f'<div style="{_STYLE}"><div>{html.escape(title)}</div>{bar}{row}</div>'
