"""Scenes of label maps and of pictures, and every program that finds places or loops in them."""

import shutil
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import loops_onnx
import numpy as np
import pytest
import run_onnx
from built import Fixtures
from drawings import SPACE
from exported import SWEPT, of_preset, write_city_in_space
from helpers import outcome, write_map
from loop_streams import CAMVID, CONFIG, SECOND, objects, picture, write_drive
from networks import write_moved_drives, write_other_drives
from oracles import loops as oracle
from PIL import Image
from ssrvlad_place.model import TRUST
from ssrvlad_ros.live_loops import LiveLoops
from ssrvlad_ros.place_model import PlaceModel

from ssrvlad_torch import SSRVLAD, export_head
from ssrvlad_torch.channels.channel import new_channels
from ssrvlad_torch.database.frames import FrameSet
from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.encoding.encoder import encode_to_memory
from ssrvlad_torch.native.loops import Channel
from ssrvlad_torch.native.map import DescriptorMap
from ssrvlad_torch.segmentation.segmenter import Segmenter

Lines = list[dict[str, Any]]


class Scene(NamedTuple):
    """Files: a model, folders of frames, a map in NumPy's form and the folders of its frames; the
    columns of a sweep. Maps are in the order of a database, by name."""

    model: Path
    folders: Sequence[Path]
    town: Path | None = None
    maps: Sequence[Path] = ()
    columns: Sequence[int] = ()


def arrays_of(scene: Scene) -> list[Path]:
    """The folders of a scene as arrays, which C++ reads."""
    folders = [scene.model.parent / "arrays" / folder.name for folder in scene.folders]
    for folder, source in zip(folders, scene.folders, strict=True):
        if folder.exists():
            continue
        folder.mkdir(parents=True)
        for file in source.iterdir():
            np.save(folder / f"{file.stem}.npy", np.asarray(Image.open(file)))
    return folders


# ---- places


def of_label_maps(folder: Path, fixtures: Fixtures, swept: bool = False) -> Scene:
    """Two sequences in a map of two; swept, the first is the way back with a turned camera."""
    city = write_city_in_space(folder / "city", frames=36, size=(60, 80), seed=3)
    other = write_city_in_space(folder / "b", frames=12, size=(60, 80), seed=1)
    maps = (other / "reference").rename(folder / "other"), city / "reference"
    town, model = folder / "town.npy", folder / "head.onnx"
    write_map(fixtures("ssrvlad"), town, *maps)
    columns = SWEPT if swept else ()
    export_head(of_preset("default"), model, columns=columns)
    here, there = folder / "today", (other / "query").rename(folder / "elsewhere")
    here.mkdir()
    files = sorted((city / "query").iterdir())
    for number, file in enumerate(files[::-1] if swept else files):
        labels = np.asarray(Image.open(file))
        Image.fromarray(np.roll(labels, 7, 1) if swept else labels).save(here / f"{number}.png")
    return Scene(model, [here, there], town, maps, columns)


def of_pictures(folder: Path, fixtures: Fixtures) -> Scene:
    """A sequence moved by two cells, by all channels."""
    town = folder / "town.npy"
    write_moved_drives(fixtures("ssrvlad"), fixtures("drives"), folder, town)
    return Scene(folder / "place.onnx", [folder / "today"], town, [folder / "monday"])


PLACES: dict[str, Callable[[Path, Fixtures], Scene]] = {
    "label maps": of_label_maps,
    "swept label maps": partial(of_label_maps, swept=True),
    "pictures": of_pictures,
}
SINGLE = "single frames"
"""A mode of programs that know of no sequence."""
MODES: dict[str, tuple[object, ...]] = {
    "offline": ("--follow", "offline"),
    "online": ("--follow", "online", "--delay", 3),
    "alone": ("--follow", "no"),
    SINGLE: (),
}


def channels_of(scene: Scene, folder: Path, columns: Sequence[int] = ()) -> FrameSet:
    """The frames of a folder by all channels that the package has of a scene."""
    head, segmenter = SSRVLAD(of_preset("default")), None
    if scene.model.name == "place.onnx":
        segmenter = Segmenter.load(scene.model.with_name("net.yaml"), SPACE)
    channels, files = new_channels(None, head, segmenter), find_image_files([str(folder)])
    space = head.label_space
    return encode_to_memory(channels, space, files, 1, segmenter=segmenter, columns=columns)[0]


def by_the_core(scene: Scene, mode: str, columns: Sequence[int]) -> Lines:
    """The answers of the core to the descriptors of the package, from some columns of a sweep."""
    maps, lines = [channels_of(scene, folder) for folder in scene.maps], []
    town = DescriptorMap([len(rows.frames) for rows in maps])
    frames = [frame for rows in maps for frame in rows.frames]
    for name in maps[0].channels:
        rows = np.concatenate([part.channels[name].numpy() for part in maps])
        town.add(name, rows, TRUST[name])
    follow, delay = {"offline": ("offline", 0), "online": ("online", 3)}.get(mode, (None, 0))
    for folder in scene.folders:
        queries = channels_of(scene, folder, columns)
        arrays = {name: array.numpy() for name, array in queries.channels.items()}
        count = len(queries.frames)
        for first in range(0, count, 1 if mode == SINGLE else count):
            asked = slice(first, first + 1 if mode == SINGLE else count)
            part = {name: array[asked] for name, array in arrays.items()}
            decision = town.query(part, follow=follow, delay=delay, top=3)
            lines += lines_of(queries.frames[asked], frames, decision, len(arrays))
    return lines


def lines_of(queries: Sequence[str], frames: list[str], decision: Any, channels: int) -> Lines:
    """A decision as the programs print it."""
    alone, lines = "fused score" if channels > 1 else "cosine", []
    columns = queries, decision.rows, decision.scores, decision.right, decision.follows
    for query, rows, scores, sure, follows in zip(*columns, strict=True):
        ranked = [
            {"frame": frames[row], "score": min(1, float(score))}
            for row, score in zip(rows, scores, strict=True)
            if row >= 0
        ]
        score_is = "probability" if follows else alone
        line = {"query": query, "candidates": ranked, "score_is": score_is}
        lines.append({**line, "confidence": float(sure)})
    return lines


def by_query(scene: Scene, mode: str, fixtures: Fixtures) -> Lines:
    """`ssrvlad query`."""
    sweep = () if scene.columns else ("--no-sweep",)
    words = ("query", scene.town.with_suffix(".ssrdb"), *scene.folders, *sweep, *MODES[mode])
    code, out, err = fixtures("ssrvlad")(*words, "--top", 3, "--json")
    assert (code, err) == (0, [])
    return objects(out)


def files_of(scene: Scene, split: bool) -> tuple[object, ...]:
    """The model, or the network's file and the head's."""
    network, head = (scene.model.with_name(f"{name}.onnx") for name in ("net", "head"))
    return ("--network", network, head) if split else (scene.model,)


def by_python(scene: Scene, mode: str, fixtures: Fixtures, split: bool = False) -> Lines:
    """`run_onnx.py`."""
    files = (*files_of(scene, split), *scene.folders, "--database", scene.town)
    words = (*files, *MODES[mode], "--top", 3, "--json")
    code, out, err = fixtures("main_of")(run_onnx.main, "run_onnx.py", *words)
    assert (code, err) == (0, [])
    return objects(out)


def by_cpp(scene: Scene, mode: str, fixtures: Fixtures, split: bool = False) -> Lines:
    """`follow` of C++, or `place`, of a few frames."""
    build, model, folders = fixtures("user") / "build", files_of(scene, split), arrays_of(scene)
    if mode != SINGLE:
        options = {"online": ("--online", "--delay", 3), "alone": ("--alone",)}.get(mode, ())
        words = (*options, *model, scene.town, 3, *folders)
        code, lines, errors = outcome(build / "follow", *words)
        assert (code, errors) == (0, [])
        return objects("\n".join(lines))
    answers = []
    for folder in folders:
        for file in sorted(folder.iterdir())[:4]:
            code, [_, *ranked], errors = outcome(build / "place", *model, file, scene.town, 3)
            assert (code, errors) == (0, [])
            pairs = [line.split() for line in ranked]
            found = [{"frame": frame, "score": float(score)} for frame, score in pairs]
            answers.append({"query": f"{folder.name}/{file.stem}", "candidates": found})
    return answers


def live(program: str, scene: Scene, fixtures: Fixtures) -> Callable[[object], list[str]]:
    """The command of a program that follows a source online, two frames late."""
    late = ("--delay", 2)

    def command(source: object) -> list[str]:
        if program == "C++":
            follow = fixtures("user") / "build" / "follow"
            return [*map(str, (follow, "--online", *late, scene.model, scene.town, 3, source))]
        words = (scene.model, source, "--database", scene.town, "--follow", "online", *late)
        return [*map(str, (sys.executable, run_onnx.__file__, *words, "--json"))]

    return command


SHOWN = """Array.from(document.querySelectorAll('#places tbody tr'),
    (row) => Array.from(row.cells, (cell) => cell.innerText))"""


def by_page(scene: Scene, mode: str, fixtures: Fixtures) -> Lines:
    """The page in a browser, on which each folder is dropped; it shows the first candidate."""
    page, site, lines = fixtures("page"), fixtures("site"), []
    for file in site.glob(f"{scene.town.name}*"):  # of other tests
        file.unlink()
    for file in (scene.model, *scene.town.parent.glob(f"{scene.town.name}*")):
        shutil.copy(file, site)
    status = "document.getElementById('status')"
    done = f"!document.getElementById('result').hidden || {status}.classList.contains('error')"
    for folder in scene.folders:
        query = f"?model={scene.model.name}&database={scene.town.name}"
        ready = f"/choose (label maps|photographs)\\.$/i.test({status}.textContent)"
        page.open(f"{page.address}{query}", ready)
        page.drop(folder)
        page.wait_for(done)
        for name, place, score, confidence in page.run(SHOWN):
            found = [{"frame": place, "score": float(score)}]
            frame = f"{folder.name}/{Path(name).stem}"
            lines.append({"query": frame, "candidates": found, "confidence": float(confidence)})
    return lines


FOLLOWERS = {
    "run_onnx.py": by_python,
    "run_onnx.py, two files": partial(by_python, split=True),
    "C++": by_cpp,
    "C++, two files": partial(by_cpp, split=True),
    "ssrvlad query": by_query,
    "page": by_page,
}
RARE = {("swept label maps", "alone"), ("swept label maps", SINGLE), ("pictures", "alone")}
"""Run no code that the other scenes and modes do not."""
ASKED = [
    *(
        pytest.param(name, scene, mode, marks=[pytest.mark.slow] * ((scene, mode) in RARE))
        for name in ("run_onnx.py", "C++")
        for scene in PLACES
        for mode in MODES
    ),
    *((f"{name}, two files", "pictures", "offline") for name in ("run_onnx.py", "C++")),
    *(("ssrvlad query", scene, mode) for scene in [*PLACES][:2] for mode in [*MODES][:3]),
    *(("page", scene, "offline") for scene in PLACES),
]
"""Programs, scenes and modes."""


# ---- loops


def of_a_stream(folder: Path, fixtures: Fixtures) -> Scene:
    """Forty label maps, and fourteen of them again."""
    export_head(of_preset("default"), folder / "head.onnx")
    return Scene(folder / "head.onnx", [write_drive(folder / "stream")])


def of_two_drives(folder: Path, fixtures: Fixtures) -> Scene:
    """Pictures of twenty places, and of fourteen of them again."""
    write_other_drives(fixtures("drives"), folder, range(20), range(4, 18))
    return Scene(folder / "place.onnx", [folder / "monday", folder / "today"])


LOOPS: dict[str, Callable[[Path, Fixtures], Scene]] = {
    "label maps": of_a_stream,
    "pictures": of_two_drives,
}
SETTINGS = ("--exclude", CONFIG.exclude, "--threshold", CONFIG.threshold)


def loops_by_oracle(scene: Scene) -> Lines:
    """The loops that the formulas find in the descriptors of the package."""
    parts = [channels_of(scene, folder) for folder in scene.folders]
    arrays = {
        name: np.concatenate([part.channels[name].numpy() for part in parts])
        for name in parts[0].channels
    }
    forms = [
        Channel(name, array.shape[1:], str(array.dtype), TRUST[name])
        for name, array in arrays.items()
    ]
    names = [frame for part in parts for frame in part.frames]
    stream, lines, last = oracle.Loops(forms, CONFIG.exclude, CONFIG.threshold), [], ""
    for row, name in enumerate(names):
        frame = {form.name: arrays[form.name][row] for form in forms}
        sequence = name.rpartition("/")[0]
        step = stream.update(frame, sequence != last)
        lines.append(line_of(name, *step, names))
        last = sequence
    return lines


def line_of(frame, reason, candidate, score, probability, places, names) -> dict[str, Any]:
    """A step as the programs print it."""
    likely = [{"frame": names[row], "confidence": chance} for row, chance in places]
    found = {"candidate": None if candidate is None else names[candidate], "candidates": likely}
    return {"frame": frame, "reason": reason, "score": score, "confidence": probability, **found}


def loops_by_command(scene: Scene, fixtures: Fixtures) -> Lines:
    """`ssrvlad loops`."""
    network = scene.model.with_name("net.yaml")
    kind = ("--segmenter", network) if network.exists() else ("--labels-as", SPACE)
    words = (*scene.folders, *kind, *SETTINGS, "--no-sweep", "--json", "--workers", 1)
    code, out, err = fixtures("ssrvlad")("loops", *words)
    assert (code, err) == (0, [])
    return objects(out)


def loops_by_python(scene: Scene, fixtures: Fixtures, split: bool = False) -> Lines:
    """`loops_onnx.py`."""
    words = (*files_of(scene, split), *scene.folders, *SETTINGS)
    code, out, err = fixtures("main_of")(loops_onnx.main, "loops_onnx.py", *words)
    assert (code, err) == (0, [])
    return objects(out)


def loops_by_cpp(scene: Scene, fixtures: Fixtures, split: bool = False) -> Lines:
    """`loops` of C++."""
    words = (*SETTINGS, *files_of(scene, split), *arrays_of(scene))
    code, lines, errors = outcome(fixtures("user") / "build" / "loops", *words)
    assert (code, errors) == (0, [])
    return objects("\n".join(lines))


def loops_by_ros(scene: Scene, fixtures: Fixtures, split: bool = False) -> Lines:
    """The core of the ROS 2 node, of one sequence a folder; of two files it takes the network's."""
    file = scene.model.with_name("net.onnx") if split else scene.model
    model = None if file.name == "head.onnx" else PlaceModel(file)
    node, number, lines, names = LiveLoops(CONFIG, model=model), 0, [], {}
    if model is None:
        node.set_labels(CAMVID)
    for folder in scene.folders:
        node.sequence = folder.name
        for file in find_image_files([str(folder)]):
            pixels = np.asarray(Image.open(file.path))
            encoding = "mono8" if model is None else "rgb8"
            result = node.update(picture(pixels, encoding), number * SECOND).result.as_json()
            names[result["frame"]] = file.frame
            lines.append(result)
            number += 1
    return [_renamed(line, names) for line in lines]


def _renamed(line: dict[str, Any], names: dict[str, str]) -> dict[str, Any]:
    """With the ids of files in the place of those of stamps."""
    places = [{**place, "frame": names[place["frame"]]} for place in line["candidates"]]
    candidate = line["candidate"] and names[line["candidate"]]
    return {**line, "frame": names[line["frame"]], "candidate": candidate, "candidates": places}


CLOSERS = {
    "ssrvlad loops": loops_by_command,
    "loops_onnx.py": loops_by_python,
    "C++": loops_by_cpp,
    "ROS 2": loops_by_ros,
}
CLOSED = [(name, scene) for name in CLOSERS for scene in LOOPS]
"""Programs and scenes."""
SPLIT = {"loops_onnx.py": loops_by_python, "C++": loops_by_cpp, "ROS 2": loops_by_ros}
for name, run in SPLIT.items():
    CLOSERS[f"{name}, two files"] = partial(run, split=True)
    CLOSED.append((f"{name}, two files", "pictures"))
