"""Creates or reuses ``.venv``, installs this package into it, and runs commands there.

Needs only Python 3.11 with the standard library. pip installs the core packages and one extra of
pyproject.toml, at the versions of constraints.txt; modules are compiled where they are first
imported, not all 25,000.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
BIN = VENV / "bin"


def install(extra: str) -> None:
    """Installs the package with an extra, unless these files have been installed before."""
    if sys.version_info < (3, 11):  # noqa: UP036 - this checks the version
        version = sys.version.split()[0]
        sys.exit(f"{Path(sys.argv[0]).name}: expected Python 3.11 or newer, got {version}")
    names = ("pyproject.toml", "constraints.txt", "scripts/hatch_build.py")
    core = sorted((ROOT / "ssrvlad_torch" / "native").glob("*.[ch]*"))
    content = b"".join(file.read_bytes() for file in (*(ROOT / name for name in names), *core))
    stamp = VENV / f"installed-{extra}-{hashlib.sha256(content).hexdigest()[:16]}"
    if stamp.exists():
        return
    if not (BIN / "python").exists():
        venv.create(VENV, with_pip=True)
    print(f"installing ssrvlad-torch[{extra}] into {VENV.name}, a few minutes", flush=True)
    pip = [BIN / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    options = ["--no-compile", "--constraint", ROOT / "constraints.txt"]
    # torch first: its pinned build then satisfies the dependency of the package
    for what in (["torch"], ["--editable", f"{ROOT}[{extra}]"]):
        if subprocess.run([*pip, *options, *what], check=False).returncode:
            sys.exit(f"{Path(sys.argv[0]).name}: pip could not install {' '.join(what)}, see above")
    stamp.touch()


def run(*command: str | Path) -> None:
    """Runs a command of the environment; exits with its code if it fails."""
    done = subprocess.run([BIN / command[0], *command[1:]], cwd=ROOT, check=False)
    if done.returncode:
        sys.exit(done.returncode)


if __name__ == "__main__":
    install(sys.argv[1])
