"""What is written of every frame beside the picture: the captured light, and the layers."""

from __future__ import annotations

import contextlib
import difflib
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from warp_ar.engine.result import Result
from warp_ar.errors import UsageError
from warp_ar.output.environment_file import EnvironmentSink
from warp_ar.output.layer_file import PICTURES, LayerFrame, LayerSink
from warp_ar.scene import Scene
from warp_ar.scene.names import surface_names
from warp_ar.stages.request import LAYERS


def parse_layers(text: str | None) -> tuple[str, ...]:
    """Names of layers, separated by commas; None or ``all`` means every one.

    Raises:
        UsageError: A name is unknown, or there is none.
    """
    if text is None or text == "all":
        return tuple(LAYERS)
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    for name in names or (text,):
        if name not in LAYERS:
            close = difflib.get_close_matches(name, LAYERS, 1)
            hint = f"did you mean {close[0]!r}? " if close else ""
            raise UsageError(f"--layers: {name!r} is no layer; {hint}expected all, or some of {', '.join(LAYERS)}")
    return names


class SideFiles:
    """Folders of files beside the picture: a context manager, as sinks are."""

    def __init__(
        self,
        *,
        environment: Path | None = None,
        layers: Path | None = None,
        names: tuple[str, ...] = tuple(LAYERS),
        pictures: bool = False,
        overwrite: bool = False,
    ) -> None:
        """Open the folders.

        Args:
            environment: Folder for the captured light of every frame; None: it is not written. Of several mirror balls
                whose light is interpolated, the first one's lies in it, those of the others in folders ``ball_1`` and
                so on below it.
            layers: Folder for layers; None: they are not written.
            names: Which layers.
            pictures: Whether layers that PNG can hold are written as PNG besides.
            overwrite: Whether numbered files that this program did not write may be replaced.

        Raises:
            SinkError: A folder cannot be written to.
        """
        self._stack = contextlib.ExitStack()
        self.outputs: tuple[str, ...] = ()
        """What the pipeline's results must hold for it."""
        self.lights: EnvironmentSink | None = None
        """Takes the captured light."""
        self._other_lights: list[EnvironmentSink] = []
        self._environment, self._overwrite = environment, overwrite
        self._layers: LayerSink | None = None
        with contextlib.ExitStack() as stack:
            if environment is not None:
                self.lights = stack.enter_context(EnvironmentSink(environment, overwrite=overwrite))
                self.outputs += ("environment",)
            if layers is not None:
                held = tuple(name for name in names if name in PICTURES) if pictures else ()
                self._layers = stack.enter_context(LayerSink(layers, overwrite=overwrite, pictures=held))
                self.outputs += names
            self._stack = stack.pop_all()

    @property
    def replaced(self) -> tuple[str, ...]:
        """What is lost by the first frame, in words."""
        return tuple(sink.replaced for sink in (self.lights, self._layers) if sink is not None and sink.replaced)

    @property
    def written(self) -> str:
        """How much of them is stored, in words that begin with a comma; empty where nothing is asked for."""
        lights = "" if self.lights is None else f", and {self.lights.written} environments"
        if self._other_lights:
            lights += f" of each of {len(self._other_lights) + 1} mirror balls"
        return lights if self._layers is None else f"{lights}, and layers of {self._layers.written}"

    def write(self, frame: npt.NDArray[np.uint8], result: Result, scene: Scene) -> None:
        """Take the next frame.

        Args:
            frame: The camera's, uint8 RGB (height, width, 3).
            result: What it became.
            scene: As it was lit, its camera of the frame's size.

        Raises:
            SinkError: An earlier one could not be written.
        """
        if self.lights is not None and result.environment is not None:
            self.lights.write(result.environment)
            for ball, radiance in enumerate(result.environments[1:], 1):
                self._lights_of(ball).write(radiance)
        if self._layers is not None:
            self._layers.write(layer_frame(frame, result, scene))

    def _lights_of(self, ball: int) -> EnvironmentSink:
        """Takes the captured light of a mirror ball after the first; opened where there is some."""
        if ball > len(self._other_lights):
            assert self._environment is not None
            sink = EnvironmentSink(self._environment / f"ball_{ball}", overwrite=self._overwrite)
            self._other_lights.append(self._stack.enter_context(sink))
        return self._other_lights[ball - 1]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()


def layer_frame(frame: npt.NDArray[np.uint8], result: Result, scene: Scene) -> LayerFrame:
    """The layers of a result as files take them; arguments as those of `SideFiles.write`."""
    camera = scene.camera.scaled_to(frame.shape[1], frame.shape[0])
    from_world: Any = None
    if result.pose is not None:
        from_world = np.eye(4)
        from_world[:3, :3], from_world[:3, 3] = result.pose.rotation, result.pose.translation
    return LayerFrame(
        result.layers,
        frame,
        surface_names(scene),
        result.exposure_scale,
        str(camera.transfer),
        from_world,
        camera.matrix(),
    )
