"""The cases of the descriptor, what the reference says of them, and every implementation."""

import json
import re
import shutil
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from built import Fixtures
from drawings import CAR, ROAD, SPACE, TREE, VOID, blobs, degenerate, hand_drawn
from exported import (
    city,
    in_openvino,
    in_space,
    model_of,
    noise,
    of_preset,
    random_blobs,
    session,
    write_categories,
)
from helpers import outcome, write_image
from loop_streams import CAMVID, CONFIG, picture
from ssrvlad_place.model import Model
from ssrvlad_ros.live_loops import LiveLoops

from ssrvlad_torch import SSRVLAD, reference
from ssrvlad_torch.taxonomy import label_space

Maps = list[npt.NDArray[Any]]


class Description(NamedTuple):
    """What an implementation says of a label map: the descriptor ``(480,)``, the number of
    key-points in each layer ``(8,)`` and the skeletons ``(8, h, w)``, where it shows them, and the
    number of pixels with unknown ids; one that refuses the map says nothing else."""

    descriptor: npt.NDArray[np.float32] | None
    keypoints: npt.NDArray[np.int64] | None = None
    skeleton: npt.NDArray[np.bool_] | None = None
    unknown: int = 0


def refused(message: object) -> Description:
    """What a message says of unknown ids."""
    return Description(None, unknown=int(re.search(r"(\d+) (?:of \d+ )?pixels", str(message))[1]))


@cache
def cases() -> dict[str, npt.NDArray[np.uint8]]:
    """Label maps in ``SPACE``: drawn ones, extreme ones, noise, and streets of odd sizes."""
    return {
        **degenerate(),
        **hand_drawn(),
        "one row of cars and road": np.array([[CAR, ROAD, CAR, TREE, VOID]], np.uint8),
        "noise": noise(4),
        "blobs": random_blobs(1)[:77, :131],
        "a panorama": blobs(2, 40, 301, 9),
        "a tower": blobs(4, 211, 37, 12),
        "a street": in_space(next(iter(city(1, 3, (90, 121))))),
    }


@cache
def expected(preset: str) -> dict[str, Description]:
    """What the reference says of the cases."""
    config, described = of_preset(preset), {}
    for name, labels in cases().items():
        traces = [reference.trace(layer, config) for layer in reference.layers_of(labels, config)]
        keypoints = [(trace.end_points | trace.intersections).sum() for trace in traces]
        skeleton = np.stack([trace.skeleton for trace in traces])
        descriptor = reference.describe(labels, config)
        described[name] = Description(descriptor, np.array(keypoints), skeleton)
    return described


# ---- in this process: functions of a batch

Batch = Callable[[npt.NDArray[Any]], list[Description]]


def in_torch(preset: str) -> Batch:
    """The stages in torch."""
    head = SSRVLAD(of_preset(preset))

    def describe(labels: npt.NDArray[Any]) -> list[Description]:
        view = head.explain(labels)
        counts = view.keypoints.sum((2, 3)).numpy()
        return [*map(Description, view.descriptor.numpy(), counts, view.skeleton.numpy())]

    return describe


def in_the_core(preset: str) -> Batch:
    """The module, which calls the native core."""
    head = SSRVLAD(of_preset(preset))
    return lambda labels: [*map(Description, head(labels).numpy())]


def compiled(preset: str) -> Batch:
    """The module compiled by torch."""
    torch.compiler.reset()
    head = torch.compile(SSRVLAD(of_preset(preset)), fullgraph=True, backend="aot_eager")
    return lambda labels: [*map(Description, head(torch.from_numpy(labels)).numpy())]


def _of_file(run: Callable[..., list[Any]]) -> Batch:
    def describe(labels: npt.NDArray[Any]) -> list[Description]:
        descriptors, unknown, *counts = run(labels)
        keypoints = counts[0] if counts else [None] * len(descriptors)
        forms = zip(descriptors, keypoints, unknown.tolist(), strict=True)
        return [Description(one, count, unknown=pixels) for one, count, pixels in forms]

    return describe


@cache
def in_onnxruntime(preset: str, kind: str = "labels", dtype: str | None = None) -> Batch:
    """The exported file in ONNX Runtime."""
    head = session(model_of(of_preset(preset), kind, dtype).SerializeToString())
    return _of_file(lambda labels: head.run(None, {kind: labels}))


@cache
def in_openvino_runtime(preset: str) -> Batch:
    """The exported file in OpenVINO."""
    return _of_file(in_openvino(model_of(of_preset(preset))))


BATCHES: dict[str, Callable[[str], Batch]] = {
    "stages in torch": in_torch,
    "native core": in_the_core,
    "compiled": compiled,
    "ONNX Runtime": in_onnxruntime,
    "OpenVINO": in_openvino_runtime,
}


# ---- programs: functions of label maps and what a program needs

Program = Callable[[str, Maps, Fixtures], list[Description]]


def one_by_one(batch: Callable[[str], Batch]) -> Program:
    def describe(preset: str, maps: Maps, fixtures: Fixtures) -> list[Description]:
        run, described = batch(preset), []
        for labels in maps:
            try:
                described += run(labels[None])
            except ValueError as error:
                described.append(refused(error))
        return described

    return describe


def written(fixtures: Fixtures, preset: str, dtype: str) -> Any:
    """The file of a head for labels of a dtype."""
    path = fixtures("tmp_path") / f"{preset}.{dtype}.onnx"
    path.write_bytes(model_of(of_preset(preset), "labels", dtype).SerializeToString())
    return path


def without_torch(preset: str, maps: Maps, fixtures: Fixtures) -> list[Description]:
    """What run_onnx.py and the other programs in Python see."""
    model, described = Model(written(fixtures, preset, str(maps[0].dtype))), []
    for labels in maps:
        try:
            described.append(Description(model.see_array(labels).descriptor))
        except ValueError as error:
            described.append(refused(error))
    return described


def in_cpp(preset: str, maps: Maps, fixtures: Fixtures) -> list[Description]:
    """`loops` of C++ over ONNX Runtime, which saves what it describes."""
    build, folder = fixtures("user") / "build", fixtures("tmp_path") / "frames"
    memory, head = folder.with_name("m.npy"), written(fixtures, preset, str(maps[0].dtype))
    folder.mkdir()
    for number, labels in enumerate(maps):
        np.save(folder / f"{number}.npy", labels)
    _, _, errors = outcome(build / "loops", "--memory", memory, head, folder)
    described = dict.fromkeys(map(str, range(len(maps))))
    for line in errors[:-1]:
        described[re.search(r"/(\d+)\.npy: ", line)[1]] = refused(line.rpartition(": ")[2])
    for record in np.load(memory) if len(errors) <= len(maps) else ():
        name = record["frame"].decode().rpartition("/")[2]
        described[name] = Description(record["ssr-vlad"].astype(np.float32))
    return [*described.values()]


def in_cpp_over_the_core(preset: str, maps: Maps, fixtures: Fixtures) -> list[Description]:
    """`describe` of C++, without a model file."""
    folder = fixtures("tmp_path")
    categories = write_categories(folder / "categories.npy", SPACE)
    program, described = fixtures("user") / "build-describe" / "describe", []
    for labels in maps:
        np.save(folder / "map.npy", labels)
        code, lines, errors = outcome(program, preset, categories, folder / "map.npy")
        described.append(refused(errors) if code else Description(np.array(lines, np.float32)))
    return described


IN_BROWSER = """(async () => {{
    const {{ Model }} = await import('./model.js');
    const {{ readLabels }} = await import('./label_png.js');
    const bytes = async (name) => new Uint8Array(await (await fetch(name)).arrayBuffer());
    const model = await Model.load(await bytes('{preset}.onnx'));
    const described = [];
    for (let number = 0; number < {count}; number++)
        try {{
            const labels = await readLabels(await bytes(`cases/${{number}}.png`), []);
            const {{ descriptor, keypoints }} = await model.describe(labels);
            described.push([Array.from(descriptor), keypoints]);
        }} catch (error) {{ described.push(error.message); }}
    return described;
}})()"""


def write_cases(maps: Maps, fixtures: Fixtures) -> None:
    """Label maps as pictures beside the page."""
    folder = fixtures("site") / "cases"
    shutil.rmtree(folder, ignore_errors=True)
    for number, labels in enumerate(maps):
        write_image(folder / f"{number}.png", labels)


def in_browser(preset: str, maps: Maps, fixtures: Fixtures) -> list[Description]:
    """The page, by onnxruntime-web."""
    page, described = fixtures("page"), []
    write_cases(maps, fixtures)
    page.open(page.address, "true")
    for said in page.run(IN_BROWSER.format(preset=preset, count=len(maps))):
        if isinstance(said, str):
            described.append(refused(said))
            continue
        numbers, counts = said
        keypoints = None if counts is None else np.array(counts)
        described.append(Description(np.array(numbers, np.float32), keypoints))
    return described


CORE_IN_BROWSER = """(async () => {{
    const {{ ADDRESS, INT, INTERFACE, LONG, Core, Struct }} = await import('./core.js');
    const {{ readLabels }} = await import('./label_png.js');
    const core = await Core.load();
    const sizes = {{ images: LONG, height: LONG, width: LONG }};
    const LABELS = new Struct({{ ids: ADDRESS, bytes: INT, ...sizes }});
    const TABLE = new Struct({{ categories: ADDRESS, entries: LONG, origin: LONG }});
    const described = [];
    for (let number = 0; number < {count}; number++) {{
        const file = await (await fetch(`cases/${{number}}.png`)).arrayBuffer();
        const {{ labels, height, width }} = await readLabels(new Uint8Array(file), []);
        described.push(core.using(({{ room, put }}) => {{
            const settings = room(256), descriptor = room(480 * 4);
            core.call("ssrvlad_preset", put(new TextEncoder().encode("{preset}\\0")), settings);
            const head = core.call("ssrvlad_new_for", INTERFACE, settings);
            const map = {{ ids: put(Uint8Array.from(labels)), bytes: 1, images: 1, height, width }};
            const table = {{ categories: put(Uint8Array.from({categories})), entries: 256 }};
            const parts = [LABELS.bytes(map), TABLE.bytes(table)].map(put);
            const status = core.call("ssrvlad_describe", head, ...parts, 1, descriptor);
            core.call("ssrvlad_free", head);
            return [Number(status), ...core.get(Float32Array, descriptor, 480)];
        }}));
    }}
    return described;
}})()"""


def core_in_browser(preset: str, maps: Maps, fixtures: Fixtures) -> list[Description]:
    """The core as WebAssembly."""
    page = fixtures("page")
    write_cases(maps, fixtures)
    table = np.full(256, 255)
    for label in label_space(SPACE).classes:
        table[label.id] = label.category_index
    page.open(page.address, "true")
    text = json.dumps(table.tolist())
    script = CORE_IN_BROWSER.format(preset=preset, count=len(maps), categories=text)
    return [
        Description(None, unknown=status) if status else Description(np.array(numbers, np.float32))
        for status, *numbers in page.run(script)
    ]


def in_ros(preset: str, maps: Maps, fixtures: Fixtures) -> list[Description]:
    """The core of the ROS 2 node."""
    node, described = LiveLoops(CONFIG, preset=preset), []
    node.set_labels(CAMVID)
    for number, labels in enumerate(maps):
        try:
            described.append(Description(node.update(picture(labels), number).descriptor))
        except ValueError as error:
            described.append(refused(error))
    return described


PROGRAMS: dict[str, Program] = {
    **{name: one_by_one(batch) for name, batch in BATCHES.items()},
    "Python without torch": without_torch,
    "C++ over ONNX Runtime": in_cpp,
    "C++ over the core": in_cpp_over_the_core,
    "browser": in_browser,
    "core in the browser": core_in_browser,
    "ROS 2": in_ros,
}
