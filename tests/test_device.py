"""Keeping threads off a device while another one needs it for itself."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from warp_ar import device
from warp_ar.device import exclusive


def held_by_another(device: SimpleNamespace) -> bool:
    """Whether another thread can enter while this one is inside."""
    entered = threading.Event()

    def enter() -> None:
        with exclusive(device):
            entered.set()

    with exclusive(device), exclusive(device):  # twice: a pipeline that builds a scheduler enters again
        thread = threading.Thread(target=enter)
        thread.start()
        held = not entered.wait(0.2)
    thread.join()
    assert entered.is_set()
    return held


def test_one_thread_at_a_time_on_cuda_and_all_on_cpu() -> None:
    assert held_by_another(SimpleNamespace(is_cuda=True))
    assert not held_by_another(SimpleNamespace(is_cuda=False))


class _Cuda:
    """A CUDA device whose context takes a while."""

    is_cuda = True

    def __init__(self) -> None:
        self.opened, self.may_open, self.threads = threading.Event(), threading.Event(), []

    def __str__(self) -> str:
        return "cuda:0"

    @property
    def context(self) -> int:
        self.threads.append(threading.current_thread())
        assert self.may_open.wait(60.0)
        self.opened.set()
        raise RuntimeError("no memory")


@pytest.fixture
def cuda(monkeypatch) -> _Cuda:
    """The one CUDA device of the machine."""
    found = _Cuda()
    monkeypatch.setattr(device, "_OPENING", [])
    monkeypatch.setattr(device, "start_warp", lambda: None)
    monkeypatch.setattr(device.wp, "get_devices", lambda: [SimpleNamespace(is_cuda=False), found])
    monkeypatch.setattr(device.wp, "get_device", lambda name: found)
    return found


@pytest.mark.parametrize("name", ["auto", "cuda", "cuda:0"])
def test_a_context_is_made_beside_and_waited_for(cuda, monkeypatch, name) -> None:
    monkeypatch.setattr(device.wp, "is_cuda_available", lambda: True)
    device.open_ahead(name)
    device.open_ahead(name)
    assert not cuda.opened.is_set()
    threading.Timer(0.2, cuda.may_open.set).start()
    assert device.resolve_device(name) is cuda
    assert cuda.opened.is_set()
    (thread,) = cuda.threads
    assert thread is not threading.current_thread()
    assert not thread.is_alive()


@pytest.mark.parametrize("name", ["cpu", "cuda:1", "tpu"])
def test_no_context_is_made_of_what_is_no_cuda_device_here(cuda, name) -> None:
    device.open_ahead(name)
    assert not device._OPENING
