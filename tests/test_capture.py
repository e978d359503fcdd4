"""The command: photographs of a mirror ball become light, and light a picture."""

import re

import cv2
import numpy as np
import pytest

from tests.photo_files import FOCAL_35MM, encode_srgb, write_dng, write_photo
from tests.photo_room import GAIN, environment, exposed, photograph, project, write_bracket
from tests.test_photo_bracket import s_curve
from warp_ar.ball.ball_finder import find_ball
from warp_ar.capture import main
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, EXIT_USAGE
from warp_ar.errors import UsageError
from warp_ar.light.captured import Light, irradiance_above, latlong_directions, texel_solid_angles
from warp_ar.live import main as live
from warp_ar.photo_capture import capture_light
from warp_ar.photographs.support import plane_from_contact
from warp_ar.scene import load_scene

pytestmark = pytest.mark.slow

BRACKET = (15, 60, 250, 1000, 4000)
LIT = 0.12
"""Relative error of irradiance: 10 % are asked for after one scale; the plane that is picked here is exact."""
REFLECTANCE = 0.85
"""Of the ball, as the command takes it."""


def irradiance(radiance):
    height = len(radiance)
    normals = np.random.default_rng(0).normal(size=(100, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    d = latlong_directions(height).reshape(-1, 3)
    area = np.broadcast_to(texel_solid_angles(height), radiance.shape[:2]).reshape(-1, 1)
    return np.maximum(normals @ d.T, 0.0) @ (area * radiance.reshape(-1, 3))


def reduced(light):
    """A captured map at the size of the true one."""
    return cv2.resize(light.radiance, (64, 32), interpolation=cv2.INTER_AREA)


def error(light, denominator):
    """Of the irradiance, in units of the photograph at 1 / denominator."""
    found = irradiance(reduced(light))
    true = irradiance(environment() * GAIN / denominator)
    return np.linalg.norm(found - true) / np.linalg.norm(true)


@pytest.fixture(scope="module")
def bracket(tmp_path_factory):
    return write_bracket(tmp_path_factory.mktemp("bracket"), BRACKET)


def test_a_bracket_becomes_light_and_a_picture(bracket, tmp_path, capsys):
    x, y = project([0.0, 0.0, 0.0])
    arguments = ["--contact", str(x), str(y), "--ball-radius", "0.04", "--shown", str(bracket[1]), "--device", "cpu"]
    outputs = ["--output", str(tmp_path / "light.exr"), "--scene", str(tmp_path / "new" / "photo.toml")]
    assert main([*map(str, bracket), *arguments, *outputs]) == EXIT_DONE
    said = capsys.readouterr()
    assert "light in camera values of photo_b.jpg" in said.out
    assert "ball at" in said.err
    assert "the ball reflects 0.8" in said.err
    light = Light.load(tmp_path / "light.exr")
    assert light.exposure == pytest.approx(1 / 60)
    assert error(light, 60) < LIT
    assert light.lower_bound < 1e-3
    assert len(light.emitters) >= 2
    assert all(emitter.high is not None for emitter in light.emitters)
    assert 0.7 < light.confidence.mean() < 1.0

    scene = load_scene(tmp_path / "new" / "photo.toml")
    assert scene.captured.file == tmp_path / "light.exr"
    shown = ["--headless", "--device", "cpu", "--output", str(tmp_path / "out")]
    assert live([str(tmp_path / "new" / "photo.toml"), *shown]) == EXIT_DONE
    assert "must be in the picture" not in capsys.readouterr().err  # which speaks of a card that nobody has
    picture = cv2.imread(str(tmp_path / "out" / "0000.png"))[..., ::-1]
    # The virtual mirror ball stands three radii to the right of the real one and shows nearly the same environment.
    real, virtual = (project([dx, 0.0, 0.04]) for dx in (0.0, 0.12))
    # Seen from there, lamps are mirrored some pixels away, and the other virtual ball is mirrored too.
    smooth = cv2.GaussianBlur(picture, (0, 0), 6.0)
    discs = [cv2.getRectSubPix(smooth, (60, 60), tuple(map(float, at))).astype(float) for at in (real, virtual)]
    assert np.corrcoef(discs[0].ravel(), discs[1].ravel())[0, 1] > 0.7
    assert abs(discs[1].mean() / discs[0].mean() - 1.0) < 0.15


def test_one_photograph_says_how_much_is_a_lower_bound(bracket):
    found = capture_light(bracket[:1], device="cpu")
    assert found.light.lower_bound > 0.2
    assert any("still clips" in note and "lower bound" in note for note in found.notes)
    assert all(emitter.high is None for emitter in found.light.emitters[:2])


def test_what_clips_in_one_photograph_is_raised_and_said(bracket):
    """Only there: nothing else changes, emitters' lower ends stay, and a bracket is taken as it is measured."""
    raised, plain = (capture_light(bracket[:1], device="cpu", raises=raises) for raises in (True, False))
    more = raised.light.radiance - plain.light.radiance
    assert (more >= 0.0).all()
    assert more.max() > 0.3
    # A texel at a saturation boundary clips in part, and is at least as bright as that part.
    assert (more <= 1.05 * more.max() * REFLECTANCE * plain.light.radiance).all()
    assert any("clipped light was raised" in note for note in raised.notes)
    assert not any("raised" in note for note in plain.notes)
    low = [sum(emitter.low) for emitter in raised.light.emitters]
    assert max(low) <= 1.01 * max(sum(emitter.low) for emitter in plain.light.emitters)
    merged = [capture_light(bracket, device="cpu", shown=0, raises=raises).light for raises in (True, False)]
    assert (merged[0].radiance == merged[1].radiance).all()
    true, one, other = (irradiance(light.radiance) for light in (merged[0], raised.light, plain.light))
    assert np.linalg.norm(one - true) < np.linalg.norm(other - true)


def test_light_too_low_for_the_table_is_raised(bracket):
    """Lamps that clip lack most of the light: under it the wood would reflect more than all of it."""

    def under(outline, camera):
        return plane_from_contact(outline.sphere, camera, project([0.0, 0.0, 0.0]))

    raised, plain = (
        capture_light(bracket[:1], support=under, reflectance=REFLECTANCE, device="cpu", raises=raises)
        for raises in (True, False)
    )
    told = r"the table would reflect (\d\.\d+) of this light"
    assert all(float(re.search(told, " ".join(found.notes))[1]) > 1.0 for found in (raised, plain))
    assert any("clipped light was raised" in note and "none reflects more" in note for note in raised.notes)
    assert any(note.endswith("the light is too low") for note in plain.notes)
    true, one, other = (
        irradiance_above(light).mean()
        for light in (environment() * GAIN / BRACKET[0], raised.light.radiance, plain.light.radiance)
    )
    assert abs(np.log(one / true)) < 0.7 * abs(np.log(other / true))


def test_a_disc_that_mirrors_nothing_is_said(tmp_path):
    """The ring on the card where the ball belongs, a plate, a ball that is painted over."""
    image = np.random.default_rng(0).normal(120.0, 40.0, (120, 160, 3))
    image = np.clip(cv2.GaussianBlur(image, (0, 0), 1.5), 0, 255).astype(np.uint8)
    cv2.circle(image, (80, 60), 25, (128, 128, 128), -1)
    write_photo(tmp_path / "a.jpg", image)
    found = capture_light([tmp_path / "a.jpg"], device="cpu")
    assert any("shows no reflections: is a ball there" in note for note in found.notes)


def test_an_exact_circle_is_taken_and_drawn_and_axes_and_rows_are_as_asked(bracket, tmp_path, capsys):
    circle = 272.0, 226.0, 48.5
    arguments = [str(bracket[1]), "--device", "cpu", "--circle", *map(str, circle), "--height", "64"]
    arguments += ["--output", str(tmp_path / "light.exr")]
    assert main(arguments) == EXIT_DONE
    said = capsys.readouterr()
    assert "looking for the ball in 1 photograph" in said.err
    assert "one photograph gives no response: srgb is assumed" in said.err
    photo, picture = cv2.imread(str(bracket[1])), cv2.imread(str(tmp_path / "light.outline.png"))
    rows, columns = np.nonzero((picture != photo).any(2))
    # Its ellipse, which the camera makes of a ball, is as large.
    assert np.abs(np.hypot(columns - circle[0], rows - circle[1]) - circle[2]).max() < 2.5
    assert len(rows) > 2 * np.pi * circle[2]
    light = Light.load(tmp_path / "light.exr")
    assert light.radiance.shape == (64, 128, 3)
    preview = cv2.imread(str(tmp_path / "light.preview.png"))
    assert preview.shape == light.radiance.shape
    assert np.corrcoef(preview.mean(2).ravel(), np.log(light.radiance[..., ::-1].mean(2).ravel() + 0.01))[0, 1] > 0.8
    # What it wrote itself it replaces; what is read is the same in other axes.
    assert main([*arguments, "--axes", "opengl"]) == EXIT_DONE
    other = Light.load(tmp_path / "light.exr")
    np.testing.assert_array_equal(other.radiance, light.radiance)
    np.testing.assert_allclose(other.emitters[0].direction, light.emitters[0].direction, atol=1e-5)


def test_a_response_that_was_found_is_written_into_the_scene(tmp_path, capsys):
    exposures = (15, 30, 60, 125, 250, 500)
    photos = write_bracket(tmp_path, exposures, curve=s_curve)
    x, y = project([0.0, 0.0, 0.0])
    given = ["--contact", str(x), str(y), "--circle", "272", "226", "48.5", "--device", "cpu"]
    files = ["--output", str(tmp_path / "light.exr"), "--scene", str(tmp_path / "photo.toml")]
    assert main([*map(str, photos), *given, *files]) == EXIT_DONE
    assert "the response is not srgb" in capsys.readouterr().err
    scene = load_scene(tmp_path / "photo.toml")
    assert scene.camera.transfer == tmp_path / "light.response.txt"


def test_raw_photographs_need_no_response(tmp_path):
    pytest.importorskip("rawpy", reason="needs the extra raw")
    photos = [tmp_path / f"{chr(97 + k)}.dng" for k in range(len(BRACKET))]
    for path, denominator in zip(photos, BRACKET, strict=True):
        write_dng(path, GAIN / denominator * photograph()[0], denominator=denominator)

    def under(outline, camera):
        return plane_from_contact(outline.sphere, camera, project([0.0, 0.0, 0.0]))

    known = {"device": "cpu", "focal_35mm": FOCAL_35MM, "reflectance": REFLECTANCE, "support": under}
    found = capture_light(photos, shown=1, **known)
    assert error(found.light, 60) < LIT
    assert found.response is None
    assert not any("response" in note for note in found.notes)
    alone = capture_light(photos[-1:], circle=(*found.outline.center, found.outline.radius), **known)
    # Its 16 bits show what its darkest codes of 8 would round away: they are below 2.
    assert error(alone.light, BRACKET[-1]) < LIT
    assert not any("assumed; with a phone's" in note for note in alone.notes)
    lying = [1 / d**0.8 for d in BRACKET]
    with pytest.raises(UsageError, match="exposures contradict the pictures"):
        capture_light(photos, device="cpu", exposures=lying)
    with pytest.raises(UsageError, match=r"--transfer gamma:2.2: expected none for .*a\.dng, which is linear"):
        capture_light(photos, device="cpu", transfer="gamma:2.2")


def test_a_shown_photograph_without_a_rim_is_refused_with_the_balls_place(tmp_path):
    clear = write_photo(tmp_path / "clear.jpg", exposed(60), denominator=60)
    black = write_photo(tmp_path / "black.jpg", np.zeros_like(exposed(60)), denominator=60000)
    with pytest.raises(UsageError, match=r"^black\.jpg shows no rim of the ball: .*--shown.*clear\.jpg") as refused:
        capture_light([clear, black], device="cpu", shown=1)
    # By a far camera, of the JPEG: the outline was found in the picture itself here.
    told = [float(value) for value in str(refused.value).split("--circle ")[1].rstrip(")").split()]
    assert told[:2] == pytest.approx(find_ball(exposed(60).astype(np.uint8)).center, abs=0.5)
    assert capture_light([clear, black], device="cpu", shown=1, circle=told).outline.center == pytest.approx(
        told[:2], abs=0.5
    )


def test_a_focal_length_that_is_given_counts_for_a_cut_picture_too(tmp_path):
    write_photo(tmp_path / "cut.jpg", exposed(60)[100:350, 120:420])
    alone, given = (capture_light([tmp_path / "cut.jpg"], device="cpu", focal_35mm=mm) for mm in (None, 50.0))
    assert any("was cut, so that EXIF's focal length says nothing" in note for note in alone.notes)
    assert not any("focal" in note for note in given.notes)
    assert given.camera.fx == pytest.approx(50.0 / np.hypot(36, 24) * np.hypot(300, 250))


def test_lying_exposures_end_the_command(tmp_path, capsys):
    photos = write_bracket(tmp_path, BRACKET[:4], exif=(50, 60, 72, 100), names=["d_4", "d_16", "d_64", "d_1024"])
    assert main([*map(str, photos), "--output", str(tmp_path / "light.exr"), "--device", "cpu"]) == EXIT_USAGE
    message = capsys.readouterr().err
    assert all(figure in message for figure in ("EXIF says 2", "names say 256", "pixels say"))
    assert not (tmp_path / "light.exr").exists()
    given = ["--exposures", *(f"1/{d}" for d in BRACKET[:4])]
    assert main([*map(str, photos), *given, "--output", str(tmp_path / "light.exr"), "--device", "cpu"]) == EXIT_DONE
    capsys.readouterr()
    # Who does not know the true ones lets the pictures tell: the same light, for these have sRGB's response.
    told = ["--exposures", "pixels", "--output", str(tmp_path / "pixels.exr"), "--device", "cpu"]
    assert main([*map(str, photos), *told]) == EXIT_DONE
    assert "exposures are from the pixels alone" in capsys.readouterr().err
    first, second = (irradiance(Light.load(tmp_path / f"{name}.exr").radiance) for name in ("light", "pixels"))
    assert np.linalg.norm(second - first) / np.linalg.norm(first) < 0.05


def test_a_moved_photograph_is_left_out_and_said(tmp_path):
    photos = write_bracket(tmp_path, BRACKET)
    turned = np.ascontiguousarray(exposed(250)[::-1])
    write_photo(photos[2], turned, denominator=250)
    write_photo(photos[3], np.roll(exposed(1000), (4, 5), (0, 1)), denominator=1000)
    notes = capture_light(photos, device="cpu", shown=1).notes
    assert any(note.startswith("photo_c.jpg is left out: it shows something else") for note in notes)
    assert any(note.startswith("photo_d.jpg lies 6.4 pixels apart") and "was moved" in note for note in notes)
    odd = capture_light([photos[2], *photos[:2]], device="cpu", shown=0, circle=(272.0, 222.0, 48.5)).notes
    assert "most photographs differ from photo_c.jpg: if it is the odd one, show another (--shown)" in odd


def test_another_photograph_is_shown_if_the_best_exposed_is_the_odd_one(tmp_path):
    photos = write_bracket(tmp_path, BRACKET)
    write_photo(photos[1], np.ascontiguousarray(exposed(60)[::-1, :500]), denominator=60)
    found = capture_light(photos, device="cpu")
    assert found.shown != photos[1]
    (note,) = [note for note in found.notes if "left out" in note]
    assert note.startswith("photo_b.jpg is left out: it shows something else")
    assert note.endswith("and was cut or resized")


def test_a_refusal_names_the_photograph(tmp_path):
    write_photo(tmp_path / "a.jpg", np.full((90, 120, 3), 90, np.uint8))
    with pytest.raises(UsageError, match=r"^a\.jpg: no ball was found in the picture"):
        capture_light([tmp_path / "a.jpg"], device="cpu")


def test_a_place_that_cannot_be_written_is_told_before_anything_is_computed(bracket, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("warp_ar.capture.capture_light", None)
    (tmp_path / "file").write_text("mine")
    light, scene = tmp_path / "light.exr", tmp_path / "file" / "photo.toml"
    arguments = ["--contact", "10", "20", "--output", str(light), "--scene", str(scene)]
    assert main([str(bracket[0]), *arguments]) == EXIT_FAILED
    said = capsys.readouterr().err
    assert "is a file, not a folder to write to" in said
    assert said.count("\n") == 1


def test_a_scene_needs_a_plane(bracket, tmp_path, capsys):
    files = ["--output", str(tmp_path / "light.exr"), "--scene", str(tmp_path / "photo.toml"), "--device", "cpu"]
    assert main([str(bracket[1]), *files]) == EXIT_USAGE
    assert "photo.toml needs the plane: give --rectangle and --rectangle-size, or --contact" in capsys.readouterr().err
    assert not (tmp_path / "light.exr").exists()


def test_photographs_of_16_bits_are_merged_in_16_bits(tmp_path):
    """Both are so dark that 8 bits round the walls to code 0 or 1, which errs by a factor of 20 in the median."""
    dark, photos = (60000, 240000), []
    for denominator in dark:
        codes = encode_srgb(GAIN / denominator * photograph()[0].astype(float), 65535)
        photos.append(tmp_path / f"{denominator}.png")
        cv2.imwrite(str(photos[-1]), codes.astype(np.uint16)[..., ::-1])
    known = {"reflectance": REFLECTANCE, "focal_35mm": FOCAL_35MM, "circle": (272.0, 226.0, 48.5), "device": "cpu"}
    light = capture_light(photos, shown=0, exposures=[1 / d for d in dark], **known).light
    off = np.abs(np.log(np.maximum(reduced(light), 1e-9) / (environment() * GAIN / dark[0])))
    # Half of it is the small map's texels, whose edges are apart.
    assert np.median(off[cv2.resize(light.confidence, (64, 32)) > 0.5]) < 0.5
