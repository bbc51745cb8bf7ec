"""The words for a link: each form opens what it says, each mistake is named."""

from __future__ import annotations

import os
import socket
import struct
from pathlib import Path

import pytest

from magmav.link import LinkError
from magmav.link.open import FORMS, open_link
from magmav.link.stream import StreamLink
from magmav.link.tlog import TlogLink
from magmav.link.udp import UdpLink


def test_udp_forms_open_the_address_they_name() -> None:
    for text in ("udpin:127.0.0.1:0", "udpin::0", "udpin:localhost:0"):
        link = open_link(text)
        assert isinstance(link, UdpLink) and link.port > 0 and link.warning == ""
        out = open_link(f"udpout:127.0.0.1:{link.port}")
        assert isinstance(out, UdpLink) and out.routes == (f"udp:127.0.0.1:{link.port}",)
        out.send(b"x")
        assert next(p for p in link.packets() if p.data).route == f"udp:127.0.0.1:{out.port}"
        link.close()
        out.close()


def test_a_default_udpin_is_reached_by_this_machine_only() -> None:
    link = open_link("udpin::0")
    assert link.name == "udpin:127.0.0.1:0"
    link.close()


def test_tcp_and_serial_and_files_open() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = open_link(f"tcp:localhost:{server.getsockname()[1]}", tick_s=0.01)
        assert isinstance(link, StreamLink) and not link.datagrams
        link.close()
    far, near = os.openpty()
    try:
        for text, name in (("", ":57600"), (":115200", ":115200")):
            link = open_link(f"serial:{os.ttyname(near)}{text}")
            assert link.name == f"serial:{os.ttyname(near)}{name}"
            link.close()
    finally:
        os.close(far)
        os.close(near)


def test_a_device_name_may_hold_colons(tmp_path: Path) -> None:
    far, near = os.openpty()
    try:
        device = tmp_path / "usb-0:1"
        device.symlink_to(os.ttyname(near))
        for text in (f"serial:{device}", f"serial:{device}:57600"):
            link = open_link(text)
            assert link.name == f"serial:{device}:57600"
            link.close()
    finally:
        os.close(far)
        os.close(near)


def test_a_tlog_opens_by_its_path_and_tells_its_progress(tmp_path: Path) -> None:
    path = tmp_path / "flight.TLOG"
    path.write_bytes(struct.pack(">Q", 1_700_000_000_000_000) + bytes((0xFE, 1, 0, 1, 1, 0, 7, 8, 9)))
    seen: list[tuple[int, int]] = []
    link = open_link(str(path), progress=lambda done, size: seen.append((done, size)))
    assert isinstance(link, TlogLink) and [len(p.data) for p in link.packets()] == [9]
    assert seen[-1] == (17, 17)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "this is no link"),
        ("udp:127.0.0.1:14550", "there is no link 'udp'"),
        ("UDPIN::14550", "write udpin in small letters"),
        ("udpin:14550", "the port is missing"),
        ("udpin:127.0.0.1:", "'' is not a port"),
        ("udpin:127.0.0.1:65536", "'65536' is not a port"),
        ("udpin:127.0.0.1:-1", "'-1' is not a port"),
        ("udpin:127.0.0.1:1e3", "'1e3' is not a port"),
        ("udpin:127.0.0.1:٣", "is not a port"),
        ("udpin:::1:14550", "wants brackets"),
        ("udpout::14550", "the host is missing"),
        ("udpout:127.0.0.1:0", "port 0 cannot be talked to"),
        ("tcp:127.0.0.1:0", "port 0 cannot be talked to"),
        ("serial:", "the device is missing"),
        ("serial::57600", "the device is missing"),
        ("serial:/dev/nosuch:fast", "'fast' is not a baud rate"),
        ("serial:/dev/nosuch:0", "'0' is not a baud rate"),
        ("/dev/ttyACM0", "serial:/dev/ttyACM0:57600"),
        ("flight.bin", "this is no link"),
    ],
)
def test_a_mistake_is_named_and_the_forms_are_listed(text: str, says: str) -> None:
    with pytest.raises(LinkError) as caught:
        open_link(text)
    assert says in str(caught.value) and str(caught.value).startswith(text)
    assert FORMS in str(caught.value) or "cannot be talked to" in says or "host is missing" in says


def test_a_missing_tlog_is_named(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"gone\.tlog: no such file"):
        open_link(str(tmp_path / "gone.tlog"))
