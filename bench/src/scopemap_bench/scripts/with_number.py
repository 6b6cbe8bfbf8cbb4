"""The command line with one number of the source changed, for `sensitivity`.

    python -m scopemap_bench.scripts.with_number MODULE NAME VALUE "COMMAND" ...

The number is a constant of a module. It is changed where the module is loaded, before any other takes it over. A
command is a line as one types it after `scopemap`; one that fails does not keep the next ones from running. MODULE "":
nothing is changed.
"""

from __future__ import annotations

import ast
import os
import shlex
import sys
import tempfile
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import CodeType, ModuleType


def constant_of(node: ast.stmt) -> tuple[str, float] | None:
    """Return name and value where a statement gives a name to a plain number; None elsewhere."""
    target = node.targets[0] if isinstance(node, ast.Assign) and len(node.targets) == 1 else None
    target = node.target if isinstance(node, ast.AnnAssign) else target
    if not isinstance(node, ast.Assign | ast.AnnAssign) or not isinstance(target, ast.Name) or node.value is None:
        return None
    if any(not isinstance(one, _ARITHMETIC) for one in ast.walk(node.value)):
        return None
    value = eval(ast.unparse(node.value))  # numbers and signs alone
    return None if isinstance(value, bool) or not isinstance(value, int | float) else (target.id, value)


_ARITHMETIC = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.operator, ast.unaryop)


class _Loader(SourceFileLoader):
    """Loads a module with another value of a constant; takes no compiled code, and leaves none."""

    def __init__(self, fullname: str, path: str, constant: str, value: float) -> None:
        super().__init__(fullname, path)
        self.constant, self.value = constant, value

    def get_code(self, fullname: str) -> CodeType:
        """Return the module's code with the other value."""
        tree = ast.parse(self.get_data(self.path))
        (found,) = (node for node in tree.body if (constant_of(node) or ("",))[0] == self.constant)
        assert isinstance(found, ast.Assign | ast.AnnAssign)
        found.value = ast.Constant(self.value)
        return compile(ast.fix_missing_locations(tree), self.path, "exec")


class _Finder:
    """Finds one module for `_Loader`, and leaves all others to the usual finders."""

    def __init__(self, module: str, constant: str, value: float) -> None:
        self.module, self.constant, self.value = module, constant, value

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return where the module is and who loads it; None for any other."""
        if fullname != self.module:
            return None
        usual = PathFinder.find_spec(fullname, path, target)
        assert usual is not None
        assert usual.origin is not None
        loader = _Loader(fullname, usual.origin, self.constant, self.value)
        return spec_from_file_location(fullname, usual.origin, loader=loader)


def is_compiled(constant: str, module: Path, package: Path) -> bool:
    """Return whether a kernel may have taken the constant over: numba keeps its value in the compiled code."""
    users = [module] if constant.startswith("_") else package.rglob("*.py")
    return any(constant in _names_in_kernels(ast.parse(file.read_text(encoding="utf-8"))) for file in users)


def _names_in_kernels(tree: ast.Module) -> set[str]:
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    kernels = [one for one in functions if any("kernel" in ast.unparse(by) for by in one.decorator_list)]
    return {node.id for one in kernels for node in ast.walk(one) if isinstance(node, ast.Name)}


def main() -> None:
    """Change the number, then run the commands one after the other."""
    module, constant, value, *commands = sys.argv[1:]
    if module in sys.modules:
        sys.exit(f"with_number: {module} is loaded already")
    with tempfile.TemporaryDirectory() as kernels:
        if module:
            usual = PathFinder.find_spec("scopemap")
            assert usual is not None
            assert usual.origin is not None
            package = Path(usual.origin).parent
            if is_compiled(constant, package.parent.joinpath(*module.split(".")).with_suffix(".py"), package):
                os.environ["NUMBA_CACHE_DIR"] = kernels  # none is taken from before
            finder: object = _Finder(module, constant, ast.literal_eval(value))
            sys.meta_path.insert(0, finder)  # type: ignore[arg-type]
        from scopemap.cli.app import app

        for command in commands:
            try:
                app(shlex.split(command), prog_name="scopemap", standalone_mode=False)
            except Exception as error:  # the next command is another clip
                print(f"{command}: {error}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
