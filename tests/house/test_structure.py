"""Rules that are read off the tree: sizes, imports, names, words, what is documented and typed.

Which package may import which: the contracts of import-linter in pyproject.toml.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import median, quantiles

import pytest

import scopemap
from tests.support.places import ROOT

SOURCE = ROOT / "src" / "scopemap"
NETWORKS = {"torch", "torchvision", "transformers", "huggingface_hub", "safetensors", "lpips"}
ADAPTERS = ("engine/depth/", "engine/flow/raft.py", "engine/models/")
FORBIDDEN_NAMES = {"utils", "util", "common", "core", "helpers", "base", "misc"}
ENDINGS = ("print", "exit", "quit", "sys.exit", "os._exit")
Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class _Module:
    path: Path
    text: str

    @cached_property
    def tree(self) -> ast.Module:
        return ast.parse(self.text)

    @cached_property
    def nodes(self) -> list[ast.AST]:
        return list(ast.walk(self.tree))

    @property
    def lines(self) -> int:
        return len(self.text.splitlines())

    @property
    def name(self) -> str:
        return self.path.relative_to(SOURCE).as_posix() if self.path.is_relative_to(SOURCE) else self.path.name

    @property
    def is_command(self) -> bool:
        """Whether it is part of the command line, which prints and exits."""
        return self.name.startswith(("cli/", "terminal/")) or self.name.endswith("command.py")

    def functions(self) -> Iterator[Function]:
        return (node for node in self.nodes if isinstance(node, Function))

    def at(self, node: ast.AST) -> str:
        return f"{self.name}:{node.lineno} {getattr(node, 'name', '')}".strip()  # type: ignore[attr-defined]


BENCH = ROOT / "bench" / "src"


def _read(path: Path) -> _Module:
    return _Module(path, path.read_text())


MODULES = [_read(path) for path in sorted(SOURCE.rglob("*.py"))]
TESTS = [_read(path) for path in sorted((ROOT / "tests").rglob("*.py"))]
BENCH_MODULES = [_read(path) for path in sorted(BENCH.rglob("*.py"))]
OTHERS = BENCH_MODULES + [
    _read(path) for name in ("examples", "training") for path in sorted((ROOT / name).rglob("*.py"))
]


def _is_command(function: Function) -> bool:
    return "typer." in ast.unparse(function.args)


def _is_typed_by_use(function: Function) -> bool:
    """Whether numba compiles it for the types that it meets, and a docstring says what these are."""
    return _is_kernel(function, "njit", "kernel", "inner_kernel") and ast.get_docstring(function) is not None


def _is_kernel(function: Function, *kinds: str) -> bool:
    return any(re.match(rf"({'|'.join(kinds)})\b", ast.unparse(one)) for one in function.decorator_list)


def _lines(function: Function) -> int:
    """Lines of code: without the docstring, and for a command without its table of options."""
    body = function.body
    first = body[0].lineno if _is_command(function) else function.lineno
    documented = ast.get_docstring(function, clean=False) is not None
    docstring = body[0].end_lineno - body[0].lineno + 1 if documented else 0  # type: ignore[operator]
    return function.end_lineno - first + 1 - docstring  # type: ignore[operator]


def _parameters(function: Function) -> list[ast.arg]:
    arguments = function.args
    return [a for a in arguments.posonlyargs + arguments.args + arguments.kwonlyargs if a.arg not in ("self", "cls")]


def _imported(module: _Module) -> Iterator[tuple[str, ast.AST]]:
    """Every module that is imported, wherever in the file; `from scopemap import x` counts as scopemap.x."""
    for node in module.nodes:
        if isinstance(node, ast.Import):
            yield from ((alias.name, node) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module == "scopemap":
            yield from ((f"scopemap.{alias.name}", node) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module.at(node)}: imports are absolute here"
            yield str(node.module), node


def _none(faults: list[str]) -> None:
    assert not faults, "\n" + "\n".join(faults)


# ---- sizes


def test_files_are_short() -> None:
    _none([f"{m.path.name}: {m.lines} lines" for m in [*MODULES, *BENCH_MODULES, *TESTS, *OTHERS] if m.lines > 400])


def test_the_median_file_is_short() -> None:
    assert median(module.lines for module in MODULES if module.path.name != "__init__.py") <= 180


def test_functions_are_short() -> None:
    sizes = [(_lines(function), module.at(function)) for module in MODULES for function in module.functions()]
    _none([f"{where}: {size} lines" for size, where in sizes if size > 60])
    assert quantiles([size for size, _ in sizes], n=10)[-1] <= 30
    assert median(size for size, _ in sizes) <= 12


def test_functions_take_few_parameters() -> None:
    functions = [(module, function) for module in MODULES for function in module.functions()]
    many = [(m, f) for m, f in functions if len(_parameters(f)) > 7 and not (m.is_command and _is_command(f))]
    _none([f"{module.at(function)}: {len(_parameters(function))} parameters" for module, function in many])


def test_no_function_takes_keywords_it_does_not_name() -> None:
    """Wrappers pass on those of what they wrap."""
    taking = [(module, f) for module in MODULES for f in module.functions() if f.args.kwarg is not None]
    wrappers = [any("wraps(" in ast.unparse(decorator) for decorator in f.decorator_list) for _, f in taking]
    _none([module.at(f) for (module, f), wraps in zip(taking, wrappers, strict=True) if not wraps])


def _functions(module: _Module, *kinds: str) -> list[Function]:
    return [function for function in module.functions() if _is_kernel(function, *kinds)]


def test_only_kernels_call_inner_kernels() -> None:
    """Numba compiles no way into them from Python: a call would end the process."""
    inner = {(module.path.stem, f.name) for module in MODULES for f in _functions(module, "inner_kernel")}
    assert inner
    faults = []
    # Most modules name none of them, and are not parsed.
    named = re.compile("|".join(rf"\b{name}\b" for _, name in sorted(inner)))
    for module in (module for module in [*MODULES, *TESTS, *OTHERS] if named.search(module.text)):
        known = {f.name for f in _functions(module, "inner_kernel")}
        for node in module.nodes:
            if isinstance(node, ast.ImportFrom):
                stem = str(node.module).rsplit(".", 1)[-1]
                known |= {alias.name for alias in node.names if (stem, alias.name) in inner}
        allowed = {node for f in _functions(module, "kernel", "inner_kernel") for node in ast.walk(f)}
        for node in module.nodes:
            if isinstance(node, ast.Attribute) and node.attr == "py_func":
                allowed.add(node.value)
            elif isinstance(node, ast.Name) and node.id in known and node not in allowed:
                faults.append(f"{module.at(node)}: {node.id} is for kernels only, its py_func is plain Python")
    _none(faults)


# ---- imports


def test_networks_are_imported_by_their_adapters_alone() -> None:
    faults = []
    for module in MODULES:
        for name, node in _imported(module):
            if name.split(".")[0] in NETWORKS and not module.name.startswith(ADAPTERS):
                faults.append(f"{module.at(node)}: imports {name}")
    _none(faults)


@pytest.mark.parametrize("name", ["scopemap", "scopemap.cli"])
def test_importing_does_not_wait_for_networks(name: str) -> None:
    heavy = NETWORKS | {"onnxruntime", "numba", "matplotlib", "numpy"}
    code = f"import sys, {name}; print(*sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


def test_copyleft_tools_are_not_imported() -> None:
    names = [(m, node) for m in MODULES for name, node in _imported(m) if name.split(".")[0] == "evo"]
    _none([module.at(node) for module, node in names])


def _module_names() -> dict[str, _Module]:
    def dotted(module: _Module) -> str:
        return "scopemap." + module.name.removesuffix(".py").replace("/", ".")

    return {dotted(module).removesuffix(".__init__"): module for module in MODULES}


def _bench_names() -> dict[str, _Module]:
    def dotted(module: _Module) -> str:
        return ".".join(module.path.relative_to(BENCH).with_suffix("").parts)

    return {dotted(module).removesuffix(".__init__"): module for module in BENCH_MODULES}


def _dependencies(name: str, modules: dict[str, _Module]) -> set[str]:
    """The modules that a module imports, also inside functions and by `import_module`.

    A root package imports its names when asked.
    """
    found = set()
    nodes = list(modules[name].nodes) if "." in name else []
    by_name = any(isinstance(node, ast.Name) and node.id == "import_module" for node in nodes)
    for node in nodes:
        if by_name and isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value)
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            inner = {f"{node.module}.{alias.name}" for alias in node.names} & set(modules)
            found |= inner or {str(node.module)}
    return (found & set(modules)) - {name}


def test_no_import_circles() -> None:
    modules = _module_names() | _bench_names()
    left = {name: _dependencies(name, modules) for name in modules}
    while leaves := [name for name, needed in left.items() if not needed & set(left)]:
        for name in leaves:
            del left[name]
    _none([f"{name} imports {', '.join(sorted(needed & set(left)))}" for name, needed in left.items()])


# ---- names and words


def test_public_classes_have_unique_names() -> None:
    found: dict[str, list[str]] = {}
    for module in MODULES:
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found.setdefault(node.name, []).append(module.name)
    _none([f"{name}: {', '.join(files)}" for name, files in found.items() if len(files) > 1])


def test_no_module_has_a_name_that_says_nothing() -> None:
    parts = {part.removesuffix(".py") for module in MODULES for part in module.name.split("/")}
    assert not parts & FORBIDDEN_NAMES


def test_the_library_neither_prints_nor_exits() -> None:
    faults = []
    for module in MODULES:
        if module.is_command:
            continue
        for node in module.nodes:
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ENDINGS:
                faults.append(module.at(node))
    _none(faults)


def test_no_time_is_told_by_a_clock_that_may_jump() -> None:
    """`time.monotonic` and `time.perf_counter` go on where the time of day is set."""
    jumping = re.compile(r"^(time\.(time|time_ns|localtime|ctime)|(datetime\.)?(datetime|date)\.(now|utcnow|today))$")
    calls = [(m, node) for m in MODULES for node in m.nodes if isinstance(node, ast.Call)]
    _none([module.at(call) for module, call in calls if jumping.match(ast.unparse(call.func))])


def test_nothing_is_left_for_later() -> None:
    later = re.compile(r"\b(TODO|FIXME|XXX|NotImplementedError)\b")
    found = [(module, later.search(module.text)) for module in MODULES + BENCH_MODULES + OTHERS]
    _none([f"{module.name}: {match[0]}" for module, match in found if match])


def _reads_a_sentence(node: ast.AST) -> bool:
    """Whether a condition depends on the words of a reason, a description or a text; whether it is empty may count."""
    words = {"reason", "description", "text", "plain", "sentence"}
    if isinstance(node, ast.Compare):
        sides = [node.left, *node.comparators]
        constants = [side.value for side in sides if isinstance(side, ast.Constant) and isinstance(side.value, str)]
        is_phrase = isinstance(node.ops[0], ast.In | ast.NotIn) and any(" " in text for text in constants[:1])
        named = any(isinstance(side, ast.Attribute) and side.attr in words for side in sides)
        return is_phrase or (named and any(constants))
    owner = node.func.value if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) else None
    asks = isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("startswith", "endswith", "search")
    return asks and isinstance(owner, ast.Attribute) and owner.attr in words


def test_no_sentence_decides() -> None:
    """Codes do: `Notice.code`, `LossCause`."""
    nodes = [(module, node) for module in MODULES for node in module.nodes]
    _none([module.at(node) for module, node in nodes if _reads_a_sentence(node)])
    wrong = ("'not rigid' in notes", "track.reason == 'relocalised'", "a.text.startswith('masks')")
    assert all(_reads_a_sentence(ast.parse(text, mode="eval").body) for text in wrong)


def test_no_except_catches_everything_silently() -> None:
    handlers = [(m, n) for m in MODULES for n in m.nodes if isinstance(n, ast.ExceptHandler)]
    _none([module.at(node) for module, node in handlers if node.type is None])


# ---- documentation and types


def _public(module: _Module) -> Iterator[Function | ast.ClassDef]:
    """Public functions and classes of a module, and the public methods of these classes."""
    for node in module.tree.body:
        if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_"):
            yield node
            if isinstance(node, ast.ClassDef):
                methods = (item for item in node.body if isinstance(item, Function))
                yield from (item for item in methods if not item.name.startswith("_"))


def test_what_is_public_is_documented() -> None:
    faults = [f"{module.name}: no docstring" for module in MODULES if not ast.get_docstring(module.tree)]
    faults += [module.at(node) for module in MODULES for node in _public(module) if not ast.get_docstring(node)]
    _none(faults)


def test_what_is_public_is_typed() -> None:
    faults = []
    for module in MODULES:
        for function in (f for f in _public(module) if isinstance(f, Function) and not _is_typed_by_use(f)):
            untyped = [a.arg for a in _parameters(function) if a.annotation is None]
            if untyped or function.returns is None:
                faults.append(f"{module.at(function)}: {', '.join(untyped) or 'return'}")
    _none(faults)


def test_every_function_says_what_it_returns() -> None:
    functions = [(module, f) for module in MODULES for f in module.functions() if not _is_typed_by_use(f)]
    _none([module.at(function) for module, function in functions if function.returns is None])


def test_public_names() -> None:
    assert 0 < len(scopemap.__all__) <= 17  # four of them ask a result, and were methods of `Result`
    assert len(set(scopemap.__all__)) == len(scopemap.__all__)
    for name in scopemap.__all__:
        assert getattr(scopemap, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'reconstruckt'"):
        _ = scopemap.reconstruckt
