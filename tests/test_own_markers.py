"""What rides on a marker of its own: found beside the world's, moved with it, gone while it is lost."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import warp as wp

from tests.test_tracking import CAMERA, look, render
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SceneError
from warp_ar.scene import GridBoard, Light, Marker, Object, Pose, Probe, Proxy, Scene, dumps_scene, loads_scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.ray_scene import HostScene
from warp_ar.stages.quality import PRESETS
from warp_ar.tracking.tracking import Tracker, own_markers, track_markers

WORLD, CARD = Marker(id=0, size=0.08), Marker(id=7, size=0.05)
BOARD = Marker("DICT_4X4_100", board=GridBoard(2, 2, 0.03, 0.01))
# Two measured poses, of markers of 50 mm and of 80 mm, at 0.6 m.
METRES, DEGREES = 1.5e-3, 0.6
ROUNDING = 1e-6

HEADER = """schema = 1
[camera]
width = 640
height = 480
fx = 640.0
fy = 640.0
cx = 319.5
cy = 239.5
"""


def place(x: float, y: float, turn: float) -> Pose:
    """``world_from_marker`` of a card on the desk."""
    return Pose(rotation_matrix((0.0, 0.0, turn)), np.array([x, y, 0.0]))


def test_markers_are_found_where_they_lie() -> None:
    scene = Scene(CAMERA, objects=(Object("sphere", radius=0.01, marker=CARD),), lights=(Light("point", 1.0),))
    camera_from_world = look(25.0, turn=10.0)
    trackers = {marker: Tracker(marker, CAMERA) for marker in own_markers(scene)}
    truth = place(0.12, 0.03, 35.0)
    frame = render((WORLD, camera_from_world), (CARD, camera_from_world.after(truth)))
    found = track_markers(trackers, frame, 0.0, camera_from_world)[CARD]
    assert found is not None
    np.testing.assert_allclose(found.translation, truth.translation, atol=METRES)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=np.radians(DEGREES))
    assert track_markers(trackers, frame, 0.1, None) == {CARD: None}
    nothing = render((WORLD, camera_from_world))
    assert track_markers({CARD: Tracker(CARD, CAMERA)}, nothing, 0.0, camera_from_world) == {CARD: None}


def test_objects_lights_and_proxies_ride(device: str) -> None:
    """Where the marker has them, turned with it, about the mesh's own middle; away and dark while it is lost."""
    ridden = Object("torus", major_radius=0.03, minor_radius=0.01, at=(0.01, 0.02, 0.03), rotate=(90.0, 0.0, 0.0))
    lamp = Light("spot", 2.0, at=(0.0, 0.0, 0.1), direction=(1.0, 0.0, 0.0), outer_angle=30.0, marker=CARD)
    box = Proxy("box", at=(0.0, 0.0, 0.02), size=(0.04, 0.04, 0.04), marker=BOARD)
    scene = Scene(
        CAMERA,
        objects=(dataclasses.replace(ridden, marker=CARD), ridden),
        lights=(lamp,),
        proxies=(Proxy("plane", size=(1.0, 1.0)), box),
    )
    host = HostScene(scene, wp.get_device(device))
    objects, lights, proxies = (np.zeros_like(records) for records in (host._objects, host._lights, host._proxies))
    card, board = place(0.2, 0.1, 90.0), place(-0.2, 0.0, 0.0)
    places = {CARD: card, BOARD: board}
    assert host.write_objects(objects, 1.0, places)
    assert host.write_lights(lights, 1.0, places)
    assert host.write_proxies(proxies, places)
    np.testing.assert_allclose(objects["position"], [[0.18, 0.11, 0.03], [0.01, 0.02, 0.03]], atol=ROUNDING)
    expected = card.rotation @ rotation_matrix((90.0, 0.0, 0.0))
    np.testing.assert_allclose(objects["rotation"][0], expected, atol=ROUNDING)
    np.testing.assert_allclose(lights["position"][0], [0.2, 0.1, 0.1], atol=ROUNDING)
    np.testing.assert_allclose(lights["direction"][0], [0.0, 1.0, 0.0], atol=ROUNDING)
    np.testing.assert_allclose(proxies["position"], [[0, 0, 0], [-0.2, 0.0, 0.02]], atol=ROUNDING)
    assert not host.write_proxies(proxies, places)
    seen = len(host.object_outline().polygons), len(host.light_outline().polygons)

    host.write_objects(objects, 2.0, {CARD: None})
    host.write_lights(lights, 2.0, {CARD: None})
    assert host.write_proxies(proxies, {BOARD: None})
    assert objects["position"][0, 2] < -1e4
    assert not lights["intensity"].any()
    assert proxies["position"][1, 2] < -1e4
    assert (len(host.object_outline().polygons), len(host.light_outline().polygons)) == (seen[0] // 2, 0)
    host.write_objects(objects, 3.0, places)
    np.testing.assert_allclose(objects["scale"], 1.0)


@pytest.mark.slow
def test_a_frame_shows_an_object_on_its_card(device: str) -> None:
    """The object is where the card is, follows it, and is gone once the card has been gone for a while."""
    scene = Scene(
        CAMERA,
        marker=WORLD,
        objects=(Object("box", size=(0.05, 0.05, 0.05), at=(0.0, 0.0, 0.025), marker=CARD),),
        lights=(Light("directional", 3.0, direction=(0.3, 0.2, -1.0)),),
    )
    camera_from_world = look(30.0)

    def centre(image: np.ndarray, frame: np.ndarray) -> np.ndarray | None:
        changed = np.argwhere(np.abs(image.astype(int) - frame).max(axis=-1) > 3)
        return changed.mean(axis=0)[::-1] if len(changed) else None

    with Pipeline(scene, device=device, quality=PRESETS["low"], estimates="synchronous") as pipeline:
        for k, x in enumerate((0.10, 0.12)):
            card = camera_from_world.after(place(x, 0.02, 20.0))
            frame = render((WORLD, camera_from_world), (CARD, card))
            at = centre(pipeline(frame, time_seconds=0.1 * k).image, frame)
            middle = card.apply(np.array([0.0, 0.0, 0.025]))
            expected = np.array([640.0, 640.0]) * middle[:2] / middle[2] + [319.5, 239.5]
            assert at is not None
            np.testing.assert_allclose(at, expected, atol=4.0)  # of what is seen of a box, not of its middle
        frame = render((WORLD, camera_from_world))
        for k in range(2):
            shown = pipeline(frame, time_seconds=5.0 + 5.0 * k).image
        assert centre(shown, frame) is None


def test_scene_files_say_markers() -> None:
    text = HEADER + (
        "[marker]\nsize = 0.08\nid = 3\n"
        '[[proxy]]\nshape = "box"\nsize = [0.1, 0.1, 0.1]\nmarker = { board = "grid 2x2 0.03 0.01", '
        'dictionary = "DICT_4X4_100" }\n'
        '[[object]]\nshape = "sphere"\nradius = 0.03\nmarker = 7\n'
        '[[object]]\nshape = "sphere"\nradius = 0.03\nmarker = { id = 7 }\n'
        '[[light]]\nkind = "point"\nat = [0, 0, 0.1]\nintensity = 1.0\nmarker = { id = 8, size = 0.02 }\n'
    )
    scene = loads_scene(text)
    assert scene.proxies[0].marker == BOARD
    assert scene.objects[0].marker == scene.objects[1].marker == Marker(id=7, size=0.08)
    assert scene.lights[0].marker == Marker(id=8, size=0.02)
    assert own_markers(scene) == (Marker(id=7, size=0.08), Marker(id=8, size=0.02), BOARD)
    again = loads_scene(dumps_scene(scene))
    assert (again.objects, again.lights, again.proxies) == (scene.objects, scene.lights, scene.proxies)
    own = "[probe]\ncenter = [0, 0.07, 0.035]\nradius = 0.035\nmarker = { id = 7, size = 0.05 }\n"
    scene = loads_scene(f"{HEADER}[marker]\nsize = 0.08\n{own}")
    assert scene.probes[0].marker == CARD
    assert own_markers(scene) == (CARD,)
    assert loads_scene(dumps_scene(scene)).probes == scene.probes


@pytest.mark.parametrize(
    ("world", "marker", "message"),
    [
        ("size = 0.08\nid = 3", "3", "marker 3 of DICT_4X4_50 is the world's own; use another"),
        ("size = 0.08", "{ id = 0, size = 0.01 }", "marker 0 of DICT_4X4_50 is the world's own"),
        ("size = 0.08", "50", r"object\[0\]\.marker\.id = 50: expected a whole number from 0 to 49"),
        ("size = 0.08", '"seven"', r"object\[0\]\.marker = .*seven.*: expected a table .* or an id"),
        ("size = 0.08", "{ id = 7, white = 0.5 }", r"object\[0\]\.marker\.white: unknown key"),
        ("size = 0.08", "{ id = 7, size = -1 }", r"object\[0\]\.marker\.size = -1: expected"),
        ('board = "grid 2x2 0.03 0.01"', "7", "expected a table such as"),
        ('board = "grid 2x2 0.03 0.01"', "{ id = 2, size = 0.1 }", "marker 2 .* is the world's own"),
        ('board = "grid 2x2 0.03 0.01"', "{ id = 9 }", r"object\[0\]\.marker\.size is missing"),
    ],
)
def test_markers_that_cannot_be(world: str, marker: str, message: str) -> None:
    text = f'{HEADER}[marker]\n{world}\n[[object]]\nshape = "sphere"\nradius = 0.03\nmarker = {marker}\n'
    with pytest.raises(SceneError, match=message) as caught:
        loads_scene(text, "a.toml")
    assert len(str(caught.value).splitlines()) == 1


def test_a_ball_on_its_card_may_be_moved(device: str) -> None:
    """The light is read off the ball wherever its card is, and stays as it was while that is lost."""
    ball = Probe((0.0, 0.07, 0.035), 0.035, marker=CARD)
    scene = Scene(CAMERA, marker=WORLD, probes=(ball,), objects=(Object("sphere", radius=0.02),))
    camera_from_world = look(30.0)

    def photograph(x: float | None, color: tuple[int, int, int]) -> np.ndarray:
        if x is None:
            return render((WORLD, camera_from_world))
        card = camera_from_world.after(place(x, 0.02, 20.0))
        frame = render((WORLD, camera_from_world), (CARD, card))
        at = card.apply(np.array(ball.center))
        middle = 640.0 * at[:2] / at[2] + [319.5, 239.5]
        radius = round(1.1 * 640.0 * ball.radius / at[2])  # a little more: the outline is an ellipse
        cv2.circle(frame, tuple(np.round(middle).astype(int).tolist()), radius, color, -1)
        return frame

    red, blue = (200, 20, 20), (20, 20, 200)
    quality = PRESETS["paper"]
    with Pipeline(
        scene, device=device, quality=quality, outputs=("image", "environment"), estimates="synchronous"
    ) as pipeline:
        means = []
        for k, (x, color) in enumerate([(-0.12, red), *[(0.12, blue)] * 4, (None, red)]):
            environment = pipeline(photograph(x, color), time_seconds=2.0 * k).environment
            means.append(np.asarray(environment).mean(axis=(0, 1)))
    assert means[0][0] > 4.0 * means[0][2]
    assert means[4][2] > 4.0 * means[4][0]
    np.testing.assert_allclose(means[5], means[4], rtol=0.05)
