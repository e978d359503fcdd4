"""Wrong set-ups are named, each as what it is; right ones raise no alarm."""

from __future__ import annotations

import argparse
import dataclasses
import itertools

import cv2
import numpy as np
import pytest

from tests.printed_card import PrintedCard
from tests.rendered_room import look_at
from warp_ar import doctor, live_start
from warp_ar.ball.ball_solve import rough_circle
from warp_ar.calibration.card import draw_card
from warp_ar.checks import checkup
from warp_ar.checks.check_ball import check_balls
from warp_ar.checks.check_pictures import Look, board_instead, check_pictures, check_saturation, take_look
from warp_ar.checks.check_print import check_print
from warp_ar.checks.check_proxies import check_proxies
from warp_ar.checks.check_scene import check_scene
from warp_ar.checks.checkup import check_and_look, check_look
from warp_ar.checks.finding import Finding
from warp_ar.errors import SceneError
from warp_ar.scene import Camera, CharucoBoard, Marker, Pose, Scene, SourceSpec, load_scene, loads_scene
from warp_ar.scene.starter import amend_scene
from warp_ar.sources.source import Frame
from warp_ar.sources.sources import open_source
from warp_ar.tracking.card_layout import CARD_MARKER
from warp_ar.tracking.markers import find_dictionary

pytestmark = pytest.mark.slow

FRAMES = 96
CALM = 40
"""Frames of the clip in which its own light hardly changes."""
FEW = 12
CLIPS = ("desk", "darken", "wire_opposing")


@pytest.fixture(scope="module")
def looks():
    """What the frames of each clip show, looked at once."""
    found = {}
    for name in CLIPS:
        scene = load_scene(name)
        with open_source(str(scene.source.path)) as source:
            found[name] = take_look(scene, source, FRAMES)
    return found


def ball(scene: Scene, **changes) -> Scene:
    return dataclasses.replace(scene, probes=(dataclasses.replace(scene.probes[0], **changes),))


def camera(scene: Scene, **factors) -> Scene:
    values = {key: getattr(scene.camera, key) * factor for key, factor in factors.items()}
    return dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, **values))


def marker(scene: Scene, **changes) -> Scene:
    return dataclasses.replace(scene, marker=dataclasses.replace(scene.marker, **changes))


def first_object(scene: Scene, **changes) -> Scene:
    return dataclasses.replace(scene, objects=(dataclasses.replace(scene.objects[0], **changes),))


NUMBERS = {
    "radius in millimetres": ("units.ball", lambda s: ball(s, radius=35.0)),
    "center in millimetres": ("units.ball", lambda s: ball(s, center=(-120.0, 30.0, 34.6))),
    "radius of a pinhead": ("units.ball", lambda s: ball(s, radius=0.0005)),
    "marker in millimetres": ("units.card", lambda s: marker(s, size=80.0)),
    "marker of a millimetre": ("units.card", lambda s: marker(s, size=0.001)),
    "grey paper": ("card.white", lambda s: marker(s, white=0.2)),
    "sunk ball": ("ball.sunk", lambda s: ball(s, center=(-0.12, 0.03, 0.02))),
    "ball on the marker": ("ball.on_card", lambda s: ball(s, center=(0.0, 0.0, 0.0346))),
    "black ball": ("ball.reflectance", lambda s: ball(s, reflectance=(0.05, 0.05, 0.05))),
    "focal length in millimetres": ("camera.field", lambda s: camera(s, fx=4 / 640, fy=4 / 640)),
    "pixels that are not square": ("camera.square", lambda s: camera(s, fy=1.1)),
    "center of another size": ("camera.center", lambda s: camera(s, cx=2.0, cy=2.0)),
    "object in millimetres": ("units.at", lambda s: first_object(s, at=(150.0, 55.0, 0.0))),
    "no ball and no light": ("probe.none", lambda s: dataclasses.replace(s, probes=(), lights=())),
}


def test_of_several_balls_the_wrong_one_is_named():
    scene = load_scene("desk")
    (good,) = scene.probes
    sunk = dataclasses.replace(good, center=(0.2, 0.03, 0.0))
    found = [f for f in check_scene(dataclasses.replace(scene, probes=(good, sunk))) if f.name == "ball.sunk"]
    assert [finding.text.startswith("[[probe]] 1") for finding in found] == [True]


SEEN = {
    "another marker": ("marker.other", lambda s: marker(s, id=3)),
    "focal length 3 % long": ("camera.focal", lambda s: camera(s, fx=1.03, fy=1.03)),
    "focal length that no pose fits": ("camera.focal", lambda s: camera(s, fx=0.15, fy=0.15)),
}


BALLS = {
    "radius 10 % short": ("ball.radius", lambda s: ball(s, radius=0.0315, center=(-0.12, 0.03, 0.0311))),
    "10 mm aside": ("ball.place", lambda s: ball(s, center=(-0.11, 0.03, 0.0346))),
    "on the other side": ("ball.unfound", lambda s: ball(s, center=(0.12, 0.03, 0.0346))),
    "reflectance of steel": ("ball.reflectance", lambda s: ball(s, reflectance=(0.6, 0.6, 0.6))),
    "out of the picture": ("ball.outside", lambda s: ball(s, center=(0.9, 0.03, 0.0346))),
}


@pytest.mark.parametrize(("clip", "told"), [("desk", 0.6), ("wire_opposing", 1.0)])
def test_reflectance_is_told_by_what_is_seen_twice(clip, told, looks):
    """Of 0.85, 0.85, 0.87; the median of frames is 3 % off, for the desk's texture is mirrored smaller."""
    scene, look = load_scene(clip), looks[clip]
    (found,) = check_balls(ball(scene, reflectance=(told,) * 3), look, 4)
    assert found.name == "ball.reflectance"
    right = [float(value) for value in found.remedy.split("[")[1].split("]")[0].split(",")]
    assert right == pytest.approx(scene.probes[0].reflectance, rel=0.08)
    assert check_balls(ball(scene, reflectance=tuple(right)), look, 4) == []


def spoiled(look: Look, change) -> Look:
    """The same look with every picture changed; ``change`` takes a picture and its number."""
    views = tuple((change(image, k), pose) for k, (image, pose) in enumerate(look.views))
    return dataclasses.replace(look, views=views, images=tuple(image for image, _ in views))


def gain(factor):
    return lambda image, _: np.clip(image * np.asarray(factor), 0, 255).astype(np.uint8)


def painted(color, share=1.0):
    def change(image, _):
        mask = np.zeros(image.shape[:2], np.uint8)
        cv2.circle(mask, (186, 252), 34, 255, -1)
        mask[:, round(152 + 68 * share) :] = 0
        return np.where(mask[..., None] > 0, np.uint8(color), image)

    return change


def test_a_box_beside_its_edges_is_seen(looks):
    scene = load_scene("desk")
    look = looks["desk"]
    few = look.views[::24]
    assert check_proxies(scene, look.camera, few) == []
    box = next(index for index, proxy in enumerate(scene.proxies) if proxy.shape == "box")
    (found,) = check_proxies(beside(scene), look.camera, few)
    assert found.name == "proxy.edges"
    right = [float(value) for value in found.remedy.split("[")[1].split("]")[0].split(",")]
    assert right == pytest.approx(scene.proxies[box].at, abs=0.003)


CODES = np.arange(256) / 255.0


BENT = np.rint(255 * CODES**2 * (3 - 2 * CODES)).astype(np.uint8)
"""The tone curve smoothstep."""


PICTURES = {
    "an S-shaped tone curve": ("camera.response", lambda image, _: BENT[image]),
    "overexposed": ("card.clipped", gain(2.2)),
    "underexposed": ("card.dark", gain(0.2)),
    "haze": ("card.contrast", lambda image, _: (170 + image // 4).astype(np.uint8)),
    "out of focus": ("picture.blurred", lambda image, _: cv2.GaussianBlur(image, (0, 0), 4.0)),
    "exposure drifts": ("camera.drift", lambda image, k: gain(1 - 0.3 * k / CALM)(image, k)),
    "white balance drifts": ("camera.balance", lambda image, k: gain([1 - 0.2 * k / CALM, 1, 1])(image, k)),
}


SHORT = {
    "a shoulder": (lambda image, _: np.minimum(image, 238), 238, "shoulder"),
    "a shorter range": (lambda image, _: np.rint(image * (245 / 255)).astype(np.uint8), 245, "shoulder"),
    "limited range": (lambda image, _: np.rint(16 + image * (219 / 255)).astype(np.uint8), 235, "limited range"),
}
"""Cameras whose codes end below 255, where, and what is said of it."""


@pytest.mark.parametrize(("fault", "clip"), list(zip(SHORT, CLIPS, strict=True)))
def test_codes_that_end_early_are_seen(fault, clip, looks):
    change, level, words = SHORT[fault]
    views = looks[clip].views[::4]
    look = dataclasses.replace(looks[clip], views=views, images=tuple(image for image, _ in views))
    (found,) = check_saturation(load_scene(clip), spoiled(look, change))
    assert found.name == "camera.saturation"
    said = int(found.text.split("code ")[1].split(" of")[0])
    assert said == level
    assert words in found.text


def test_a_ball_that_is_half_hidden_is_seen(looks):
    scene, look = load_scene("desk"), dataclasses.replace(looks["desk"], views=looks["desk"].views[:1])

    def hidden(share: float) -> list[str]:
        """Findings where a hand covers the balls from above, down to ``share`` of the radius below the centre."""
        views = []
        for image, pose in look.views:
            circle = rough_circle(look.camera, pose, scene.probes[0])
            assert circle is not None
            x, y, radius = circle
            top, bottom = (max(round(y + part * radius), 0) for part in (-2.5, share))
            covered = image.copy()
            covered[top:bottom, max(round(x - 1.6 * radius), 0) : round(x + 1.6 * radius)] = (170, 120, 100)
            views.append((covered, pose))
        return [finding.name for finding in check_balls(scene, dataclasses.replace(look, views=tuple(views)))]

    assert hidden(-1.1) == []
    assert hidden(0.0) == ["ball.hidden"]
    assert hidden(0.6) == ["ball.unfound"]


def test_no_card_is_asked_for_where_poses_are_written_down(looks):
    """As in the scene of a photograph, which has no marker."""
    look = dataclasses.replace(looks["desk"], views=(), errors=())
    scene = dataclasses.replace(load_scene("desk"), has_marker=False)
    assert check_look(scene, look) == []
    assert [finding.name for finding in check_look(scene, dataclasses.replace(look, images=()))] == ["source.empty"]


@pytest.mark.parametrize("number", [0, 5])
def test_a_marker_that_is_there_twice_is_seen(number, looks):
    """Another one beside it is none of the scene's."""
    look = looks["desk"]
    tag = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), number, 72)
    tag = cv2.copyMakeBorder(tag, 12, 12, 12, 12, cv2.BORDER_CONSTANT, value=255)[..., None]
    pictures = [image.copy() for image, _ in look.views[:8]]
    for picture in pictures:
        picture[20 : 20 + len(tag), 20 : 20 + len(tag)] = tag
    views = tuple((picture, pose) for picture, (_, pose) in zip(pictures, look.views, strict=False))
    twice = dataclasses.replace(look, images=tuple(pictures), views=views, errors=look.errors[:8])
    found = [finding.name for finding in check_look(load_scene("desk"), twice, 1)]
    assert (found == ["marker.twice"]) == (number == 0)
    assert ("marker.twice" in found) == (number == 0)


RIGHT = {
    "as it is": lambda image, _: image,
    "a little darker": gain(0.8),
    "a little brighter": gain(1.08),
    "warm light": gain([1.0, 0.9, 0.75]),
    "noise": lambda image, k: np.clip(image + np.random.default_rng(k).normal(0, 4, image.shape), 0, 255).astype(
        np.uint8
    ),
    "a little soft": lambda image, _: cv2.GaussianBlur(image, (0, 0), 0.8),
    "compressed": lambda image, _: cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1], 1),
    "grey": lambda image, _: np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None], 3, 2),
    "flickering a little": lambda image, k: gain(1 + 0.03 * np.sin(k))(image, k),
}


BRIEF = list(zip(itertools.cycle(CLIPS), RIGHT, strict=False))
"""One clip for each change."""


@pytest.mark.parametrize(("clip", "change"), BRIEF)
def test_right_set_ups_raise_no_alarm(clip, change, looks):
    look = looks[clip]
    few = dataclasses.replace(look, views=look.views[::4], images=look.images[::4], errors=look.errors[::4])
    few = spoiled(few, RIGHT[change])
    scene = load_scene(clip)
    found = [*check_scene(scene), *check_pictures(scene, few), *check_balls(scene, few, 1)]
    found += check_saturation(scene, few)
    found += [
        *check_proxies(scene, few.camera, few.views[::12]),
        *check_print(scene.marker, few.camera, few.views[::12]),
    ]
    assert [(finding.name, finding.text) for finding in found] == []


def test_command_says_it_and_ends_with_1(capsys, tmp_path):
    scene = load_scene("desk")
    path = tmp_path / "scene.toml"
    text = scene.path.read_text().replace("radius = 0.035", "radius = 35.0")
    text = text.replace('"clips/', f'"{scene.path.parent}/clips/').replace('"meshes/', f'"{scene.path.parent}/meshes/')
    path.write_text(text)
    assert doctor.main([str(tmp_path), "--frames", "4"]) == 1
    said = capsys.readouterr().out
    for line in ("device: ", "driver: ", "kernels: ", "codecs: "):
        assert line in said
    assert "35 millimetres are 0.035 m" in said
    assert "do: write the radius in metres" in said
    assert doctor.main(["nowhere"]) == 2


def test_a_camera_that_may_not_be_opened_is_a_finding(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "DEVICES", tmp_path)
    scene = dataclasses.replace(load_scene("desk"), source=SourceSpec(camera=3))
    (found,) = doctor.check_access(scene, None)
    assert found.name == "source.absent"
    assert "no capture device 3" in found.text
    (tmp_path / "video0").touch()
    (found,) = doctor.check_access(scene, None)
    assert "there are 0" in found.remedy
    device = tmp_path / "video3"
    device.touch()
    assert doctor.check_access(scene, None) == []
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    (found,) = doctor.check_access(scene, None)
    assert found.name == "source.permission"
    assert "group" in found.remedy
    assert doctor.check_access(scene, tmp_path / "clip.mp4") == []


def test_guess_is_named():
    scene = loads_scene("schema = 1\n[camera]\nfield_of_view = 60.0\n")
    assert [finding.name for finding in check_scene(scene)] == ["camera.guessed"]


def test_unreadable_source_is_a_finding(tmp_path):
    found = check_and_look(load_scene("desk"), tmp_path / "nothing.mp4")[0]
    assert [finding.name for finding in found] == ["source.unreadable"]


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    """What a test finds is not what an earlier one has kept."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))


def lives_line(scene, monkeypatch, source=None):
    """What ``live`` says first, and the names of all that its quick half finds, the worst first."""
    said, names = [], []

    def look(*arguments, **options):
        found, looked = check_and_look(*arguments, **options)
        names.extend(finding.name for finding in found)
        return found, looked

    monkeypatch.setattr(checkup, "check_and_look", look)
    monkeypatch.setattr(live_start, "say", said.append)
    live_start.say_quick_check(argparse.Namespace(scene="my_desk", source=source), scene)
    return said, names


@pytest.mark.parametrize("fault", NUMBERS)
def test_lives_line_names_wrong_numbers(fault, monkeypatch):
    name, change = NUMBERS[fault]
    said, names = lives_line(dataclasses.replace(change(load_scene("desk")), source=None), monkeypatch)
    assert name in names
    texts = {f.name: f.text for f in check_scene(change(load_scene("desk")))}
    assert said[0].startswith(texts[names[0]]), "it is not the worst that is said"
    assert Finding(names[0], "", "").error >= Finding(name, "", "").error
    assert said[0].endswith("python -m warp_ar.doctor my_desk")


class Decoded:
    """Frames of a clip that was decoded already, as a source."""

    exposures = ()

    def __init__(self, images, fps=24.0):
        self.images, self.fps, self.length = images, fps, len(images)
        self.size = (images[0].shape[1], images[0].shape[0])

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def __iter__(self):
        return (Frame(k, k / self.fps, image) for k, image in enumerate(self.images))


def see(frames, monkeypatch):
    """Have checks read these frames, whatever they open."""
    monkeypatch.setattr(checkup, "open_source", lambda *arguments, **options: Decoded(frames))


def lives_words(scene, frames, monkeypatch):
    """What ``live`` says of a scene whose source shows these frames, and the names of its findings."""
    see(frames, monkeypatch)
    return lives_line(scene, monkeypatch)


def beside(scene):
    """The tea tin is modelled 15 mm from where it stands."""
    proxies = tuple(
        dataclasses.replace(p, at=(p.at[0] + 0.015, *p.at[1:])) if p.shape == "box" else p for p in scene.proxies
    )
    return dataclasses.replace(scene, proxies=proxies)


def shaded(image, _):
    out = image.copy()
    out[:, :300] = (0.62 * out[:, :300]).astype(np.uint8)  # a third of the light
    return out


SHOWN = {
    **{fault: (name, change, None) for fault, (name, change) in {**SEEN, **BALLS}.items()},
    **{fault: (name, None, change) for fault, (name, change) in PICTURES.items()},
    "a shadow across the card": ("card.shadow", None, shaded),
    "a painted ball": ("ball.dull", None, painted(90)),
    "a mirrored picture": ("marker.mirrored", None, lambda image, _: np.ascontiguousarray(image[:, ::-1])),
    "a covered lens": ("picture.dark", None, lambda image, _: np.zeros_like(image)),
    "a blinding lamp": ("picture.clipped", None, lambda image, _: np.full_like(image, 255)),
    "nothing but a wall": ("marker.unseen", None, lambda image, _: np.full_like(image, 100)),
}


@pytest.mark.parametrize("fault", SHOWN)
def test_lives_line_names_what_frames_show(fault, monkeypatch, looks):
    name, scenes, pictures = SHOWN[fault]
    # What drifts does so over the frames in which the clip's own light rests, and shade needs several views.
    lasts = "drift" in fault or "shadow" in fault
    scene, frames = load_scene("desk"), looks["desk"].images[: CALM if lasts else FEW]
    if pictures is not None:
        frames = [pictures(image, k) for k, image in enumerate(frames)]
    said, names = lives_words(scene if scenes is None else scenes(scene), frames, monkeypatch)
    assert name in names
    assert len(said) == 1
    assert Finding(names[0], "", "").error >= Finding(name, "", "").error


def photographed(scale=1.0):
    """The printed card from three sides, and the camera."""
    camera = Camera(640, 480, 600.0, 600.0, 321.0, 238.0)
    card = PrintedCard(np.random.default_rng(0), paper="a4", scale=scale)
    eyes = ((0.12 * (k - 1), -0.42, 0.5 + 0.04 * k) for k in range(3))
    views = [Pose(*look_at(np.array(eye), np.array([0.0, 0.02, 0.0]))) for eye in eyes]
    return camera, [card.photograph(camera, p, 0.7, lambda linear: np.clip(linear, 0, 1) ** (1 / 2.2)) for p in views]


def test_lives_line_names_a_print_that_is_not_true(monkeypatch):
    camera, frames = photographed(0.97)
    scene = dataclasses.replace(load_scene("desk"), camera=camera, marker=CARD_MARKER, proxies=(), probes=(), lights=())
    said, names = lives_words(scene, frames, monkeypatch)
    assert "card.print" in names
    assert len(said) == 1


@pytest.fixture(scope="module")
def card_frames():
    return photographed()


@pytest.mark.parametrize("number", [0, 9])
def test_card_is_recognised_where_a_single_marker_is_expected(number, monkeypatch, card_frames):
    """The card holds markers 0 to 9: any of them would be followed at the wrong scale."""
    camera, frames = card_frames
    scene = dataclasses.replace(marker(load_scene("desk"), id=number), camera=camera)
    see(frames, monkeypatch)
    (found,) = [f for f in check_and_look(scene, "camera.mp4")[0] if f.name not in {"camera.guessed"}]
    assert found.name == "marker.board"
    assert f"single marker of 80 mm, id {number}" in found.text
    assert f'board = "{CARD_MARKER.board}"' in found.remedy
    assert 0.0 < found.error < 1.0
    said, names = lives_words(scene, frames, monkeypatch)
    assert names == ["marker.board"]
    assert [line.startswith(found.text) for line in said] == [True]
    assert board_instead(CARD_MARKER, frames) is None


def test_card_beside_a_single_marker_is_no_fault(card_frames):
    """Neither one that the card does not have, nor the single marker itself with others around it."""
    camera, frames = card_frames
    scene = dataclasses.replace(load_scene("desk"), camera=camera)
    assert board_instead(dataclasses.replace(scene.marker, id=40), frames) is None
    other = dataclasses.replace(scene.marker, dictionary="DICT_6X6_250")
    assert board_instead(other, frames) is None
    # A second marker 0, larger than the card's.
    image = frames[0].copy()
    assert board_instead(scene.marker, [image]) is not None
    pattern = cv2.aruco.generateImageMarker(find_dictionary("DICT_4X4_50"), 0, 90)
    image[10:124, 10:124] = 230
    image[22:112, 22:112] = pattern[..., None]
    assert board_instead(scene.marker, [image]) is None


def test_board_of_unknown_lengths_is_recognised():
    board = CharucoBoard(6, 5, 0.03, 0.02)
    image = draw_card(Marker(dictionary="DICT_4X4_50", board=board), 3000.0)
    found = board_instead(load_scene("desk").marker, [cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)])
    assert found is not None
    assert "charuco 6x5" in found.text
    assert 'board = "charuco 6x5 SQUARE MARKER"' in found.remedy


def test_results_are_written_and_comments_stay(tmp_path):
    path = tmp_path / "scene.toml"
    text = "# mine\nschema = 1\n[camera] # guessed\nfield_of_view = 60.0\n[marker]\nsize = 0.08\n"
    path.write_text(text + "[probe]\n# by ruler\nradius = 0.03 # +/- 1 mm\ncenter = [0.1, 0.0, 0.03]\n")
    amend_scene(path, "probe", {"radius": 0.0312, "center": [0.1, 0.001, 0.0312]})
    assert load_scene(path).probes[0].radius == 0.0312
    for comment in ("# mine", "# guessed", "# by ruler", "# +/- 1 mm"):
        assert comment in path.read_text()
    before = path.read_text()
    with pytest.raises(SceneError, match="radius"):
        amend_scene(path, "probe", {"radius": -1.0})
    with pytest.raises(SceneError, match=r"\[light\] is missing"):
        amend_scene(path, "light", {"intensity": 1.0})
    assert path.read_text() == before
