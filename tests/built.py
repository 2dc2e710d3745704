"""Programs that take long to build, once for all tests of a run: those in C++, as export/README.md
says, and the web page with its core, in a headless Chromium. Without a tool that they need, their
tests are skipped."""

import base64
import contextlib
import functools
import hashlib
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from exported import of_preset
from filelock import FileLock
from helpers import outcome

from ssrvlad_torch import export_head

ROOT = Path(__file__).parents[1]
Fixtures = Callable[[str], Any]
"""The value of a fixture by its name."""
WEB = ROOT / "export" / "web"
STRICT = {
    **os.environ,
    "CXXFLAGS": "-Wall -Wextra -Werror",
    "CMAKE_BUILD_TYPE": "Plain",  # neither optimised nor with symbols: compiled soonest
    "CMAKE_BUILD_PARALLEL_LEVEL": "2",
}


def must(*command, **options):
    """The lines of a command that succeeds, warnings being errors."""
    code, out, errors = outcome(*command, env=STRICT, **options)
    assert code == 0, "\n".join([*out, *errors])
    return out


def commands(*programs):
    """Those of export/README.md that begin with such words."""
    page = (ROOT / "export" / "README.md").read_text("utf-8")
    typed = [line[2:] for line in page.splitlines() if line.startswith("$ ")]
    return [command for command in typed if command.startswith(programs)]


def built_once(tmp_path_factory, name, build):
    """The folder that ``build(folder)`` fills, shared by all workers of a run."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    done = folder / ".built"
    with FileLock(f"{folder}.lock"):
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            build(folder)
            done.touch()
    return folder


@pytest.fixture(scope="session")
def user(tmp_path_factory):
    """The folder export/ of a user who typed the page's commands of CMake: ``build`` has the
    programs, ``build-describe`` the one over the core alone. It needs zlib and ONNX Runtime: in the
    folder that ORT_ROOT names, or as a CMake package."""
    if not shutil.which("cmake"):
        pytest.skip("CMake is not installed")
    return built_once(tmp_path_factory, "checkout", _build_programs) / "export"


@pytest.fixture(scope="session")
def shim(tmp_path_factory):
    """The library that kills a writer or records its calls."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("g++")
    if compiler is None:
        pytest.skip("needs a C compiler")
    target = tmp_path_factory.mktemp("shim") / "crashing.so"
    source = ROOT / "tests" / "crashing.c"
    subprocess.run([compiler, "-shared", "-fPIC", "-xc", source, "-o", target, "-ldl"], check=True)
    return target


def _build_programs(checkout):
    (checkout / "ssrvlad_torch").symlink_to(ROOT / "ssrvlad_torch")
    folder = checkout / "export"
    folder.mkdir()
    for file in (ROOT / "export").iterdir():
        (folder / file.name).symlink_to(file)
    code, _, errors = outcome("cmake", "-S", "cpp", "-B", "build", cwd=folder, env=STRICT)
    if code:
        assert "ORT_ROOT" not in os.environ, errors
        assert any(name in line for name in ("onnxruntime", "ZLIB") for line in errors), errors
        pytest.skip(
            "the C++ headers of ONNX Runtime or zlib are not installed; ORT_ROOT names their folder"
        )
    for command in commands("cmake"):
        if "cpp/describe" in command:  # which compiles the core anew, from the same sources
            shutil.copytree(folder / "build" / "core", folder / "build-describe" / "core")
        for part in command.replace(" -DORT_ROOT=/opt/onnxruntime", "").split(" && "):
            must(*part.split(), cwd=folder)


def _runtime():
    """A ``node_modules`` with what the lock file says, kept for the next run."""
    if (WEB / "node_modules").is_dir():
        return WEB / "node_modules"
    lock = (WEB / "package-lock.json").read_bytes()
    stored = ROOT / ".cache" / f"web-{hashlib.sha256(lock).hexdigest()[:16]}"
    if not stored.is_dir():
        if not shutil.which("npm"):
            pytest.skip("npm is not installed")
        stored.parent.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=stored.parent) as folder:
            for name in ("package.json", "package-lock.json"):
                shutil.copy(WEB / name, folder)
            command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
            if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
                pytest.skip("npm cannot install onnxruntime-web here")
            with contextlib.suppress(OSError):  # another process was faster
                (Path(folder) / "node_modules").rename(stored)
    return stored


def _build_site(folder):
    build = [sys.executable, ROOT / "scripts" / "hatch_build.py", folder / "ssrvlad.wasm"]
    subprocess.run(build, check=True)
    for preset in ("default", "paper"):
        export_head(of_preset(preset), folder / f"{preset}.onnx")


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """A folder with the page, its core, and a head of each preset."""
    if not CHROMIUM:
        pytest.skip("Chromium is not installed")
    pytest.importorskip("ziglang")
    built = built_once(tmp_path_factory, "site", _build_site)
    folder = tmp_path_factory.mktemp("site") / "web"
    shutil.copytree(WEB, folder, ignore=shutil.ignore_patterns("node_modules"))
    shutil.copytree(built, folder, dirs_exist_ok=True)
    (folder / "node_modules").symlink_to(_runtime())
    return folder


@pytest.fixture(scope="session")
def page(site, tmp_path_factory):
    """A tab, and the address that the page has in it."""
    with browser(tmp_path_factory.mktemp("profile")) as tab, served(site) as address:
        tab.address = f"{address}/index.html"
        yield tab


CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chrome")

_WAIT = """new Promise((done, fail) => {
  const look = () => { try { const found = %s; if (found) done(found); else setTimeout(look, 20) }
    catch (error) { fail(error) } };
  const shown = () => document.body.innerText.slice(0, 2000);
  setTimeout(() => fail(new Error(`waited for ${%s}, shown: ${shown()}`)), 180000);
  look() })"""


class Page:
    """A tab of a browser."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self._to = os.fdopen(to_browser, "wb", buffering=0)
        self._from = os.fdopen(from_browser, "rb")
        self._numbers = itertools.count(1)
        self._session: dict[str, str] = {}
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}

    def call(self, method: str, **parameters: Any) -> Any:
        """The result of a command of the DevTools protocol."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters, **self._session}
        self._to.write(json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == number:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    def open(self, address: str, ready: str) -> None:
        """Goes to an address anew and waits for an expression to hold once it is loaded."""
        for place in ("about:blank", address):
            self.call("Page.navigate", url=place)
            self.wait_for(f"location.href === {json.dumps(place)}")
        self.wait_for(f"document.readyState === 'complete' && ({ready})")

    def wait_for(self, expression: str) -> None:
        """Waits for an expression to hold."""
        self.run(_WAIT % (expression, json.dumps(expression)))

    def run(self, script: str) -> Any:
        """The value of an expression, awaited."""
        answer = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def choose(self, selector: str, *files: Path) -> None:
        """Gives files to an ``<input type="file">``."""
        root = self.call("DOM.getDocument")["root"]["nodeId"]
        node = self.call("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self.call("DOM.setFileInputFiles", nodeId=node, files=[str(file) for file in files])

    def drop(self, *paths: Path) -> None:
        """Drops files and folders on the page."""
        data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self.call("Input.dispatchDragEvent", type=kind, x=50, y=50, data=data)

    def screenshot(self, path: Path, width: int) -> None:
        """Writes a picture of the whole page at a width in pixels."""
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        taken = self.call("Page.captureScreenshot", captureBeyondViewport=True)["data"]
        path.write_bytes(base64.b64decode(taken))

    def _read(self) -> Any:
        content = bytearray()
        while (byte := self._from.read(1)) != b"\0":
            assert byte, "the browser has gone"
            content += byte
        return json.loads(content)


@contextlib.contextmanager
def browser(profile: Path) -> Iterator[Page]:
    """A tab of a new browser that keeps its files in a folder."""
    (their_in, our_out), (our_in, their_out) = os.pipe(), os.pipe()
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    arguments = [CHROMIUM, *flags, f"--user-data-dir={profile}", "--remote-debugging-pipe"]
    command = ["bash", "-c", f'exec "$@" 3<&{their_in} 4>&{their_out}', "bash", *arguments]
    silent = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
    process = subprocess.Popen(command, pass_fds=(their_in, their_out), **silent)
    os.close(their_in)
    os.close(their_out)
    try:
        yield Page(our_out, our_in)
    finally:
        process.terminate()
        process.wait()


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder on this machine."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

        def send_head(self) -> Any:
            """Files come whole: one that changes twice in a second has one time."""
            del self.headers["If-Modified-Since"]
            return super().send_head()

    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
