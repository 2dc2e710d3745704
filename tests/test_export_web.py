"""The page in a headless Chromium against the module; needs Chromium and npm."""

import contextlib
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import CHROMIUM, browser, served
from drawings import SPACE
from drives import write_maps
from exported import noise
from graphs import edit_golden, turned
from helpers import COLOUR, GRAY, PALETTES, street, write_palette, write_png
from networks import PLAIN, colour_network, photo
from PIL import Image
from segmenting import write_town
from ssrvlad_place.database import save
from ssrvlad_place.model import Seen

from ssrvlad_torch import SSRVLAD, Segmenter, SSRVLADConfig, export_head, match
from ssrvlad_torch.deployment.fuse import fuse
from ssrvlad_torch.stages.boundaries import AREA_LAYERS, DIRECTIONS
from ssrvlad_torch.stages.harmonics import basis_table
from ssrvlad_torch.taxonomy import CATEGORIES, label_space

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "export" / "web"
CONFIGS = {
    "default": SSRVLADConfig(labels_as="camvid-11"),
    "paper": SSRVLADConfig.from_preset("paper", labels_as="camvid-11"),
}
presets = pytest.mark.parametrize("preset", CONFIGS)
SHOWN = "!document.getElementById('result').hidden"
FAILED = "document.querySelector('#status.error')"
ROWS = "Array.from(document.querySelectorAll('#matches tbody tr'), (row) => row.innerText)"
GOLDEN = "document.getElementById('golden').value"
STATUS = "document.getElementById('status').textContent"
TARGETS = "Array.from(document.querySelectorAll('.target'), (target) => target.innerText.trim())"
TARGETS_OF = {
    "default": [
        *("ground, parking", "sidewalk", "building, guard-rail", "pole", "vegetation", "sky"),
        *(f"{direction} boundaries" for direction in DIRECTIONS),
    ],
    "paper": list(CATEGORIES),
}
"""No layer twice: where parking counts as ground, the page drew the target of ground for both."""
CLASSES = json.dumps(label_space(SPACE).to_dict()["classes"])


def runtime() -> Path:
    """A ``node_modules`` with what the lock file says, kept for the next run."""
    if (SOURCE / "node_modules").is_dir():
        return SOURCE / "node_modules"
    lock = (SOURCE / "package-lock.json").read_bytes()
    kept = ROOT / ".cache" / f"web-{hashlib.sha256(lock).hexdigest()[:16]}"
    if not kept.is_dir():
        if not shutil.which("npm"):
            pytest.skip("npm is not installed")
        kept.parent.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=kept.parent) as folder:
            for name in ("package.json", "package-lock.json"):
                shutil.copy(SOURCE / name, folder)
            command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
            if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
                pytest.skip("npm cannot install onnxruntime-web here")
            with contextlib.suppress(OSError):  # another process was faster
                (Path(folder) / "node_modules").rename(kept)
    return kept


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the page, a head of each preset, six label maps and a database of them."""
    if not CHROMIUM:
        pytest.skip("Chromium is not installed")
    pytest.importorskip("ziglang")
    folder = tmp_path_factory.mktemp("site") / "web"
    shutil.copytree(SOURCE, folder, ignore=shutil.ignore_patterns("node_modules"))
    build = [sys.executable, ROOT / "scripts" / "hatch_build.py", folder / "ssrvlad.wasm"]
    subprocess.run(build, check=True)
    (folder / "node_modules").symlink_to(runtime())
    write_maps(folder / "maps", range(6))
    for preset, config in CONFIGS.items():
        export_head(config, folder / f"{preset}.onnx")
        seen = map(Seen, view_of(folder, preset).descriptor.numpy())
        names = [f"maps/{file.stem}" for file in files_of(folder)]
        save(folder / f"{preset}.npy", [*seen], names, {"ssr-vlad": config.fingerprint})
    return folder


@pytest.fixture(scope="module")
def page(site, tmp_path_factory):
    """A tab, and the address that the page has in it."""
    profile = tmp_path_factory.mktemp("profile")
    with browser(profile) as tab, served(site) as address:
        tab.address = f"{address}/index.html"
        yield tab


def files_of(site):
    return sorted((site / "maps").iterdir())


def view_of(site, preset):
    labels = np.stack([np.asarray(Image.open(file)) for file in files_of(site)])
    return SSRVLAD(CONFIGS[preset]).explain(torch.from_numpy(labels))


def open_page(page, query="", ready="true"):
    page.open(f"{page.address}{query}", ready)


def open_result(page, query):
    """Opens the page, which may not fail."""
    open_page(page, query, f"{SHOWN} || {FAILED}")
    assert page.run(FAILED) is None


def matches_of(page, query):
    """The frames that the page shows, and their scores."""
    open_result(page, query)
    found = [row.split() for row in page.run(ROWS)]
    return [frame for frame, _ in found], [float(score) for _, score in found]


def failure(page):
    """What the page says once it has failed."""
    page.wait_for(FAILED)
    return page.run(f"{FAILED}.textContent")


def described(page, site, preset, file):
    """What the page's own module says about a label map."""
    return page.run(f"""(async () => {{
        const {{ Model }} = await import('./model.js');
        const {{ readLabels }} = await import('./label_png.js');
        const {{ targetsOf }} = await import('./targets.js');
        const bytes = async (a) => new Uint8Array(await (await fetch(a)).arrayBuffer());
        const model = await Model.load(await bytes('{preset}.onnx'));
        const found = await model.describe(await readLabels(await bytes('maps/{file.name}')));
        const categories = {json.dumps(CATEGORIES)};
        const targets = targetsOf(model.config, found.descriptor, categories);
        return {{ ...found, descriptor: Array.from(found.descriptor),
          skeleton: found.skeleton && Array.from(found.skeleton),
          targets: targets.map(({{ values }}) => Array.from(values)) }};
    }})()""")


DESCRIBE = """(async () => {{
    const {{ Core }} = await import('./core.js');
    const {{ readLabels }} = await import('./label_png.js');
    const core = await Core.load();
    const file = await (await fetch({file})).arrayBuffer();
    const {{ labels, height, width }} = await readLabels(new Uint8Array(file), []);
    return core.using(({{ room, put, get }}) => {{
        const settings = room(256), descriptor = room(480 * 4);
        core.call("ssrvlad_preset", put(new TextEncoder().encode({preset} + "\\0")), settings);
        const head = core.call("ssrvlad_new", settings);
        const map = new BigInt64Array([0n, 1n, BigInt(height), BigInt(width)]);
        new Int32Array(map.buffer).set([put(Uint8Array.from(labels)), 1]);
        const categories = Uint8Array.from({categories});
        const table = new BigInt64Array([BigInt(put(categories)), BigInt(categories.length), 0n]);
        const status = core.call("ssrvlad_describe", head, put(map), put(table), 1, descriptor);
        const length = Number(core.call("ssrvlad_length", head));
        core.call("ssrvlad_free", head);
        return [Number(status), ...get(Int32Array, descriptor, length)];
    }});
}})()"""


@presets
def test_the_core_gives_the_same_bits_as_the_native_one(page, site, core, preset):
    """Label maps of the synthetic city, and noise, which has everything."""
    open_page(page)
    Image.fromarray(noise(3)).save(site / "noise.png")
    ids = label_space(SPACE).classes
    table = [{c.id: c.category_index for c in ids}.get(id, 255) for id in range(256)]
    for name in ["noise.png", *(f"maps/{file.name}" for file in files_of(site))]:
        labels = np.asarray(Image.open(site / name))[None]
        expected = SSRVLAD(CONFIGS[preset])(labels)[0]
        given = {"file": name, "preset": preset, "categories": table}
        found = page.run(DESCRIBE.format(**{key: json.dumps(each) for key, each in given.items()}))
        assert found == [0, *expected.view(torch.int32).tolist()]


@presets
def test_the_golden_pair_the_matches_and_what_is_drawn(page, site, preset):
    labels = files_of(site)[2]
    query = f"?model={preset}.onnx&database={preset}.npy&labels=maps/{labels.name}"
    shown = matches_of(page, query)
    verdict = page.run(GOLDEN)
    print(f"{preset} preset in onnxruntime-web: {verdict}")
    assert verdict.startswith("golden pair: largest difference ")
    assert float(verdict.split()[-1]) <= 1e-6
    descriptors = view_of(site, preset).descriptor
    scores, rows = (part[0].tolist() for part in match(descriptors[2:3], descriptors, 5))
    names = [f"maps/{files_of(site)[row].stem}" for row in rows]
    assert shown == (names, pytest.approx(scores, abs=1e-4))
    assert page.run(TARGETS) == TARGETS_OF[preset]
    assert_drawn_as_found(page, site, preset, 4)


def assert_drawn_as_found(page, site, preset, number):
    """What the page draws of a label map is what the module finds in it."""
    found = described(page, site, preset, files_of(site)[number])
    view = view_of(site, preset)
    np.testing.assert_allclose(found["descriptor"], view.descriptor[number], atol=1e-6)
    rows, columns = view.skeleton.shape[2:]
    assert (found["rows"], found["columns"]) == (rows, columns)
    targets = np.array(found["targets"])
    if preset == "default":
        assert found["skeleton"] is None
        assert_smooth_parts(targets, view.histograms.bins[number])
        return
    np.testing.assert_allclose(targets.ravel(), view.descriptor[number], atol=1e-6, rtol=0)
    assert found["keypoints"] == view.keypoints[number].sum((1, 2)).tolist()
    layers = np.array(found["skeleton"], np.uint8).reshape(rows, columns)
    skeleton = layers >> np.arange(8)[:, None, None] & 1
    np.testing.assert_array_equal(skeleton, view.skeleton[number].numpy())
    assert skeleton.any()


def assert_smooth_parts(targets, bins):
    """Each target is the projection of the histogram on the basis, of one scale for all."""
    config = CONFIGS["default"]
    expected = []
    for part, count in (
        (bins[:AREA_LAYERS], config.harmonics),
        (bins[AREA_LAYERS:], config.boundary_harmonics),
    ):
        basis = basis_table(config.rings, config.sectors, count, 0.0)
        expected += [*(part.flatten(1) @ basis.T @ basis).numpy()]
    scale = np.linalg.norm(expected) / np.linalg.norm(targets)
    np.testing.assert_allclose(targets * scale, expected, atol=1e-5)


def test_a_photograph_goes_into_a_fused_file(page, site):
    """The colours of the labels are as far apart as a PNG keeps them: no pixel may differ."""
    config = CONFIGS["default"]
    fuse(Segmenter(colour_network(), SPACE, PLAIN), config, site / "place.onnx")
    labels = np.stack([street(seed, 60, 90) for seed in range(3)])
    seen, names = map(Seen, SSRVLAD(config)(labels).numpy()), [f"photos/{n}" for n in range(3)]
    save(site / "photos.npy", [*seen], names, {"ssr-vlad": config.fingerprint})
    Image.fromarray(photo(labels[1])).save(site / "photo.png")
    (best, *_), (score, *_) = matches_of(
        page, "?model=place.onnx&database=photos.npy&labels=photo.png"
    )
    assert (best, score) == ("photos/1", pytest.approx(1, abs=1e-4))
    assert page.run(GOLDEN).startswith("golden pair: largest")
    shown = Image.open(site / "photo.png")
    shown.putalpha(254)
    shown.save(site / "alpha.png")
    open_page(page, "?model=place.onnx&labels=alpha.png", f"{SHOWN} || {FAILED}")
    assert failure(page).startswith("the picture has transparent pixels")


def test_features_are_fused_with_the_descriptor_as_in_python(page, site, drives):
    shutil.copy(drives / "place.onnx", site / "street.onnx")
    frames, scores = write_town(drives, site / "town.npy")[2]
    shutil.copy(drives / "today" / "5.png", site / "street.png")
    query = "?model=street.onnx&database=town.npy&labels=street.png"
    assert matches_of(page, query) == (frames, pytest.approx(scores, abs=1e-4))
    assert page.run(STATUS).endswith("Scores are of descriptor, features, hog together.")
    other = site / "town.npy.features.npy.fingerprint.txt"
    other.write_text("others")
    open_page(page, query, FAILED)
    assert 'the database has features "others", the model "16 x 16' in page.run(STATUS)
    (site / "town.npy.features.npy").unlink()
    open_page(page, query, SHOWN)
    assert "Only the model has features: matched without." in page.run(STATUS)
    edit_golden(site / "street.onnx", site / "wrong.onnx", turned("features"))
    open_page(page, "?model=wrong.onnx", FAILED)
    assert "% of the features differ" in page.run(STATUS)


def test_a_golden_pair_that_comes_out_otherwise_is_refused(page, site):
    file = site / "wrong.onnx"
    edit_golden(site / "default.onnx", file, turned("labels"))
    os.utime(file, (0, 0))  # browsers keep old files for long
    query = f"?model=wrong.onnx&labels=maps/{files_of(site)[0].name}"
    open_page(page, query)
    assert "computed wrong in this browser: golden pair" in failure(page)
    open_result(page, f"{query}&unchecked")
    assert page.run(GOLDEN) == "The golden pair was not run."
    shutil.copy(site / "default.onnx", file)
    os.utime(file, (1, 1))
    open_result(page, query)  # by the file that the server has now


def test_files_are_chosen_and_what_is_wrong_is_said(page, site):
    open_page(page)
    labels, base = files_of(site)[0], site / "paper.npy"
    page.wait_for("document.getElementById('status')")
    page.choose("#model-file", site / "paper.onnx")
    page.wait_for(GOLDEN)
    page.choose("#labels-file", labels)
    page.wait_for(SHOWN)
    page.choose("#database-file", base)
    assert "paper.npy.frames.txt together" in failure(page)
    page.choose("#database-file", base, *site.glob("paper.npy.*.txt"))
    page.wait_for(f"{SHOWN} && {ROWS}.length === 5")
    page.choose("#database-file", site / "default.npy", *site.glob("default.npy.*.txt"))
    assert CONFIGS["default"].fingerprint in failure(page)


def test_unknown_ids_and_files_of_another_kind(page, site, tmp_path):
    strange = np.full((6, 9), 11, np.uint8)
    strange[0, :4] = 99
    Image.fromarray(strange).save(tmp_path / "strange.png")
    (tmp_path / "other.onnx").write_bytes((site / "paper.onnx").read_bytes()[:500])
    open_page(page, "?model=paper.onnx", GOLDEN)
    page.choose("#labels-file", tmp_path / "strange.png")
    assert failure(page).startswith("4 pixels have an id outside")
    page.choose("#model-file", tmp_path / "other.onnx")
    page.wait_for(f"{FAILED} && {FAILED}.textContent.includes('cut short')")


def test_a_file_of_fixed_size_takes_no_other(page, site, tmp_path):
    file = files_of(site)[0]
    shape = (1, *np.asarray(Image.open(file)).shape)
    export_head(CONFIGS["default"], site / "fixed.onnx", "labels", "int32", (), shape)
    Image.fromarray(np.zeros((6, 9), np.uint8)).save(tmp_path / "other.png")
    open_page(page, "?model=fixed.onnx", GOLDEN)
    found = described(page, site, "fixed", file)
    expected = view_of(site, "default").descriptor[0]
    np.testing.assert_allclose(found["descriptor"], expected, rtol=0, atol=1e-6)
    page.choose("#labels-file", tmp_path / "other.png")
    assert f"takes label maps of {shape}, got (1, 6, 9)" in failure(page)


def test_label_pictures_are_read_bit_by_bit(page, site):
    """Every depth, every filter of PNG, and palettes, against Pillow or the pixels written."""
    rng = np.random.default_rng(0)
    pictures = {}
    for bits in (8, 16):
        pixels = rng.integers(0, 1 << bits, (7, 13))
        write_png(site / f"gray{bits}.png", pixels, GRAY, bits)
        pictures[f"gray{bits}"] = pixels
    for bits in (1, 2, 4, 8):
        pixels = rng.integers(0, 1 << bits, (5, 11)).astype(np.uint8)
        image = Image.fromarray(pixels, "P")
        image.putpalette(rng.permutation(768).astype(np.uint8).tolist())
        image.save(site / f"palette{bits}.png", bits=bits)
        pictures[f"palette{bits}"] = pixels
    smooth = np.add.outer(np.arange(60), np.arange(80)).astype(np.uint8)
    smooth[::7] = rng.integers(0, 256, smooth[::7].shape)
    Image.fromarray(smooth).save(site / "filtered.png", optimize=True)
    pictures["filtered"] = smooth
    for name, (indices, colours, ids) in PALETTES.items():
        write_palette(site / f"{name}.png", indices, colours)
        pictures |= {name: np.array([ids])} if isinstance(ids, list) else {}
    open_page(page)
    for name, pixels in pictures.items():
        found = page.run(reading(name))
        np.testing.assert_array_equal(np.array(found).reshape(pixels.shape), pixels, name)
    write_png(site / "colour.png", np.zeros((2, 2, 3), int), COLOUR, 8)
    with pytest.raises(AssertionError, match="expected a PNG of gray"):
        page.run(reading("colour"))
    for name in PALETTES.keys() - pictures:
        with pytest.raises(AssertionError, match="the palette shows index"):
            page.run(reading(name))


def reading(name):
    return f"""(async () => {{
        const {{ readLabels }} = await import('./label_png.js');
        const answer = await fetch(encodeURIComponent({json.dumps(name)}) + '.png');
        const file = await answer.arrayBuffer();
        return Array.from((await readLabels(new Uint8Array(file), {CLASSES})).labels);
    }})()"""


def test_nothing_is_wider_than_the_window(page, site, tmp_path):
    query = f"?model=default.onnx&database=default.npy&labels=maps/{files_of(site)[1].name}"
    open_page(page, query, SHOWN)
    for width in (1280, 390):
        page.screenshot(tmp_path / "page.png", width)
        assert Image.open(tmp_path / "page.png").height > 900
        assert page.run("document.documentElement.scrollWidth <= innerWidth")
