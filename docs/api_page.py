"""The page of the interface in Python, docs/api.md, written out from docstrings: `python docs/api_page.py`."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import scopemap
import scopemap_bench

PAGE = Path(__file__).with_name("api.md")
_HEAD = """# In Python

The public names of `scopemap`, with signatures and docstrings; `help(scopemap)` shows the same. Other modules change
with any version. `python docs/api_page.py` writes this page.

```python
{example}
```
"""
_SECTIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "Reconstruct": ("", ("open_sequence", "reconstruct", "Config")),
    "Frame by frame": (
        "With examples and tables: [frame by frame](frame-by-frame.md).",
        ("Reconstructor", "CustomDepth"),
    ),
    "The result": (
        "A finished run is read from its folder. Its `frames` is the table of `frames.csv`: "
        '`Result("result").frames["status"]` is a column.',
        ("Result", "Trajectory", "read_trajectory", "evaluate_poses"),
    ),
    "Ask a result": (
        "Each answers as the command of its name does.",
        ("coverage", "measure", "measure_lesion", "locate"),
    ),
    "Frames": ("", ("Frame",)),
    "Errors": ("", ("ScopemapError",)),
}
_LONGEST = 100


def api_page() -> str:
    """Return docs/api.md: each public name with its signature, its docstring and its public methods."""
    parts = [_HEAD.format(example=_example(scopemap.__doc__ or ""))]
    for title, (words, names) in _SECTIONS.items():
        parts.append(f"\n## {title}\n")
        parts += [f"\n{words}\n"] if words else []
        parts += [_of_name(name, getattr(scopemap, name)) for name in names]
    parts.append("\n## Version\n\n`scopemap.__version__` is that of the installed package.\n")
    parts.append("\n## Phantoms\n\nFrom the second package: `from scopemap_bench import PhantomSpec, write_phantom`.\n")
    parts += [_of_name(name, getattr(scopemap_bench, name)) for name in scopemap_bench.__all__]
    return "".join(parts)


def _example(documented: str) -> str:
    """Return the lines of code of a docstring, imports apart."""
    lines = "\n".join(line[4:] for line in documented.splitlines() if line.startswith((">>> ", "... ")))
    return re.sub(r"^((?:from .*\n)+)", r"\1\n", lines)


def _of_name(name: str, found: Any) -> str:
    """Return the part of the page about a function or a class."""
    text = f"\n### {name}\n{_signature(name, found)}{_described(inspect.getdoc(found) or '')}"
    if inspect.isclass(found):
        text += "".join(_of_member(key, member) for key, member in _members(found))
    return text


def _members(of: type) -> Iterator[tuple[str, Any]]:
    """Yield the public methods and properties of a class and of its bases here, in the order of their source."""
    own = [kind for kind in (of, *of.__bases__) if kind.__module__.startswith("scopemap")]
    for key, member in (item for kind in own for item in vars(kind).items()):
        plain = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        if not key.startswith("_") and (inspect.isfunction(plain) or isinstance(plain, property | cached_property)):
            yield key, plain


def _of_member(key: str, member: Any) -> str:
    documented = _described(inspect.getdoc(member) or "")
    if inspect.isfunction(member):
        return f"\n#### {key}\n{_signature(key, member)}{documented}"
    first, _, rest = documented.strip().partition("\n\n")
    return f"\n`{key}` : {first}\n" + (f"\n{rest}\n" if rest else "")


def _signature(name: str, found: Any) -> str:
    """Return the signature of a function, or of a class's `__init__`, as code; "" where the class has none."""
    made = vars(found).get("__init__") if inspect.isclass(found) else found
    if made is None or not inspect.isfunction(made) or made.__qualname__.startswith("__create_fn__"):
        return ""
    try:
        node = ast.parse(textwrap.dedent(inspect.getsource(made))).body[0]
    except OSError:  # that of a data class, whose attributes its docstring lists
        return ""
    assert isinstance(node, ast.FunctionDef)
    given = _parameters(node.args)
    returned = "" if inspect.isclass(found) or node.returns is None else f" -> {ast.unparse(node.returns)}"
    line = f"{name}({', '.join(given)}){returned}"
    if len(line) > _LONGEST:
        line = f"{name}(\n" + "".join(f"    {one},\n" for one in given) + f"){returned}"
    return f"\n```python\n{line}\n```\n"


def _parameters(arguments: ast.arguments) -> list[str]:
    given = [arg for arg in arguments.args if arg.arg not in ("self", "cls")]
    no_default: list[ast.expr | None] = [None] * (len(given) - len(arguments.defaults))
    texts = [_parameter(*both) for both in zip(given, no_default + list(arguments.defaults), strict=True)]
    texts += ["*"] if arguments.kwonlyargs else []
    return texts + [_parameter(*both) for both in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)]


def _parameter(arg: ast.arg, default: ast.expr | None) -> str:
    return ast.unparse(arg) + ("" if default is None else f" = {ast.unparse(default)}")


def _described(documented: str) -> str:
    """Return a docstring as Markdown: its examples are code, its lists of names are lists."""
    return "".join(f"\n{_paragraph(part)}\n" for part in re.split(r"\n\n+", documented) if part)


def _paragraph(text: str) -> str:
    if text.startswith(">>> "):
        return f"```python\n{_example(text)}\n```"
    lines, title = text.splitlines(), ""
    if len(lines) > 1 and set(lines[1]) == {"-"}:
        title, lines = f"{lines[0]}:\n\n", lines[2:]
    if not re.match(r"\w+(, \w+)* : ", lines[0]):
        return title + " ".join(lines)
    items: list[str] = []
    listed = (part for line in lines for part in re.split(r"(?<=\. )(?=\w+(?:, \w+)* : )", line))
    for line in listed:
        if re.match(r"\w+(, \w+)* : ", line):
            names, _, meaning = line.partition(" : ")
            items.append(f"- `{names}` : {meaning.strip()}")
        else:
            items[-1] += f" {line.strip()}"
    return title + "\n".join(items)


if __name__ == "__main__":
    PAGE.write_text(api_page(), encoding="utf-8")
