"""The page in a headless Chromium against the module; needs Chromium and npm."""

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from drawings import SPACE
from exported import SWEPT, edit_golden, turned, write_city_in_space
from helpers import COLOUR, GRAY, PALETTES, street, write_map, write_maps, write_palette, write_png
from loop_streams import objects
from networks import photo, write_moved_drives
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from ssrvlad_place.database import save
from ssrvlad_place.model import Description

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, export_head, match
from ssrvlad_torch.cli.summaries import steps_in_words
from ssrvlad_torch.deployment.fuse import fuse
from ssrvlad_torch.files import natural_key
from ssrvlad_torch.stages.boundaries import AREA_LAYERS, DIRECTIONS
from ssrvlad_torch.stages.harmonics import basis_table
from ssrvlad_torch.taxonomy import CATEGORIES, label_space

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
STEPS = "document.getElementById('steps').textContent"
CONFIDENCE = "document.getElementById('confidence').textContent"
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


@pytest.fixture(scope="module", autouse=True)
def maps_and_databases(site):
    """Six label maps beside the page, and a database of them for each preset."""
    write_maps(site / "maps", range(6))
    for preset, config in CONFIGS.items():
        seen = map(Description, view_of(site, preset).descriptor.numpy())
        names = [f"maps/{file.stem}" for file in files_of(site)]
        save(site / f"{preset}.npy", [*seen], names, {"ssr-vlad": config.fingerprint})


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


def drop(page, query, *files):
    """Opens the page, drops files on it once it asks for them, and waits for its answer."""
    open_page(page, query, f"/choose (label maps|photographs)\\.$/i.test({STATUS})")
    page.drop(*files)
    page.wait_for(f"{SHOWN} || {FAILED}")


def failure(page):
    """What the page says once it has failed."""
    page.wait_for(FAILED)
    return page.run(f"{FAILED}.textContent")


def described(page, model, file):
    """What the page's own modules say about a label map: the descriptor, and the targets."""
    return page.run(f"""(async () => {{
        const {{ Model }} = await import('./model.js');
        const {{ readLabels }} = await import('./label_png.js');
        const {{ targetsOf }} = await import('./targets.js');
        const bytes = async (a) => new Uint8Array(await (await fetch(a)).arrayBuffer());
        const model = await Model.load(await bytes('{model}.onnx'));
        const {{ descriptor }} = await model.describe(await readLabels(await bytes('{file}')));
        const targets = targetsOf(model.config, descriptor, {json.dumps(CATEGORIES)});
        return [Array.from(descriptor), targets.map(({{ values }}) => Array.from(values))];
    }})()""")


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


def test_targets_are_parts_of_the_descriptor(page, site):
    """Those of the paper are its layers; the others the histograms as far as the basis tells."""
    open_page(page)
    descriptor, targets = described(page, "paper", "maps/004.png")
    np.testing.assert_allclose(np.ravel(targets), descriptor, atol=1e-6, rtol=0)
    _, targets = described(page, "default", "maps/004.png")
    assert_smooth_parts(np.array(targets), view_of(site, "default").histograms.bins[4])


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


def test_a_photograph_goes_into_a_fused_file(page, site, coloured):
    """The colours of the labels are as far apart as a PNG keeps them: no pixel may differ."""
    config = CONFIGS["default"]
    shutil.copy(coloured / "place.onnx", site)
    labels = np.stack([street(seed, 60, 90) for seed in range(3)])
    seen, names = (
        map(Description, SSRVLAD(config)(labels).numpy()),
        [f"photos/{n}" for n in range(3)],
    )
    save(site / "photos.npy", [*seen], names, {"ssr-vlad": config.fingerprint})
    Image.fromarray(photo(labels[1])).save(site / "photo.png")
    (best, *_), (score, *_) = matches_of(
        page, "?model=place.onnx&database=photos.npy&labels=photo.png"
    )
    assert (best, score) == ("photos/1", pytest.approx(1, abs=1e-4))
    assert page.run(GOLDEN).startswith("golden pair: largest")
    linear = PngInfo()
    linear.add(b"gAMA", (100_000).to_bytes(4, "big"))
    Image.fromarray(photo(labels[1])).save(site / "linear.png", pnginfo=linear)
    query = "?model=place.onnx&database=photos.npy&labels="
    plain = matches_of(page, f"{query}photo.png")
    assert matches_of(page, f"{query}linear.png") == plain, "colours are taken as they are stored"
    shown = Image.open(site / "photo.png")
    shown.putalpha(254)
    shown.save(site / "alpha.png")
    open_page(page, "?model=place.onnx&labels=alpha.png", f"{SHOWN} || {FAILED}")
    assert failure(page).startswith("alpha.png: the picture has transparent pixels")


def test_features_of_one_side_only_and_of_another_network(page, site, drives, ssrvlad):
    shutil.copy(drives / "place.onnx", site / "street.onnx")
    write_map(ssrvlad, site / "town.npy", drives / "monday", segmenter=drives / "net.yaml")
    shutil.copy(drives / "today" / "5.png", site / "street.png")
    query = "?model=street.onnx&database=town.npy&labels=street.png"
    open_result(page, query)
    assert page.run(STEPS) == (
        "not standardised, no sweep, followed: no, fused: ssr-vlad 0.11 + features 0.67 + "
        "hog 0.22, no confidence: 12 references are too few"
    )
    other = site / "town.npy.features.npy.fingerprint.txt"
    other.write_text("others")
    open_page(page, query, FAILED)
    assert 'the database has features "others", the model "16 x 16' in page.run(STATUS)
    (site / "town.npy.features.npy").unlink()
    open_page(page, query, SHOWN)
    assert page.run(STATUS).endswith("; only the model has features: matched without.")
    edit_golden(site / "street.onnx", site / "wrong.onnx", turned("features"))
    open_page(page, "?model=wrong.onnx", FAILED)
    assert "% of the features differ" in page.run(STATUS)


def test_steps_are_told_as_by_query(page, site, ssrvlad, tmp_path):
    """Of a few files, of the way back with a camera that is turned, and of one file."""
    city = write_city_in_space(tmp_path / "city", frames=34, size=(60, 80), seed=3)
    database = write_map(ssrvlad, site / "city.npy", city / "reference")
    write_heads(site / "city")
    files = sorted((city / "query").iterdir())
    several, back = tmp_path / "several", tmp_path / "back"
    several.mkdir()
    back.mkdir()
    for number in (3, 11, 7, 29):
        shutil.copy(files[number], several)
    for number, file in enumerate(reversed(files)):
        labels = np.roll(np.asarray(Image.open(file)), 7, axis=1)
        Image.fromarray(labels).save(back / f"{number}.png")
    for model, source, steps in (
        ("plain", several, "not standardised, no sweep, followed: no, following is no surer"),
        ("swept", back, "standardised, sweep +-4 columns, followed: offline, backwards"),
    ):
        drop(page, f"?model=city.{model}.onnx&database=city.npy", source)
        options = ["--no-sweep"] * (model == "plain")
        [line, *_] = objects(ssrvlad("query", database, source, *options, "--json")[1])
        assert page.run(STEPS) == steps == steps_in_words(line["steps"])
    drop(page, "?model=city.swept.onnx&database=city.npy", files[9])
    [line] = objects(ssrvlad("query", database, files[9], "--follow", "no", "--json")[1])
    assert page.run(ROWS) == [f"{c['frame']}\t{c['score']:.4f}" for c in line["candidates"]]
    assert page.run(CONFIDENCE).endswith(f" {line['confidence']:.2f}")
    assert page.run(STEPS) == steps_in_words(line["steps"])
    assert not page.run("document.getElementById('places').offsetHeight")


def test_a_frame_that_is_chosen_is_shown_and_one_that_is_torn_is_skipped(
    page, site, ssrvlad, drives, tmp_path
):
    query = write_moved_drives(ssrvlad, drives, tmp_path, site / "drive.npy")
    shutil.copy(tmp_path / "place.onnx", site / "drive.onnx")
    lines = objects(ssrvlad(*query)[1])
    (tmp_path / "today" / "40.png").write_bytes(b"torn")
    drop(page, "?model=drive.onnx&database=drive.npy", tmp_path / "today")
    told = re.fullmatch(r"33 frames, \d+ ms each; skipped (.*)", page.run(STATUS))
    assert told and told[1].startswith("1 of 34 frames: today/40.png: ")
    steps = steps_in_words(lines[0]["steps"] | {"camera": {}})  # the page does not look at it
    assert page.run(STEPS) == re.sub(r"sweep \S+ columns", "no sweep", steps)
    assert "features 0.9" in steps
    button = "document.querySelectorAll('#places button')[7]"
    page.run(f"{button}.focus(); {button}.click()")
    page.wait_for("document.getElementById('frame').textContent === '9.png'")
    page.wait_for(f"{ROWS}[0].startsWith('{lines[7]['candidates'][0]['frame']}')")
    assert page.run(CONFIDENCE).endswith(f" {lines[7]['confidence']:.2f}")
    assert page.run(f"document.activeElement === {button}"), "the list is not made anew"
    config = SSRVLADConfig(labels_as="camvid-11")
    fuse(tmp_path / "net.yaml", config, site / "bare.onnx", features=False)
    drop(page, "?model=bare.onnx&database=drive.npy", tmp_path / "today" / "9.png")
    lacking = "; only the database has features: matched without; fuse the file again."
    assert page.run(STATUS).endswith(lacking)


def write_heads(path):
    """Heads with and without a sweep."""
    for name, columns in (("swept", SWEPT), ("plain", ())):
        export_head(CONFIGS["default"], Path(f"{path}.{name}.onnx"), dtype="uint8", columns=columns)


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


def test_what_is_no_drive_or_no_map_is_one_line(page, site, tmp_path):
    for folder in ("a", "b"):
        shutil.copytree(site / "maps", tmp_path / "both" / folder)
    open_page(page, "?model=default.onnx", GOLDEN)
    page.drop(tmp_path / "both")
    assert failure(page) == "expected the frames of one drive, got those of both/a/, both/b/"
    for name, rows in (("wide", np.ones((6, 481), "f4")), ("nan", np.full((6, 480), np.nan, "f4"))):
        np.save(site / f"{name}.npy", rows)
        shutil.copy(site / "default.npy.frames.txt", site / f"{name}.npy.frames.txt")
    labels = f"&labels=maps/{files_of(site)[0].name}"
    for query, problem in (
        ("&database=wide.npy", "expected a database of 480 numbers a frame, got 481"),
        ("&database=nan.npy", "descriptor: expected an array of finite numbers"),
    ):
        open_page(page, f"?model=default.onnx{query}{labels}")
        assert failure(page) == problem
    core = (site / "ssrvlad.wasm").rename(tmp_path / "core")
    open_page(page, f"?model=default.onnx&database=default.npy{labels}")
    assert failure(page) == 'no ssrvlad.wasm beside the page: "npm run build" makes it'
    core.rename(site / "ssrvlad.wasm")


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
    content = (site / "gray8.png").read_bytes()
    at = content.index(b"IHDR") + 7  # the last byte of the width
    (site / "damaged.png").write_bytes(content[:at] + b"\x02" + content[at + 1 :])
    with pytest.raises(AssertionError, match="the PNG is damaged: wrong checksum of IHDR"):
        page.run(reading("damaged"))


def reading(name):
    return f"""(async () => {{
        const {{ readLabels }} = await import('./label_png.js');
        const answer = await fetch(encodeURIComponent({json.dumps(name)}) + '.png');
        const file = await answer.arrayBuffer();
        return Array.from((await readLabels(new Uint8Array(file), {CLASSES})).labels);
    }})()"""


def test_frames_have_the_order_of_encode(page):
    names = ["000010-1", "000010", "a1", "B1", "img_2", "img-1", "12.5", "12.25", "2", "10"]
    names += ["001", "01", "1", "02", "e\u0301", "\u00e9", "z", "frame10", "frame9"]
    open_page(page)
    order = f"import('./frames.js').then(({{ inOrder }}) => {json.dumps(names)}.sort(inOrder))"
    assert page.run(order) == sorted(names, key=natural_key)


def test_a_gray_label_map_is_no_photograph(page, site, drives):
    shutil.copy(drives / "place.onnx", site / "street.onnx")
    Image.fromarray(street(1, 60, 90).astype(np.uint8)).save(site / "gray.png")
    open_page(page, "?model=street.onnx&labels=gray.png")
    assert failure(page) == "gray.png: expected a photograph, got a label map"


def test_nothing_is_wider_than_the_window(page, site, tmp_path):
    query = f"?model=default.onnx&database=default.npy&labels=maps/{files_of(site)[1].name}"
    open_page(page, query, SHOWN)
    for width in (1280, 390):
        page.screenshot(tmp_path / "page.png", width)
        assert Image.open(tmp_path / "page.png").height > 900
        assert page.run("document.documentElement.scrollWidth <= innerWidth")
