"""Frames out of anything: intact ones behind garbage are always found, nothing raises, memory is bounded."""

import struct
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Codec

ME = (7, 1)


def imu(xmag, time_usec=1_000_000):
    """A RAW_IMU told apart by xmag."""
    return dialect.MAVLink_raw_imu_message(time_usec, 0, 0, -1000, 1, 2, 3, xmag, 50, -60)


def frame(xmag):
    return Codec().encode(imu(xmag), *ME)


def first_version(xmag, sequence=0):
    mav = dialect.MAVLink(None, srcSystem=ME[0], srcComponent=ME[1])
    mav.seq = sequence
    return bytes(imu(xmag).pack(mav, force_mavlink1=True))


def signed(xmag):
    mav = dialect.MAVLink(None, srcSystem=ME[0], srcComponent=ME[1])
    mav.signing.secret_key, mav.signing.link_id, mav.signing.timestamp = bytes(range(32)), 3, 77
    mav.signing.sign_outgoing = True
    return bytes(imu(xmag).pack(mav))


def marks(messages):
    return [m.xmag for m in messages]


GARBAGE = st.binary(max_size=80)
# A false start is bytes that look like a header; one may claim the real frame behind it as its own content.
FALSE_START = st.sampled_from(
    (b"\xfd", b"\xfe", b"\xfd\xff\x00\x00", b"\xfe\x09\x00\x01", b"\xfd\x1d\x01", b"\xfe\xff")
)
MAKERS = st.sampled_from((frame, first_version, signed))


@given(st.lists(st.tuples(GARBAGE | FALSE_START, MAKERS), min_size=1, max_size=5), GARBAGE)
def test_in_a_datagram_every_intact_frame_is_found_whatever_stands_between(parts, tail):
    data = b"".join(junk + make(i) for i, (junk, make) in enumerate(parts, 1)) + tail
    codec = Codec()
    assert marks(codec.decode(data, "a", whole=True)) == list(range(1, len(parts) + 1))


@given(
    st.lists(st.tuples(GARBAGE | FALSE_START, MAKERS), min_size=1, max_size=5),
    st.lists(st.integers(0, 600), max_size=6),
)
def test_in_a_stream_every_intact_frame_is_found_however_it_is_cut(parts, cuts):
    data = b"".join(junk + make(i) for i, (junk, make) in enumerate(parts, 1))
    # A false start may wait for up to its claimed length: whatever comes next settles it.
    data += bytes(300)
    edges = sorted({min(c, len(data)) for c in cuts} | {0, len(data)})
    codec = Codec()
    got = [m for a, b in pairwise(edges) for m in codec.decode(data[a:b], "a", whole=False)]
    assert marks(got) == list(range(1, len(parts) + 1))
    assert codec.counts["messages"] == len(parts)


def test_a_stream_split_at_any_byte_gives_the_same():
    data = frame(1) + b"\xfdjunk" + first_version(2) + signed(3) + bytes(300)
    for cut in range(len(data) + 1):
        codec = Codec()
        got = codec.decode(data[:cut], "a", whole=False) + codec.decode(data[cut:], "a", whole=False)
        assert marks(got) == [1, 2, 3], cut


def test_byte_by_byte():
    codec, got = Codec(), []
    for value in frame(1) + frame(2) + first_version(3):
        got += codec.decode(bytes((value,)), "a", whole=False)
    assert marks(got) == [1, 2, 3]


@settings(max_examples=200)
@given(st.binary(max_size=400), st.booleans())
def test_garbage_alone_never_raises_and_is_counted(data, whole):
    codec = Codec()
    codec.decode(data, "a", whole=whole)
    if whole and not codec.counts["messages"] + codec.counts["bad content"]:
        assert codec.counts["garbage bytes"] == len(data)


def test_every_byte_is_either_garbage_or_part_of_a_frame():
    one = frame(1)
    codec = Codec()
    codec.decode(b"abc" + one + b"\xfdxyz" + one + b"!", "a", whole=True)
    assert codec.counts["messages"] == 2
    assert codec.counts["garbage bytes"] == 3 + 4 + 1


def test_ten_megabytes_of_false_starts_leave_at_most_one_frame_in_memory():
    codec, block = Codec(), b"\xfd\xff\x00\x00\x00\x00\x00" + b"\xfd" * 249
    for _ in range(4):
        codec.decode(block * 10, "a", whole=False)
        assert sum(map(len, codec._rest.values())) < 300
    plain = bytes(range(0xFD)) * 1000
    for _ in range(40):
        codec.decode(plain, "a", whole=False)
    assert sum(map(len, codec._rest.values())) < 300
    assert marks(codec.decode(frame(5), "a", whole=False)) == [5]
    assert codec.counts["garbage bytes"] > 10_000_000


def test_nothing_is_carried_over_between_datagrams():
    codec, one = Codec(), frame(1)
    assert codec.decode(one[:20], "a", whole=True) == []
    assert codec.decode(one[20:], "a", whole=True) == []
    assert marks(codec.decode(one, "a", whole=True)) == [1]


def test_routes_do_not_mix_and_a_route_can_be_forgotten():
    codec, one = Codec(), frame(1)
    codec.decode(one[:20], "a", whole=False)
    assert codec.decode(one[20:], "b", whole=False) == []
    assert marks(codec.decode(one[20:], "a", whole=False)) == [1]
    codec.decode(one[:20], "a", whole=False)
    codec.forget("a")
    assert codec.decode(one[20:] + bytes(300), "a", whole=False) == []


@pytest.mark.parametrize("make", [frame, first_version, signed])
def test_each_flipped_bit_is_caught(make):
    good = make(9)
    signature = 13 if make is signed else 0
    for i in range(len(good) - signature):
        bad = bytearray(good)
        bad[i] ^= 0x10
        assert Codec().decode(bytes(bad), "a", whole=True) == [], i


def test_a_bad_checksum_is_counted_and_costs_one_frame():
    bad = bytearray(frame(1))
    bad[12] ^= 0xFF
    codec = Codec()
    assert marks(codec.decode(bytes(bad) + frame(2), "a", whole=True)) == [2]
    assert codec.counts["bad crc"] >= 1


def test_an_unknown_message_hides_nothing_behind_it():
    unknown = bytes((0xFD, 4, 0, 0, 0, 7, 1, 0xF0, 0xFF, 0xFF)) + b"abcd" + b"\x12\x34"
    codec = Codec()
    assert marks(codec.decode(unknown + frame(1), "a", whole=True)) == [1]
    assert codec.counts["unknown"] == 1


def test_a_frame_with_flags_nobody_knows_is_not_read():
    odd = bytearray(frame(1))
    odd[2] = 0x02
    assert marks(Codec().decode(bytes(odd) + frame(2), "a", whole=True)) == [2]


def test_text_that_is_no_text_does_not_raise():
    text = dialect.MAVLink_statustext_message(4, b"\xff\xfe\x80 broken")
    assert len(Codec().decode(Codec().encode(text, *ME), "a", whole=True)) == 1
    name = dialect.MAVLink_param_value_message(b"\xc3\x28\xff", 1.0, 9, 1, 0)
    codec = Codec()
    got = codec.decode(Codec().encode(name, *ME) + frame(2), "a", whole=True)
    assert [m.get_type() for m in got][-1] == "RAW_IMU"
    assert len(got) + codec.counts["bad content"] == 2


def test_only_wanted_messages_are_decoded_but_all_are_checked():
    codec = Codec(frozenset({"ATTITUDE"}))
    attitude = dialect.MAVLink_attitude_message(5, 0.1, 0.2, 0.3, 0, 0, 0)
    got = codec.decode(frame(1) + Codec().encode(attitude, *ME), "a", whole=True)
    assert [m.get_type() for m in got] == ["ATTITUDE"]
    assert codec.counts["skipped"] == 1
    assert codec.counts["garbage bytes"] == 0


def test_round_trip_keeps_values_and_identity():
    message = dialect.MAVLink_param_set_message(7, 1, b"COMPASS_OFS_X", struct.unpack("<f", b"\x33\x33\xb3\x42")[0], 9)
    (got,) = Codec().decode(Codec().encode(message, 7, 191), "a", whole=True)
    assert (got.get_srcSystem(), got.get_srcComponent()) == (7, 191)
    assert (got.param_id, got.param_value, got.param_type) == ("COMPASS_OFS_X", message.param_value, 9)


@given(st.integers(-32768, 32767), st.integers(0, 2**63))
def test_round_trip_of_any_number(xmag, time_usec):
    (got,) = Codec().decode(Codec().encode(imu(xmag, time_usec), *ME), "a", whole=True)
    assert (got.xmag, got.time_usec) == (xmag, time_usec)


def test_each_identity_counts_its_own_frames_and_wraps():
    codec = Codec()
    ones = [codec.encode(imu(1), 7, 191)[4] for _ in range(258)]
    assert ones == [i % 256 for i in range(258)]
    assert codec.encode(imu(1), 8, 191)[4] == 0
    assert codec.encode(imu(1), 7, 191)[4] == 2
    assert codec.encode(imu(1), 7, 192)[4] == 0


def test_what_is_sent_is_the_second_version_with_its_own_identity():
    sent = frame(1)
    assert sent[0] == 0xFD
    assert (sent[5], sent[6]) == ME
    assert struct.unpack_from("<I", sent[7:10] + b"\0")[0] == 27
