"""One thread for torch: the tests run side by side, and small tensors gain nothing from more.
Signals are raised in processes of their own: where OpenVINO has used AMX, the registers of a thread
no longer fit on the stack that pytest's faulthandler gives to signals, and the process ends.
Property tests try the same examples in every run; test_random_run.py tries others.
What the tests of the command line share: the command line itself, six frames, a database of them.
"""

import hashlib
import json
import shutil
import subprocess
import sys
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from urllib.request import Request, urlopen

import networks
import pytest
import torch
import typer
from built import built_once, page, shim, site, user  # noqa: F401 - fixtures
from filelock import FileLock
from helpers import Maps, write_maps, write_truth, write_two_drives
from hypothesis import settings
from networks import write_coloured, write_drives, write_named_network
from networks import write_photos as write_photos_of_streets
from skips import pytest_make_collect_report, pytest_runtest_makereport  # noqa: F401 - hooks

from ssrvlad_torch import Map, SSRVLADConfig, native
from ssrvlad_torch.deployment import export, fuse, label_graph
from ssrvlad_torch.files import replacing
from ssrvlad_torch.taxonomy import label_space_names

torch.set_num_threads(1)

ROOT = Path(__file__).parents[1]


LONGEST = [
    "export_cpp",
    "export_web",
    "decisions",
    "ros2",
    "descriptors",
    "export_package",
    "guides",
    "readme",
    "fuse",
    "against",
    "wheel",
    "cli",
    "imports",
]
"""Files that take minutes, each with what only it makes."""


def pytest_collection_modifyitems(items):
    """The longest files come first, so that workers which share the files end together."""
    size = cache(lambda path: path.stat().st_size)

    def order(item):
        name = item.path.stem.removeprefix("test_")
        return LONGEST.index(name) if name in LONGEST else len(LONGEST), -size(item.path)

    items.sort(key=order)


settings.register_profile("steady", max_examples=16, derandomize=True, deadline=None)
settings.register_profile("random", max_examples=1000, deadline=None)
settings.load_profile("steady")


@pytest.fixture(scope="session")
def core():
    """The native core, built where a checkout has none of its own source."""
    if native.core().library is None:
        if not shutil.which("g++"):
            pytest.skip("no C++ compiler")
        subprocess.run([sys.executable, ROOT / "scripts" / "hatch_build.py"], check=True)
        native.core.cache_clear()
    return native.core()


ABOVE = {"baselines", "cli", "encoding", "evaluation", "loops", "map.py", "search"}
"""Rooms that no traced graph depends on."""


@cache
def digest_of_sources() -> bytes:
    """Of everything that a traced graph depends on, and the versions of what traces it."""
    package = ROOT / "ssrvlad_torch"
    files = [*package.rglob("*.py"), *package.rglob("*.yaml"), Path(networks.__file__)]
    files.append(ROOT / "constraints.txt")
    below = sorted(file for file in files if not ABOVE & {*file.parts[len(package.parts) :]})
    versions = ",".join(map(version, ("torch", "onnx", "onnxscript")))
    return hashlib.sha256(b"".join(map(Path.read_bytes, below)) + versions.encode()).digest()


def stored(build):
    """A function that builds an ONNX model, once for the same arguments and sources: tracing takes
    several seconds, and all workers share the folder."""

    @cache
    def content(*arguments: object) -> bytes:
        key = hashlib.sha256(digest_of_sources() + repr((build.__name__, arguments)).encode())
        file = ROOT / ".cache" / "traced" / f"{key.hexdigest()}.onnx"
        file.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{file}.lock"):
            if not file.exists():
                built = build(*arguments).SerializeToString()
                with replacing(file) as temporary:
                    temporary.write_bytes(built)
        return file.read_bytes()

    def load(*arguments: object):
        import onnx

        return onnx.load_from_string(content(*arguments))

    return load


@pytest.fixture(scope="session", autouse=True)
def traced_once():
    """Caches the commands, the graph of a head where the label space has a name, the traced parts
    of fused graphs, and the graph of a network."""
    head_model = export.head_model
    stored_head = stored(head_model)

    def model(config, input="labels", dtype=None, columns=(), shape=None):
        if input == "labels":
            dtype = dtype or "uint8"
        build = stored_head if config.labels_as in label_space_names() else head_model
        return build(config, input, dtype, tuple(columns), shape)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.main, "get_command", cache(typer.main.get_command))
        for module in (export, fuse):
            patch.setattr(module, "head_model", model)
        for name in ("_traced_preparation", "_traced_decision", "_traced_features"):
            patch.setattr(label_graph, name, stored(getattr(label_graph, name)))
        patch.setattr(networks, "street_graph", stored(networks.street_graph))
        yield


@pytest.fixture(scope="session")
def head(tmp_path_factory):
    """The head of ``default`` for labels of ``camvid-11`` as a file, not to be changed."""
    path = tmp_path_factory.mktemp("heads") / "head.onnx"
    export.export_head(SSRVLADConfig(labels_as="camvid-11"), path)
    return path


@pytest.fixture(scope="session")
def coloured(tmp_path_factory):
    """The files of `write_coloured`, not to be changed."""
    return built_once(tmp_path_factory, "coloured", write_coloured)


@pytest.fixture(scope="session")
def drives(tmp_path_factory):
    """A network with features as ``net.yaml``, photos in ``monday`` and ``today``, and the fused
    files: ``place.onnx``, or ``net.onnx`` and ``head.onnx``. Not to be changed."""
    return built_once(tmp_path_factory, "drives", write_drives)


@pytest.fixture
def network(tmp_path):
    """The settings of a network that says what its classes are, and three ``photos``."""
    write_photos_of_streets(tmp_path / "photos", range(3), (60, 80))
    return write_named_network(tmp_path)


@pytest.fixture
def main_of(monkeypatch, capsys):
    """Runs a program in this process; returns exit code, stdout and the lines of stderr."""

    def run(main, name: str, *arguments: object) -> tuple[int, str, list[str]]:
        monkeypatch.setattr("sys.argv", [name, *map(str, arguments)])
        try:
            code = main()
        except SystemExit as end:
            code = end.code
        out, err = capsys.readouterr()
        return code or 0, out, err.splitlines()

    return run


@pytest.fixture
def ssrvlad(main_of, monkeypatch, tmp_path):
    """Runs a command line as `main_of` does; the user's cache is the folder ``cache``."""
    from ssrvlad_torch.cli.main import main

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return partial(main_of, main, "ssrvlad")


@pytest.fixture
def refusal(ssrvlad):
    """The one line on stderr with which a command line is refused; the exit code is 2."""

    def run(*arguments: object) -> str:
        code, out, (line,) = ssrvlad(*arguments)
        assert (code, out) == (2, "")
        return line

    return run


@pytest.fixture
def encode(ssrvlad):
    """Runs ``ssrvlad encode`` on label maps of ``camvid-11``."""
    return partial(ssrvlad, "encode", "--labels-as", "camvid-11")


@pytest.fixture
def maps(tmp_path):
    """A folder of six label maps."""
    return write_maps(tmp_path / "monday", range(6))


@pytest.fixture
def drawn(maps, tmp_path):
    """A map of six label maps."""
    drawn = Map.open(tmp_path / "drawn.ssrdb", labels_as="camvid-11")
    drawn.add(maps)
    return drawn


@pytest.fixture
def town(tmp_path):
    """Folders of label maps and a database of them; write more with `add`."""
    return Maps(tmp_path)


@pytest.fixture
def database(encode, maps, tmp_path):
    """A database of ``maps``."""
    assert encode(maps, "-o", tmp_path / "town.ssrdb")[0] == 0
    return tmp_path / "town.ssrdb"


@pytest.fixture
def compare(ssrvlad):
    """Runs the command; returns exit code, rows by method, and the lines of stderr. Of the two
    rows of a method it is that of single frames."""

    def run(*arguments: object):
        code, out, err = ssrvlad("compare", *arguments, "--json")
        rows = json.loads(out)["rows"] if out else []
        return code, {row["method"]: row for row in rows if not row.get("steps")}, err

    return run


@pytest.fixture
def two_drives(tmp_path):
    """Two drives past six places, with images and label maps, and the truth."""
    town = write_two_drives(tmp_path / "town", 6)
    truth = {f"query/{n:03d}": [f"reference/{n:03d}"] for n in range(6)}
    write_truth(town / "ground_truth.json", truth)
    return town


@pytest.fixture
def evaluate(ssrvlad, database, tmp_path):
    """Evaluates six frames of Tuesday, alike those of Monday, against Monday's database."""
    tuesday = write_maps(tmp_path / "tuesday", range(6))

    def run(*arguments: object) -> tuple[int, str, list[str]]:
        return ssrvlad("evaluate", database, tuesday, "--temporal", 0, *arguments)

    return run


@pytest.fixture
def bucket(monkeypatch):
    """A bucket of a local server that speaks S3."""
    server_of = pytest.importorskip("moto.server", reason="needs moto")
    boto3 = pytest.importorskip("boto3")
    server = server_of.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    settings = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_REGION": "us-east-1",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    url = settings["AWS_ENDPOINT_URL"]
    urlopen(Request(f"{url}/moto-api/reset", method="POST"))  # servers of a process share content
    boto3.client("s3", endpoint_url=url).create_bucket(Bucket="town")
    yield "s3://town"
    server.stop()
