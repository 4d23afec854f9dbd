"""A digest of the engine's code and data: it changes when something is written that may change a result.

The modules are found by following imports from where registrations start. Comments, docstrings, type-checking imports
and the places of modules do not count: an import counts by what the imported module contains, not by its path. So a
module may be moved, and the digest stays the same.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from regnf_core.batch import register_batch
from regnf_core.fields.build import open_field
from regnf_core.library import register, search_library

ENTRIES = tuple(function.__module__ for function in (open_field, register, register_batch, search_library))
"""Where a registration starts, and where the fields that it evaluates come from."""
_C_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_LAYOUT_FIELDS = frozenset({"ctx", "kind", "type_comment", "type_ignores", "type_params"})
"""Members of syntax trees that say nothing here, or that not every version of Python has."""


@dataclass(frozen=True)
class Module:
    """A module's syntax tree without docstrings and without what is for type checkers only."""

    name: str
    tree: ast.Module

    @classmethod
    def read(cls, name: str, path: Path) -> Module:
        return cls(name, _Stripped().visit(ast.parse(path.read_text(encoding="utf-8"))))

    @cached_property
    def imports(self) -> list[ast.Import | ast.ImportFrom]:
        """Every import, also those within functions."""
        return [node for node in ast.walk(self.tree) if isinstance(node, ast.Import | ast.ImportFrom)]

    @cached_property
    def digest(self) -> str:
        """Of the code without its imports."""
        return _digest(_plain(self.tree))


def source_digest(root: Path, entries: Sequence[str] = ENTRIES) -> str:
    """The digest of all modules below ``root`` that ``entries`` import, directly or not."""
    modules = engine_modules(root, entries)
    digests = {name: module.digest for name, module in modules.items()}
    parts = [[module.digest, sorted(_import_lines(module, digests))] for module in modules.values()]
    data = _data_beside(root, modules)
    return _digest([sorted(parts), data] if data else sorted(parts))


def _data_beside(root: Path, names: Iterable[str]) -> list[str]:
    """Digests of the JSON files in the modules' folders, which the engine may read, and of the C files there."""
    folders = {root.joinpath(*name.split(".")[:-1]) for name in names}
    data = [json.loads(path.read_text("utf-8")) for folder in folders for path in folder.glob("*.json")]
    code = [_c_tokens(path.read_text("utf-8")) for folder in folders for path in folder.glob("*.[ch]")]
    return sorted(map(_digest, data + code))


def _c_tokens(text: str) -> list[str]:
    """A C file without comments and layout."""
    return _C_COMMENT.sub(" ", text).split()


def engine_modules(root: Path, entries: Sequence[str] = ENTRIES) -> dict[str, Module]:
    """All modules below ``root`` that ``entries`` import, directly or not, by name. Raises FileNotFoundError."""
    found: dict[str, Module] = {}
    waiting = list(entries)
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        path = _path_of(root, name)
        if path is None:
            raise FileNotFoundError(f"no module {name} below {root}")
        found[name] = Module.read(name, path)
        waiting += [target for target in _named_modules(found[name]) if _path_of(root, target) is not None]
    return found


def _path_of(root: Path, name: str) -> Path | None:
    place = root.joinpath(*name.split("."))
    return next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()), None)


def _named_modules(module: Module) -> Iterator[str]:
    """What may be modules among the names that a module imports, or that it holds as text to import them later."""
    for node in module.imports:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
            continue
        if node.level or node.module is None:
            raise ValueError(f"{module.name}: a relative import, which is not followed")
        yield node.module
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    for one in ast.walk(module.tree):
        if isinstance(one, ast.Constant) and isinstance(one.value, str) and re.fullmatch(r"\w+(\.\w+)+", one.value):
            yield one.value


def _import_lines(module: Module, digests: Mapping[str, str]) -> Iterator[str]:
    """Each imported name with what it comes from: the digest of a module of ours, the name of any other."""
    for node in module.imports:
        for alias in node.names:
            own = f"{node.module}.{alias.name}" if isinstance(node, ast.ImportFrom) else alias.name
            source = own if own in digests or isinstance(node, ast.Import) else str(node.module)
            name = alias.name if isinstance(node, ast.ImportFrom) and source != own else ""
            yield f"{name} as {alias.asname or alias.name.rpartition('.')[2]} from {digests.get(source, source)}"


class _Stripped(ast.NodeTransformer):
    """Takes out docstrings, and the branches that only type checkers read."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            return None
        return self.generic_visit(node)

    def visit_If(self, node: ast.If) -> Any:
        if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            return [self.visit(child) for child in node.orelse]
        return self.generic_visit(node)


def _plain(value: Any) -> Any:
    """A syntax tree as lists and texts that are the same in every version of Python; imports are left out."""
    if isinstance(value, ast.AST):
        members = [(name, member) for name, member in ast.iter_fields(value) if name not in _LAYOUT_FIELDS]
        return [type(value).__name__, *([name, _plain(member)] for name, member in members if member not in (None, []))]
    if isinstance(value, list):
        return [_plain(one) for one in value if not isinstance(one, ast.Import | ast.ImportFrom | ast.Pass)]
    return repr(value)


def _digest(value: Any) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()
