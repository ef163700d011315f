"""Lists the contents of a source tree of rclpy: names of modules, functions, classes and their members, nothing else.

    python test/e2e/rclpy_names.py TREE COMMIT > test/e2e/rclpy_humble.json

TREE is the folder with rclpy's ``package.xml``, ``rclpy/`` and ``src/``. ``humble.py`` hides names that are not in the list, so
that tests on a newer rclpy find uses of anything that Humble lacks.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

COMPILED = 'rclpy._rclpy_pybind11'
_BOUND = re.compile(
    r'py::(?P<kind>class_|enum_|exception|register_exception)\b[^;"(]*\(\s*\w+,\s*"(?P<type>\w+)"'
    r'|(?P<module>\b(?:m|module))\s*\.\s*(?:def|attr)\(\s*"(?P<function>\w+)"'
    r'|\.(?:def\w*|value)\(\s*"(?P<member>\w+)"'
)
"""In the order of a file: a bound class, a name of the module itself, and a member of the preceding class."""
_INFO = re.compile(r'"(\w+)"_a')
_VERSION = re.compile(r'<version>([^<]+)</version>')


def main(tree: Path, commit: str) -> dict[str, Any]:
    """All names of a tree."""
    modules = {name: module(ast.parse(path.read_text(encoding='utf-8'))) for name, path in sources(tree)}
    version = _VERSION.search((tree / 'package.xml').read_text(encoding='utf-8'))
    assert version is not None, f'{tree} has no package.xml with a version'
    return {
        'version': version[1], 'commit': commit, 'message_info': message_info(tree),
        'modules': modules | {COMPILED: compiled((tree / 'src/rclpy').glob('*.cpp'))},
    }  # fmt: skip


def sources(tree: Path) -> Iterator[tuple[str, Path]]:
    """Name and file of each Python module."""
    for path in sorted((tree / 'rclpy').rglob('*.py')):
        parts = path.relative_to(tree).with_suffix('').parts
        yield '.'.join(parts[:-1] if parts[-1] == '__init__' else parts), path


def message_info(tree: Path) -> list[str]:
    """The fields of the message info that a take returns."""
    return sorted(_INFO.findall((tree / 'src/rclpy/subscription.cpp').read_text(encoding='utf-8')))


def module(parsed: ast.Module) -> dict[str, Any]:
    """The names of a module, and the bases and members of its classes."""
    classes = [node for node in ast.walk(parsed) if isinstance(node, ast.ClassDef)]
    return {
        'names': sorted(set(bound(parsed.body))),
        'classes': {
            node.name: {'bases': sorted(map(last_name, node.bases)), 'members': sorted(set(members(node)))} for node in classes
        },
    }


def bound(body: Iterable[ast.stmt]) -> Iterator[str]:
    """The names that statements bind, including those in branches; not those for type checkers only."""
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            yield from (alias.asname or alias.name.partition('.')[0] for alias in node.names)
        elif isinstance(node, (ast.Assign, ast.AnnAssign, ast.AugAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (found.id for target in targets for found in ast.walk(target) if isinstance(found, ast.Name))
        elif isinstance(node, ast.If) and last_name(node.test) == 'TYPE_CHECKING':
            yield from bound(node.orelse)
        else:
            for part in ('body', 'orelse', 'finalbody'):
                yield from bound(getattr(node, part, ()))
            for handler in getattr(node, 'handlers', ()):
                yield from bound(handler.body)


def members(node: ast.ClassDef) -> Iterator[str]:
    """The names that a class binds, and the attributes that its methods set on ``self``."""
    yield from bound(node.body)
    for found in ast.walk(node):
        if isinstance(found, ast.Attribute) and isinstance(found.ctx, ast.Store) and last_name(found.value) == 'self':
            yield found.attr
    for found in node.body:
        if isinstance(found, ast.Assign) and last_name(found.targets[0]) == '__slots__':
            yield from (
                each.value for each in ast.walk(found.value) if isinstance(each, ast.Constant) and isinstance(each.value, str)
            )


def last_name(node: ast.expr) -> str:
    """``B`` of ``a.B`` and of ``B``."""
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, 'id', '')


def compiled(paths: Iterable[Path]) -> dict[str, Any]:
    """The names of the module written in C++."""
    names: set[str] = set()
    classes: dict[str, dict[str, list[str]]] = {}
    for path in sorted(paths):
        of: list[str] = []
        for found in _BOUND.finditer(path.read_text(encoding='utf-8')):
            if found['type']:
                names.add(found['type'])
                of = classes.setdefault(found['type'], {'bases': ['Destroyable'], 'members': []})['members']
            elif found['function']:
                names.add(found['function'])
            else:
                of.append(found['member'])
    for each in classes.values():
        each['members'] = sorted(set(each['members']))
    return {'names': sorted(names), 'classes': dict(sorted(classes.items()))}


if __name__ == '__main__':
    sys.stdout.write(json.dumps(main(Path(sys.argv[1]), sys.argv[2]), indent=1) + '\n')
