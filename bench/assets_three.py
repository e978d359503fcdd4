"""Mesh files as three.js shows them in Chromium: its own glTF loader, its physical material, its prefiltered light."""

from __future__ import annotations

import base64
import functools
import http.server
import shutil
import threading
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError

Array = npt.NDArray[Any]

_PAGE = """<!doctype html><canvas id="c"></canvas><script type="importmap">{"imports":
{"three":"/three/build/three.module.js","three/addons/":"/three/examples/jsm/"}}</script><script type="module">
import * as THREE from 'three';
import {GLTFLoader} from 'three/addons/loaders/GLTFLoader.js';
const renderer = new THREE.WebGLRenderer({canvas: document.getElementById('c'), antialias: true,
  preserveDrawingBuffer: true});
renderer.toneMapping = THREE.NoToneMapping;
renderer.outputColorSpace = THREE.SRGBColorSpace;
let light = null;
window.environment = async (url, width, height) => {
  const data = new Float32Array(await (await fetch(url)).arrayBuffer());
  const map = new THREE.DataTexture(data, width, height, THREE.RGBAFormat, THREE.FloatType);
  map.mapping = THREE.EquirectangularReflectionMapping;
  map.minFilter = map.magFilter = THREE.LinearFilter;
  map.needsUpdate = true;
  light = new THREE.PMREMGenerator(renderer).fromEquirectangular(map).texture;
};
window.show = async (url, view) => {
  const loaded = await new GLTFLoader().loadAsync(url);
  const scene = new THREE.Scene();
  scene.environment = light;
  scene.background = new THREE.Color().setRGB(...view.background, THREE.SRGBColorSpace);
  scene.add(loaded.scene);
  renderer.setSize(view.size, view.size, false);
  const camera = new THREE.PerspectiveCamera(view.fov, 1, view.near, view.far);
  camera.position.set(...view.eye);
  camera.up.set(0, 1, 0);
  camera.lookAt(...view.center);
  renderer.render(scene, camera);
  renderer.render(scene, camera);
  return document.getElementById('c').toDataURL('image/png');
};
window.ready = true;
</script>"""

_FLAGS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


class ThreePage:
    """A page that shows one file after another; a context."""

    def __init__(self, package: Path, models: Path, work: Path, radiance: Array) -> None:
        """Start a server on this machine and a browser.

        Args:
            package: The unpacked npm package three.
            models: The folder of the files.
            work: A folder for what the page reads.
            radiance: Latlong environment, (h, 2 h, 3), z up.
        """
        browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
        if browser is None or not (package / "build/three.module.js").is_file():
            raise UsageError(f"three.js needs Chromium, and the npm package three unpacked in {package}")
        from playwright.sync_api import sync_playwright

        folders = {"three": package, "models": models, "page": work}
        (work / "index.html").write_text(_PAGE)
        # three.js looks along +y up; its columns grow toward +z, which is our -y, and its row 0 is the bottom.
        flipped = np.concatenate([radiance[::-1, ::-1], np.ones((*radiance.shape[:2], 1))], axis=-1)
        (work / "light.bin").write_bytes(np.ascontiguousarray(flipped, np.float32).tobytes())

        class Handler(http.server.SimpleHTTPRequestHandler):
            def translate_path(self, path: str) -> str:
                from urllib.parse import unquote

                head, _, rest = unquote(path.split("?")[0]).lstrip("/").partition("/")
                return str(folders.get(head, work) / rest)

            def log_message(self, *arguments: Any) -> None:
                pass

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler))
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self._root = f"http://127.0.0.1:{self._server.server_address[1]}"
        self._playwright = sync_playwright().start()
        self._browser = self._playwright.chromium.launch(executable_path=browser, args=_FLAGS)
        self._page = self._browser.new_page()
        self._page.set_default_timeout(300_000)
        self._page.goto(f"{self._root}/page/index.html")
        self._page.wait_for_function("window.ready")
        height, width = radiance.shape[:2]
        self._page.evaluate("([u, w, h]) => window.environment(u, w, h)", ["/page/light.bin", width, height])

    def __enter__(self) -> ThreePage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._browser.close()
        self._playwright.stop()
        self._server.shutdown()

    def render(self, name: str, view: dict[str, Any]) -> Array:
        """A picture of a file below the folder of models, (size, size, 3) RGB of 8 bits."""
        url = self._page.evaluate("([u, v]) => window.show(u, v)", [f"/models/{name}", view])
        data = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
        return np.ascontiguousarray(picture[..., ::-1])
