"""The light that the page's server tells others: what it says, to whom, and what three.js makes of it."""

from __future__ import annotations

import asyncio
import json
import tempfile
from pathlib import Path
from typing import Any

import aiohttp
import cv2
import numpy as np
import OpenEXR
import pytest

from tests.viewer_rig import Site, run, served
from warp_ar import live
from warp_ar.errors import UsageError
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.light.latlong_axes import AXES
from warp_ar.output.environment_axes import FACES, basis, to_cube
from warp_ar.viewer import server
from warp_ar.viewer.host import Host
from warp_ar.viewer.light_record import LightState, describe, encode_picture, key_light
from warp_ar.viewer.server import MOST_LISTENERS, check_origin

pytestmark = pytest.mark.slow

# A lamp of 4 degrees within a map of 64 rows: half a texel is 1.4 degrees.
DIRECTION = 0.03


def room(height: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Grey walls and a lamp, and the direction toward it."""
    toward = np.array([0.6, -0.48, 0.64])
    directions = latlong_directions(height)
    lamp = directions @ toward > np.cos(np.radians(4.0))
    return np.where(lamp[..., None], (80.0, 60.0, 40.0), 0.2).astype(np.float32), toward


def test_harmonics_are_the_light_of_a_surface() -> None:
    """Irradiance by the nine numbers against the integral, in all axes, for a light that they hold exactly."""
    directions = latlong_directions(64)
    smooth = (1.0 + 0.5 * directions[..., 2] + 0.3 * directions[..., 0] * directions[..., 1]).astype(np.float32)
    radiance = np.repeat(smooth[..., None], 3, -1)
    normals = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, -1.0]])
    area = texel_solid_angles(64)
    for axes in AXES:
        told = describe(LightState(radiance, 1.0, {}), None, axes)
        turn = np.reshape(told["world_from_marker"], (3, 3))
        for normal in normals:
            expected = (smooth * np.maximum(directions @ normal, 0.0) * area).sum()
            found = basis((turn @ normal)[None]) @ np.array(told["irradiance"])
            np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_the_key_light_is_the_lamp() -> None:
    radiance, toward = room()
    key = key_light(radiance, np.eye(3))
    assert key is not None
    np.testing.assert_allclose(key["direction"], toward, atol=DIRECTION)
    lamp = radiance.max(-1) > 1.0
    area = np.broadcast_to(texel_solid_angles(64), lamp.shape)
    np.testing.assert_allclose(key["irradiance"], (radiance[lamp] * area[lamp][:, None]).sum(0), rtol=1e-3)
    assert 0.0 < key["directionality"] < 1.0
    assert key_light(np.ones((64, 128, 3), np.float32), np.eye(3)) is None
    dark = np.where(lamp[..., None], radiance, 0.0).astype(np.float32)
    sun = key_light(dark, np.eye(3))
    assert sun is not None
    assert sun["directionality"] == 1.0


def test_the_light_at_every_ball_is_told() -> None:
    first, _ = room()
    second, places = np.roll(first, 32, axis=1), ((0.1, 0.2, 0.3), (-0.4, 0.5, 0.6))
    state = LightState(first, 1.0, {}, (second,), places)
    for axes in AXES:
        told = describe(state, None, axes)
        turn = np.reshape(told["world_from_marker"], (3, 3))
        alone = [describe(LightState(one, 1.0, {}), None, axes) for one in (first, second)]
        assert [ball["key"] for ball in told["balls"]] == [one["key"] for one in alone]
        assert [ball["irradiance"] for ball in told["balls"]] == [one["irradiance"] for one in alone]
        np.testing.assert_allclose([ball["at"] for ball in told["balls"]], np.array(places) @ turn.T)
        assert {key: told[key] for key in alone[0]} == alone[0], "the first one's, as where it is alone"
        assert "balls" not in alone[0]
    found = read_exr(encode_picture(state, "exr", "z-up", "latlong", None, 1))
    np.testing.assert_array_equal(found, second)
    np.testing.assert_array_equal(read_exr(encode_picture(state, "exr", "z-up", "latlong", None)), first)
    with pytest.raises(UsageError, match="ball = 2: 2 have a light, counted from 0"):
        encode_picture(state, "exr", "z-up", "latlong", None, 2)


async def known_light(site: Site, query: str = "", **options: Any) -> dict[str, Any]:
    """``/light.json``, once the light is known: who asks keeps frames going."""
    while True:
        async with site.session.get(f"{site.url}/light.json{query}", **options) as response:
            if response.status == 200:
                return dict(await response.json())
            assert response.status == 409, await response.text()
            assert "the environment is not captured" in await response.text()
        await asyncio.sleep(0.1)


@run
async def test_light_in_all_its_forms() -> None:
    async with served() as site:
        told = await known_light(site)
        while told["pose"] is None:  # the last frame's: the clip goes on, and its marker is seen
            told = await known_light(site)
        assert told["axes"] == "y-up"
        assert len(told["radiance"]) == len(told["irradiance"]) == 9
        assert np.isfinite(told["radiance"]).all()
        turned = await known_light(site, "?axes=z-up")
        assert turned["world_from_marker"] == np.eye(3).ravel().tolist()
        with pytest.MonkeyPatch.context() as patch:
            # The clip goes on; what is asked for below is the light of one frame.
            light = (await site.server.started()).light_state
            patch.setattr(Host, "light_state", property(lambda _: light, lambda *_: None), raising=False)
            async with site.session.get(f"{site.url}/light.exr?axes=z-up") as response:
                latlong = read_exr(await response.read())
            assert latlong.shape == (64, 128, 3)
            async with site.session.get(f"{site.url}/light.hdr?layout=cube&size=16") as response:
                column = cv2.imdecode(np.frombuffer(await response.read(), np.uint8), cv2.IMREAD_UNCHANGED)
            faces = []
            for face in FACES:
                async with site.session.get(f"{site.url}/light/{face}.hdr?size=16") as response:
                    assert response.headers["Content-Type"] == "image/vnd.radiance"
                    faces.append(cv2.imdecode(np.frombuffer(await response.read(), np.uint8), cv2.IMREAD_UNCHANGED))
        np.testing.assert_array_equal(np.concatenate(faces), column)
        assert to_cube(latlong, "y-up", 16).shape == column.shape == (96, 16, 3)


def read_exr(data: bytes) -> np.ndarray:
    """Pixels of an OpenEXR with channels R, G and B."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "light.exr"
        path.write_bytes(data)
        with OpenEXR.File(str(path)) as file:
            return np.array(file.channels()["RGB"].pixels)


@run
async def test_requests_that_are_wrong_are_named() -> None:
    async with served() as site:
        await known_light(site)
        for path, words in (
            ("/light.json?axes=up", "axes = 'up': expected z-up, blender, y-up, opengl"),
            ("/light.exr?layout=ball", "layout 'ball': expected latlong or cube"),
            ("/light.hdr?layout=cube&size=0", "size = '0': expected 1 to 1024"),
            ("/light.hdr?layout=cube&size=99999999", "expected 1 to 1024"),
            ("/light/px.hdr?axes=z-up", "z-up"),
            ("/light/px.hdr?axes=sideways", "axes = 'sideways'"),
        ):
            async with site.session.get(site.url + path) as response:
                assert response.status == 400, path
                text = await response.text()
                assert words in text
                assert text.count("\n") == 1
        for path in ("/light.png", "/light/top.hdr", "/light/px.exr"):
            async with site.session.get(site.url + path) as response:
                assert response.status == 404


@run
async def test_changes_are_pushed() -> None:
    async with served() as site:
        told = []
        async with site.session.ws_connect(f"{site.url}/light?axes=z-up") as socket:
            async for message in socket:
                told.append(json.loads(message.data))
                if len(told) == 3:
                    break
        assert {one["axes"] for one in told} == {"z-up"}
        assert told[0] != told[1]
        async with site.session.ws_connect(f"{site.url}/light") as socket:
            await socket.send_str("hello")
            while (message := await socket.receive()).type is aiohttp.WSMsgType.TEXT:
                pass
            assert socket.close_code == 1008


@run
async def test_only_so_many_listen() -> None:
    async with served() as site:
        sockets = [await site.session.ws_connect(f"{site.url}/light") for _ in range(MOST_LISTENERS)]
        with pytest.raises(aiohttp.WSServerHandshakeError) as error:
            await site.session.ws_connect(f"{site.url}/light")
        assert error.value.status == 503
        for socket in sockets:
            await socket.close()
        async with site.session.ws_connect(f"{site.url}/light"):
            pass


@run
async def test_other_sites_are_let_in_by_name() -> None:
    friend = "http://localhost:5173"
    async with served(origins=(friend,)) as site:
        await known_light(site)
        async with site.session.get(
            f"{site.url}/light.json", headers={"Origin": friend, "Sec-Fetch-Site": "cross-site"}
        ) as response:
            assert response.status == 200
            assert response.headers["Access-Control-Allow-Origin"] == friend
            assert response.headers["Vary"] == "Origin"
        async with site.session.ws_connect(f"{site.url}/light", headers={"Origin": friend}):
            pass
        for path, origin in (
            ("/light.json", "http://localhost:5174"),
            ("/light.json", "https://evil.example"),
            ("/light.json", "null"),
            ("/download/frame.png", friend),  # the light alone
            ("/", friend),
        ):
            async with site.session.get(site.url + path, headers={"Origin": origin}) as response:
                assert response.status == 403, (path, origin)
                assert "Access-Control-Allow-Origin" not in response.headers
        with pytest.raises(aiohttp.WSServerHandshakeError):
            await site.session.ws_connect(f"{site.url}/live", headers={"Origin": friend})


@run
async def test_who_has_asked_counts_as_a_viewer_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "WATCH_SECONDS", 3.0)
    async with served() as site:
        await known_light(site)
        await known_light(site)
        controls = (await site.server.started())._controls
        assert controls.watchers >= 2, "one for each request"
        while controls.watchers:
            await asyncio.sleep(0.05)


@pytest.mark.parametrize(
    "origin", ["localhost:5173", "http://", "http://a/b", "*", "http://*", "ftp://a", "http://a b"]
)
def test_an_origin_that_is_none_is_named(origin: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="expected an origin such as"):
        check_origin(origin)
    assert live.main(["desk", "--allow-origin", origin, "--no-browser"]) == 2
    assert "--allow-origin" in capsys.readouterr().err
    assert check_origin("https://studio.example:8443") == "https://studio.example:8443"
