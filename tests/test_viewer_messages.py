"""What the page and its server say to each other: what is understood, what is refused and why."""

from __future__ import annotations

import contextlib
import json
import math
import random
from typing import Any

import cv2
import numpy as np
import pytest

from tests.viewer_rig import GOOD, jpeg, mutated, picture_message
from warp_ar.checks.finding import Finding
from warp_ar.viewer.protocol import Bucket, ProtocolError, parse_picture, parse_text
from warp_ar.viewer.setup import page_record


@pytest.mark.parametrize("message", GOOD, ids=lambda m: m["type"])
def test_what_the_page_says_is_understood(message: dict[str, Any]) -> None:
    command = parse_text(json.dumps(message))

    def plain(value: Any) -> Any:
        return tuple(map(plain, value)) if isinstance(value, list) else value

    values = [plain(v) for k, v in message.items() if k != "type"]
    assert command.type == message["type"]
    assert list(command.fields.values()) == values


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "no JSON"),
        ("[" * 4000, "no JSON"),
        ("[]", "no known type"),
        ('{"type": "exec", "code": 1}', "no known type"),
        ('{"type": "ack"}', "ack takes id"),
        ('{"type": "ack", "id": 1, "more": 1}', "ack takes id"),
        ('{"type": "ack", "id": -1}', "ack: id"),
        ('{"type": "ack", "id": 1e3}', "ack: id"),
        ('{"type": "ping", "sent": NaN}', "ping: sent"),
        ('{"type": "set", "part": "camera", "index": 0, "key": "fx", "value": 1}', "set: part"),
        ('{"type": "set", "part": "light", "index": 0, "key": "at", "value": [1, 2, 3, 4]}', "set: value"),
        ('{"type": "add", "part": "probe", "kind": "sphere"}', "add: part"),
        ('{"type": "outline", "kind": "wall", "points": [[0, 0], [1, 0], [1, 1], [0, "x"]]}', "outline: points"),
        ('{"type": "card", "radius": "large", "ruler": 0.1}', "card: radius"),
        ('{"type": "camera", "width": 100000, "height": 480}', "camera: width"),
        ('{"type": "quality", "name": "' + "x" * 5000 + '"}', "quality: name"),
    ],
)
def test_what_no_page_says_is_refused_with_a_reason(text: str, reason: str) -> None:
    with pytest.raises(ProtocolError, match=reason):
        parse_text(text)


def test_pictures_are_measured_before_they_are_decoded() -> None:
    progressive = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1))[1].tobytes()
    for data in (jpeg(), progressive):
        picture = parse_picture(picture_message(data, 7.5, 3), (64, 48))
        assert (picture.taken, picture.id, picture.jpeg) == (7.5, 3, data)
    bomb = bytearray(jpeg())
    start = bomb.index(b"\xff\xc0")
    bomb[start + 5 : start + 9] = b"\xff\xff\xff\xff"  # 65535 x 65535: 12 GB
    for data, reason in [
        (picture_message(bytes(bomb)), "65535x65535"),
        (picture_message(jpeg(32, 48)), "32x48"),
        (picture_message(b"\x89PNG"), "no JPEG"),
        (picture_message(jpeg()[:20]), "no JPEG"),
        (picture_message(jpeg(), math.nan), "no sensible time"),
        (picture_message(jpeg(), -1.0), "no sensible time"),
        (b"12", "holds no picture"),
    ]:
        with pytest.raises(ProtocolError, match=reason):
            parse_picture(data, (64, 48))


def test_rate_is_bounded_and_comes_back() -> None:
    bucket = Bucket(rate=10.0, burst=20.0)
    assert sum(bucket.take(1.0, 100.0) for _ in range(100)) == 20
    assert sum(bucket.take(1.0, 100.5) for _ in range(100)) == 5
    assert not bucket.take(21.0, 1e9)


def test_ten_thousand_random_messages_are_understood_or_refused() -> None:
    rng = random.Random(0)
    understood = 0
    for _ in range(10_000):
        message = mutated(rng)
        with contextlib.suppress(ProtocolError):
            if isinstance(message, str):
                understood += parse_text(message) is not None
            else:
                parse_picture(message, (64, 48))
    assert 1000 < understood < 9000  # else the fuzz tries only one of the two


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("no DICT_4X4_50 charuco 5x4 0.032 0.024 in 4 frames", "no printed card in 4 frames"),
        ("no DICT_4X4_50 id 7; the picture shows DICT_5X5_100 3", "marker 7 of the family 4X4_50; the picture shows"),
        ("lies as the [marker] says, and run python -m warp_ar.calibrate camera PICTURES", "and press “Calibrate”"),
        ("[[object]] 0 (mesh) lies left", "the scene’s object 0 (mesh) lies left"),
        ("or python -m warp_ar.calibrate response PICTURES", "or press “Measure from the card’s greys”"),
    ],
)
def test_findings_name_what_the_page_has(text: str, words: str) -> None:
    """Not commands, sections of files and names of dictionaries."""
    said = page_record(Finding("name", text, text))["text"]
    assert words in said
    assert not any(word in said for word in ("DICT_", "[", "python -m"))
