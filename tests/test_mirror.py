"""Every module has a file of tests that bears its name; CONTRIBUTING.md has the rule."""

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "ssrvlad_torch"
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if not path.name.startswith("__"))


def imported(path: Path) -> set[Path]:
    """The modules that a module may import by relative names."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
            found |= {base.with_suffix(".py"), *(base / f"{alias.name}.py" for alias in node.names)}
    return found - {path}


IMPORTS = {path: imported(path) for path in MODULES}


def files_of(module: Path) -> set[str]:
    """The files of tests in which a module is tested."""
    *rooms, _ = module.relative_to(PACKAGE).parts
    names = [module.stem, *rooms, *(f"{room}_{module.stem}" for room in rooms[-1:])]
    own = {name for name in names if (TESTS / f"test_{name}.py").exists()}
    users = [user for user in MODULES if module in IMPORTS[user]]
    if own or any(user.parent != module.parent for user in users):
        return own
    return {file for user in users for file in files_of(user)}


@pytest.mark.parametrize("module", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_is_tested_in_the_file_of_its_name_or_room(module):
    assert files_of(module)
