"""A link that MAVProxy signs: pymavlink's own signing, as MAVProxy uses it, is the other end of every test here."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import pytest
from fleet_rig import Airspace, Craft
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Reason
from magmav.host_signing import HostKey, HostSigning
from magmav.mavlink.codec import Codec
from magmav.mavlink.metadata import ComponentMetadata
from magmav.mavlink.signing import Signing
from magmav.plugin import Desk

KEY = hashlib.sha256(b"mavproxy's passphrase").digest()
OTHER = hashlib.sha256(b"another").digest()
STAMP = 37_000_000_000_000


def mav(system: int, component: int, key: bytes | None = KEY, link: int = 0, stamp: int = STAMP) -> Any:
    """pymavlink's end, as mavutil.setup_signing leaves it."""
    out = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
    if key is not None:
        out.signing.secret_key, out.signing.sign_outgoing = key, True
        out.signing.link_id, out.signing.timestamp = link, stamp
    return out


def host_key(master: Any) -> HostKey:
    return HostKey(bytes(master.signing.secret_key), master.signing.link_id, master.signing.timestamp)


def beat(armed: bool = False) -> Any:
    return dialect.MAVLink_heartbeat_message(2, 3, 128 if armed else 0, 0, 4, 3)


def test_what_we_send_over_a_signed_link_is_believed_by_the_vehicle_beside_what_mavproxy_sends() -> None:
    master, vehicle, host = mav(255, 230), mav(1, 1, link=9), HostSigning()
    ours = Codec()
    for n in range(50):
        theirs = dialect.MAVLink_param_request_list_message(1, 1)
        assert vehicle.decode(bytearray(theirs.pack(master))).get_srcComponent() == 230
        plain = ours.encode(dialect.MAVLink_param_request_read_message(1, 1, b"COMPASS_OFS_X", n), 1, 191)
        with pytest.raises(dialect.MAVError, match="signature"):
            vehicle.decode(bytearray(plain))
        message = vehicle.decode(bytearray(host.sent(plain, host_key(master))))
        assert (message.param_index, message.get_srcComponent()) == (n, 191)
    assert vehicle.signing.badsig_count == 0


def test_only_what_is_signed_with_the_key_is_read_on_and_it_comes_out_plain() -> None:
    vehicle, host, key = mav(1, 1), HostSigning(), HostKey(KEY, 0, STAMP)
    signed = bytes(beat().pack(vehicle))
    assert host.heard(signed, key) == bytes(beat().pack(mav(1, 1, None)))
    assert host.heard(signed, key) is None, "played again"
    assert host.heard(bytes(beat().pack(mav(1, 1, None))), key) is None, "unsigned, as allow_unsigned lets pass"
    assert host.heard(bytes(beat().pack(mav(1, 1, OTHER, stamp=2 * STAMP))), key) is None, "forged"
    vehicle.seq = 1
    later = host.heard(bytes(beat(armed=True).pack(vehicle)), key)
    assert later is not None and Codec().decode(later, "a", whole=True)[0].base_mode == 128
    assert host.counts == {"signed": 2, "replayed": 1, "unsigned": 1, "bad signature": 1}


def test_without_a_key_nothing_is_touched_and_a_key_may_come_and_go() -> None:
    host, frame, signed = HostSigning(), Codec().encode(beat(), 1, 191), bytes(beat().pack(mav(1, 1)))
    assert (host.heard(signed, None), host.sent(frame, None)) == (signed, frame)
    key = HostKey(KEY, 3, STAMP)
    assert len(host.sent(frame, key)) == len(frame) + 13
    assert host.sent(frame, None) == frame
    assert KEY.hex() not in repr(key) and repr(KEY) not in repr(key), "S17"


def test_component_metadata_which_the_dialect_lacks_is_signed_too() -> None:
    signing = Signing(KEY, 1)
    frame = Codec(signer=signing).encode(ComponentMetadata(1, 2, b"mftp://x"), 1, 191)
    assert signing.good(frame, 397)
    assert HostSigning().sent(Codec().encode(ComponentMetadata(1, 2, b"mftp://x"), 1, 191), HostKey(KEY, 0, STAMP))


class _Hosted(Airspace):
    """An Airspace whose one link belongs to a host that signs, or does not."""

    def __init__(self, folder: Path, craft: Craft, key: HostKey | None) -> None:
        super().__init__(folder, craft, single=True)
        self.key, self.host, self.bytes = key, HostSigning(), Codec()

    def push(self, data: bytes, route: str) -> None:
        frame = self.host.heard(data, self.key)
        if frame is not None:
            super().push(frame, route)


@pytest.mark.parametrize("with_key", [True, False])
def test_the_session_on_a_signed_link_works_with_the_hosts_key_and_only_listens_without(
    tmp_path: Path, with_key: bool
) -> None:
    craft = Craft(1, "udp:1", key=KEY)
    stamp = craft.mav.signing.timestamp
    air = _Hosted(tmp_path, craft, HostKey(KEY, 0, stamp) if with_key else None)
    air.run(15.0)
    companion, desk = air.session.companion, Desk(air.session, air.store)
    asked = {m.get_type() for m in craft.heard if hasattr(m, "target_system")}
    assert companion.sealed is not with_key
    assert bool(asked) is with_key
    said = any(Reason.LINK_SIGNED_READ_ONLY.name in line for line in desk.answer(["status"]))
    refused = desk.answer(["upload"]) == [f"refused: {Reason.LINK_SIGNED_READ_ONLY.text}"]
    assert (said, refused) == (not with_key, not with_key)
    air.store.close()
