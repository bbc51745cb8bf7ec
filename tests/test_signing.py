"""Signing: judged by pymavlink's own signer, by forged and replayed frames, and over restarts."""

from __future__ import annotations

import base64
import hashlib
import logging
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.link.memory import SetClock, memory_pair
from magmav.link.recorder import TlogRecorder
from magmav.mavlink.codec import Codec
from magmav.mavlink.signing import (
    AHEAD,
    MINUTE,
    Signing,
    SigningError,
    StampFile,
    read_key,
    readable_by_others,
)

KEY = hashlib.sha256(b"a key of the tests").digest()
NOW_NS = 1_795_000_000 * 10**9
NOW = (NOW_NS - 1_420_070_400 * 10**9) // 10_000


def signing(file: StampFile | None = None, key: bytes = KEY, now_ns: int = NOW_NS) -> Signing:
    out = Signing(key, 191, file)
    out.tick(now_ns)
    return out


class Peer:
    """pymavlink's own signer as a vehicle."""

    def __init__(self, key: bytes = KEY, *, system: int = 1, link: int = 3, at: int = NOW) -> None:
        self.mav = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
        self.mav.signing.secret_key, self.mav.signing.sign_outgoing = key, True
        self.mav.signing.link_id, self.mav.signing.timestamp = link, at

    def say(self, message: object | None = None) -> bytes:
        return bytes((message or dialect.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3)).pack(self.mav))


def believed(codec: Codec, *frames: bytes) -> list[str]:
    return [m.get_type() for f in frames for m in codec.decode(f, "a", whole=True)]


MESSAGES = (
    dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3),
    dialect.MAVLink_param_set_message(1, 1, b"COMPASS_OFS_X", -17.25, 9),
    dialect.MAVLink_statustext_message(6, b""),
    dialect.MAVLink_ping_message(1 << 60, 7, 0, 0),
)


def test_frames_are_byte_for_byte_what_pymavlink_signs() -> None:
    theirs = Peer(system=1, link=191, at=NOW + 1)
    theirs.mav.srcComponent = 191
    ours = Codec(signer=signing())
    for message in MESSAGES:
        assert ours.encode(message, 1, 191) == theirs.say(message)
        theirs.mav.seq = (theirs.mav.seq + 1) & 0xFF  # pack alone does not count


def test_pymavlink_believes_what_we_sign_and_we_what_it_signs() -> None:
    judge = dialect.MAVLink(None)
    judge.signing.secret_key = KEY
    ours = Codec(signer=signing())
    for message in MESSAGES:
        (got,) = judge.parse_buffer(ours.encode(message, 1, 191))
        assert got.get_type() == message.get_type() and got.get_signed()
    vehicle = Peer()
    assert believed(ours, *(vehicle.say(m) for m in MESSAGES)) == [m.get_type() for m in MESSAGES]
    assert ours.signer.counts == {"signed": len(MESSAGES)}


def test_another_key_and_every_flipped_bit_are_refused() -> None:
    codec = Codec(signer=signing())
    assert believed(codec, Peer(key=bytes(31) + b"\x01").say()) == []
    assert codec.signer.counts == {"bad signature": 1}
    frame = Peer().say()
    for bit in range(8 * len(frame)):
        bad = bytearray(frame)
        bad[bit // 8] ^= 1 << bit % 8
        assert believed(codec, bytes(bad)) == [], bit
    assert believed(codec, frame) == ["HEARTBEAT"]


def test_one_forged_frame_far_ahead_locks_nobody_out() -> None:
    """pymavlink keeps the time of a stream before it checks the hash; then all that is true comes too late."""
    vehicle, forger = Peer(), Peer(key=b"\x07" * 32, at=NOW + 365 * 1440 * MINUTE)
    forged = forger.say()
    codec = Codec(signer=signing())
    own = codec.signer.timestamp
    assert believed(codec, vehicle.say(), forged, vehicle.say()) == ["HEARTBEAT"] * 2
    assert codec.signer.timestamp < own + MINUTE
    theirs = dialect.MAVLink(None)
    theirs.signing.secret_key, theirs.signing.timestamp = KEY, NOW
    theirs.robust_parsing = True
    first = Peer()
    kinds = [theirs.parse_buffer(f)[0].get_type() for f in (first.say(), forged, first.say())]
    assert kinds[2] != "HEARTBEAT", "then this test shows no difference any more"


def test_replayed_and_reordered_frames_are_refused_per_stream() -> None:
    codec, one, other = Codec(signer=signing()), Peer(), Peer(link=4)
    a, b, c = one.say(), one.say(), other.say()
    assert believed(codec, b, a, b, c, c) == ["HEARTBEAT"] * 2
    assert codec.signer.counts == {"signed": 2, "replayed": 3}


@pytest.mark.parametrize(("behind", "taken"), [(MINUTE - 1000, True), (MINUTE + 1000, False)])
def test_a_new_stream_may_be_a_minute_behind(behind: int, taken: bool) -> None:
    codec = Codec(signer=signing())
    assert bool(believed(codec, Peer(at=NOW - behind).say())) is taken
    assert codec.signer.counts["too old"] == (not taken)


def test_S17_unsigned_is_refused_when_a_key_is_set_but_for_radios() -> None:
    codec = Codec(signer=signing())
    plain = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    beat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    first = beat.pack(dialect.MAVLink(None, srcSystem=1, srcComponent=1), force_mavlink1=True)
    radio = dialect.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)
    assert believed(codec, bytes(beat.pack(plain)), bytes(first), bytes(radio.pack(plain))) == ["RADIO_STATUS"]
    assert codec.signer.counts == {"unsigned": 2, "unsigned radio": 1}
    signed_before = Peer().say()
    stripped = bytearray(signed_before[:-13])
    stripped[2] = 0  # the signature cut off and the flag taken away: the checksum, too, is made anew
    body = bytes(stripped[1:-2])
    from fastcrc import crc16

    stripped[-2:] = crc16.mcrf4xx(body + bytes((dialect.MAVLink_heartbeat_message.crc_extra,))).to_bytes(2, "little")
    assert believed(Codec(), bytes(stripped)) == ["HEARTBEAT"]
    assert believed(codec, bytes(stripped)) == []


def test_without_a_key_signed_frames_are_read_unchecked() -> None:
    assert believed(Codec(), Peer().say()) == ["HEARTBEAT"]


# ------------------------------------------------------------ timestamps


def stamp(frame: bytes) -> int:
    return int.from_bytes(frame[-12:-6], "little")


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(-90, 90), st.integers(0, 40), st.booleans()), min_size=1, max_size=12))
def test_timestamps_grow_over_restarts_kills_and_clocks_set_back(
    tmp_path_factory: pytest.TempPathFactory, lives: list[tuple[int, int, bool]]
) -> None:
    """Each life: where its clock stands (s), how many frames it signs, one a second, and whether it ends cleanly."""
    file = StampFile(tmp_path_factory.mktemp("stamps") / "signing.json")
    last = 0
    for clock_s, frames, clean in lives:
        signer = signing(file, now_ns=NOW_NS + clock_s * 10**9)
        codec = Codec(signer=signer)
        for n in range(frames):
            signer.tick(NOW_NS + (clock_s + n) * 10**9)
            at = stamp(codec.encode(MESSAGES[0], 1, 191))
            assert at > last
            last = at
        if clean:
            signer.leave()


def test_what_was_heard_before_a_restart_is_not_heard_again(tmp_path: Path) -> None:
    file, vehicle = StampFile(tmp_path / "signing.json"), Peer()
    first = Codec(signer=signing(file))
    old = vehicle.say()
    assert believed(first, old) == ["HEARTBEAT"]
    first.signer.leave()
    second = Codec(signer=signing(file))
    assert believed(second, old, vehicle.say()) == ["HEARTBEAT"]
    assert second.signer.counts["replayed"] == 1


def test_a_true_sender_ahead_of_us_carries_our_time_along(tmp_path: Path) -> None:
    file = StampFile(tmp_path / "signing.json")
    codec = Codec(signer=signing(file))
    believed(codec, Peer(at=NOW + 5 * MINUTE).say())
    assert stamp(codec.encode(MESSAGES[0], 1, 191)) > NOW + 5 * MINUTE
    later = Codec(signer=signing(file))  # killed: nothing was kept at the end
    assert stamp(later.encode(MESSAGES[0], 1, 191)) > NOW + 5 * MINUTE + AHEAD - MINUTE


def test_the_file_is_written_seldom_and_whole(tmp_path: Path) -> None:
    file = StampFile(tmp_path / "deep" / "signing.json")
    signer = signing(file)
    codec = Codec(signer=signer)
    seen = set()
    for n in range(600):
        signer.tick(NOW_NS + n * 10**8)
        codec.encode(MESSAGES[0], 1, 191)
        seen.add(file.path.read_bytes())
    assert len(seen) <= 3, "a minute of ten frames a second"
    assert [p.name for p in file.path.parent.iterdir()] == ["signing.json"]
    for damaged in (b"", b"{", b'{"bound": "x", "streams": []}', b"[]", b'{"bound": 1, "streams": [[1]]}'):
        file.path.write_bytes(damaged)
        with pytest.raises(SigningError, match=r"signing\.json"):
            file.load()


def test_a_full_disk_is_said_and_counted_and_signing_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "nowhere").write_text("a file where the folder should be")
    file = StampFile.__new__(StampFile)
    file.path = tmp_path / "nowhere" / "signing.json"
    signer = Signing(KEY, 1)
    signer._file = file
    signer.tick(NOW_NS)
    assert len(Codec(signer=signer).encode(MESSAGES[0], 1, 191)) > 20
    assert signer.counts["not saved"] == 1 and "cannot be kept" in caplog.text


# ------------------------------------------------------------ keys


def test_key_files_in_every_form_give_the_same_key(tmp_path: Path) -> None:
    key = hashlib.sha256(b"correct horse").digest()
    forms = {
        "raw": key,
        "hex": key.hex().encode() + b"\n",
        "HEX": key.hex().upper().encode(),
        "base64": base64.b64encode(key) + b"\r\n",
        "words": b"passphrase:correct horse\n",
    }
    for name, data in forms.items():
        path = tmp_path / name
        path.write_bytes(data)
        assert read_key(path) == key, name


def test_a_passphrase_is_hashed_as_mavproxy_hashes_it(tmp_path: Path) -> None:
    """mavproxy_signing.py: SHA-256 of the words. The digest below is sha256sum's."""
    (tmp_path / "k").write_text("passphrase:abc")
    assert read_key(tmp_path / "k").hex() == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"secret words of mine",
        b"0" * 63,
        b"zz" * 32,
        b"passphrase:",
        b"a" * 32,
        b"\xff" * 31,
        b"\0" * 32,
    ],
)
def test_what_is_no_key_is_refused_without_being_shown(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(data)
    with pytest.raises(SigningError) as error:
        read_key(path)
    assert str(path) in str(error.value)
    assert not data or data.decode("latin-1") not in str(error.value).replace("passphrase:WORDS", "")
    with pytest.raises(SigningError, match="cannot be read"):
        read_key(tmp_path / "missing")


def test_a_key_others_may_read_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_bytes(KEY)
    path.chmod(0o600)
    assert not readable_by_others(path)
    path.chmod(0o644)
    assert readable_by_others(path)


def test_S17_no_key_in_log_repr_error_or_recording(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Everything is logged, a key is sent past us, wrong ones are used; no form of it turns up anywhere."""
    caplog.set_level(logging.DEBUG)
    clock = SetClock(10**9)
    here, there = memory_pair(clock, unix_offset_ns=NOW_NS)
    link = TlogRecorder(here, tmp_path / "day.tlog")
    codec = Codec(signer=signing(StampFile(tmp_path / "signing.json")))
    setup = dialect.MAVLink_setup_signing_message(1, 1, list(KEY), 5)
    vehicle = Peer()
    sent = [vehicle.say(setup), vehicle.say(), Peer(key=b"\x09" * 32).say(), vehicle.say()[:-1] + b"?"]
    packets = link.packets()
    got = []
    for frame in sent:
        there.send(frame)
        got += codec.decode(next(packets).data, "a", whole=True)
    link.send(codec.encode(MESSAGES[0], 1, 191))
    link.close()
    assert [m.get_type() for m in got] == ["HEARTBEAT"]
    assert link.counts["keys not recorded"] == 1 and link.counts["recorded"] == 4
    said = caplog.text + repr(codec.signer) + str(codec.signer) + str(codec.counts) + repr(got)
    kept = b"".join(p.read_bytes() for p in tmp_path.iterdir())
    assert "refused" in caplog.text and len(kept) > 100
    for form in (KEY, KEY.hex().encode(), base64.b64encode(KEY), str(list(KEY)).encode(), repr(KEY).encode()):
        assert form not in said.encode() and form not in kept
