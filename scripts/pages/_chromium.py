"""Runs an exported file on label maps in onnxruntime-web in a headless Chromium, as
`_one_runtime.py` does elsewhere."""

from __future__ import annotations

import json
import re
import statistics
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
from browser import browser, served
from test_export_web import runtime

_OPEN = """(async () => {
  const ort = await import('./node_modules/onnxruntime-web/dist/ort.wasm.min.mjs');
  ort.env.wasm.numThreads = 1;
  const bytes = new Uint8Array(await (await fetch('head.onnx')).arrayBuffer());
  const begin = performance.now();
  window.session = await ort.InferenceSession.create(bytes, { logSeverityLevel: 3 });
  window.ort = ort;
  return [performance.now() - begin, ort.env.versions.web, navigator.userAgent];
})()"""

_RUN = """(async () => {
  const labels = new Uint8Array(await (await fetch('map.bin?%d')).arrayBuffer());
  const begin = performance.now();
  const found = await session.run({ labels: new ort.Tensor('uint8', labels, %s) });
  const taken = performance.now() - begin;
  return [taken, Object.entries(found).map(([name, each]) =>
    [name, each.type, each.dims, Array.from(each.data, Number)])];
})()"""

_REPETITIONS = 5


def run_in_chromium(file: Path, maps: dict[str, npt.NDArray[np.uint8]]) -> dict[str, npt.NDArray]:
    """Outputs of the file for each label map, in the form of `_one_runtime.py`."""
    times: list[float] = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name) / "site"
        folder.mkdir()
        (folder / "node_modules").symlink_to(runtime())
        (folder / "index.html").write_text("<!doctype html>")
        (folder / "head.onnx").write_bytes(file.read_bytes())
        with browser(Path(name) / "profile") as page, served(folder) as address:
            page.open(f"{address}/index.html", "true")
            load, version, agent = page.run(_OPEN)
            (chromium,) = re.findall(r"Chrome/(\d+)", agent)
            title = f"onnxruntime-web {version} (wasm, one thread), Chromium {chromium}"
            found = {"name": np.array(title), "load": np.array(load / 1e3)}
            for turn, number in enumerate([*maps, *[list(maps)[-1]] * _REPETITIONS]):
                (folder / "map.bin").write_bytes(maps[number].tobytes())
                taken, outputs = page.run(_RUN % (turn, json.dumps([1, *maps[number].shape])))
                times.append(taken / 1e3)
                for output, kind, dims, numbers in outputs:
                    found[f"{number} {output}"] = np.array(numbers, kind).reshape(dims)
    return {**found, "taken": np.array(statistics.median(times[-_REPETITIONS:]))}
