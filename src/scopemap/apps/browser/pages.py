"""The pages that a page leads to. They lead to each other: modules that import each other would be a circle."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from scopemap.apps.browser.window import Page
    from scopemap.apps.browser.workspace import Workspace


def start_page(workspace: Workspace) -> Page:
    """Return the first page."""
    return cast("Page", import_module("scopemap.apps.browser.start_page").StartPage(workspace))


def compare_page(first: Path, second: Path, workspace: Workspace | None) -> Page:
    """Return the page that compares two results."""
    return cast("Page", import_module("scopemap.apps.browser.compare_page").ComparePage(first, second, workspace))
