"""Who is latched, over which route, and how we behave on the wire."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import MS, S, Wire

from magmav.mavlink.presence import Presence

WIRE = Wire()


def heartbeat(system: int = 1, component: int = 1, autopilot: int = 3, kind: int = 2, armed: bool = False) -> Any:
    message = dialect.MAVLink_heartbeat_message(kind, autopilot, 128 * armed, 0, 4, 3)
    return WIRE.carry(message, system, component)


def hear(presence: Presence, seconds: float, *messages: tuple[Any, str], from_s: float = 0.0) -> list[Any]:
    """Each message once a second, polled every 100 ms; what was sent is returned."""
    out = []
    for tick in range(round(from_s * 10), round((from_s + seconds) * 10)):
        now_ns = tick * 100 * MS
        if tick % 10 == 0:
            for message, route in messages:
                out += presence.on_message(message, route, now_ns)
        out += presence.poll(now_ns)
    return out


def test_the_one_autopilot_is_latched_after_three_seconds() -> None:
    presence = Presence()
    hear(
        presence,
        2.9,
        (heartbeat(7), "a"),
        (heartbeat(255, 190, 8, 6), "gcs"),
        (heartbeat(7, 154, 8, 26), "a"),
    )
    assert presence.autopilot is None
    hear(presence, 0.3, (heartbeat(7, armed=True), "a"), from_s=2.9)
    assert presence.autopilot is not None
    assert presence.autopilot.pin == (7, 1, "a") and presence.autopilot.armed
    assert presence.autopilot.heartbeat_ns == 3 * S and presence.system == 7


def test_two_systems_latch_none_and_say_so_unless_one_is_named() -> None:
    both = (heartbeat(1), "a"), (heartbeat(2), "a")
    presence = Presence()
    sent = hear(presence, 6.0, *both)
    assert presence.autopilot is None and presence.ambiguous == (1, 2)
    assert sent == [], "nobody is impersonated"
    named = Presence(target_system=2)
    hear(named, 1.0, *both)
    assert named.autopilot is not None and named.autopilot.system == 2 and named.ambiguous == ()


def test_component_one_is_preferred_to_a_gimbal_that_says_ardupilot() -> None:
    presence = Presence()
    hear(presence, 4.0, (heartbeat(1, 154), "a"), (heartbeat(1, 1), "a"))
    assert presence.autopilot is not None and presence.autopilot.component == 1
    late = Presence()
    hear(late, 4.0, (heartbeat(1, 154), "a"))
    assert late.autopilot is not None and late.autopilot.component == 154
    hear(late, 1.0, (heartbeat(1, 1), "a"), from_s=4.0)
    assert late.autopilot.component == 1


def test_our_own_heartbeat_coming_back_is_nobody() -> None:
    presence = Presence()
    hear(presence, 5.0, (heartbeat(1, 191), "loop"))
    assert presence.autopilot is None and presence.ambiguous == ()


def test_heartbeat_once_a_second_with_our_identity_fields() -> None:
    presence = Presence()
    sent = hear(presence, 13.0, (heartbeat(), "a"))
    assert len(sent) == 10, "from the latch at 3 s on"
    beat = sent[0].message
    assert (beat.type, beat.autopilot, beat.base_mode, beat.system_status) == (18, 8, 0, 4)
    assert sent[0].route == "", "to every peer"


def test_we_speak_first_when_nobody_does_as_the_named_system_or_one() -> None:
    assert len(hear(Presence(), 5.0)) == 5 and Presence().system == 1
    assert Presence(target_system=9).system == 9


def test_no_poll_no_heartbeat_and_no_burst_afterwards() -> None:
    presence = Presence()
    hear(presence, 5.0, (heartbeat(), "a"))
    assert all(not presence.on_message(heartbeat(), "a", t * S) for t in range(5, 60))
    assert len(hear(presence, 1.0, from_s=60.0)) == 1


def test_route_is_pinned_and_moves_only_after_five_seconds_of_silence() -> None:
    presence = Presence()
    hear(presence, 4.0, (heartbeat(), "a"))
    hear(presence, 4.0, (heartbeat(), "a"), (heartbeat(armed=True), "b"), from_s=4.0)
    assert presence.autopilot is not None
    assert presence.autopilot.route == "a" and presence.second_route == "b"
    assert not presence.autopilot.armed, "facts come over the pinned route"
    hear(presence, 4.0, (heartbeat(armed=True), "b"), from_s=8.0)
    assert presence.autopilot.route == "a"
    hear(presence, 2.0, (heartbeat(armed=True), "b"), from_s=12.0)
    assert presence.autopilot.route == "b" and presence.autopilot.armed and presence.second_route == ""


def test_any_message_of_the_autopilot_over_another_route_is_a_claim_that_fades() -> None:
    presence = Presence()
    hear(presence, 4.0, (heartbeat(), "a"))
    attitude = WIRE.carry(dialect.MAVLink_attitude_message(5000, 0, 0, 0, 0, 0, 0), 1, 1)
    presence.on_message(attitude, "b", 4 * S)
    hear(presence, 9.0, (heartbeat(), "a"), from_s=4.0)
    assert presence.second_route == "b"
    hear(presence, 2.0, (heartbeat(), "a"), from_s=13.0)
    assert presence.second_route == ""


def test_a_boot_clock_that_jumps_back_is_a_reboot_and_overtaking_packets_are_not() -> None:
    presence = Presence()
    hear(presence, 4.0, (heartbeat(), "a"))
    heard = [(t, 0) for t in (50_000, 50_300, 49_000, 51_000, 49_000, 900, 51_500, 1_100, 51_600)]
    for boot_ms, boots in (*heard, (900, 0), (1_000, 0), (1_100, 1), (2_000, 1)):
        message = WIRE.carry(dialect.MAVLink_system_time_message(0, boot_ms), 1, 1)
        presence.on_message(message, "a", 4 * S)
        assert presence.boots == boots, boot_ms


def test_ping_is_answered_to_its_sender_with_the_same_seq_and_time() -> None:
    presence = Presence()
    hear(presence, 4.0, (heartbeat(7), "a"))
    for target in ((0, 0), (7, 191)):
        ping = WIRE.carry(dialect.MAVLink_ping_message(123456, 42, *target), 255, 190)
        (reply,) = presence.on_message(ping, "gcs", 4 * S)
        m = reply.message
        assert (m.time_usec, m.seq, m.target_system, m.target_component) == (123456, 42, 255, 190)
        assert reply.route == "gcs"
    foreign = WIRE.carry(dialect.MAVLink_ping_message(1, 1, 7, 1), 255, 190)
    assert presence.on_message(foreign, "gcs", 4 * S) == []


def test_two_polite_components_do_not_ping_for_ever() -> None:
    one, two = Presence(191), Presence(192)
    for presence in (one, two):
        hear(presence, 4.0, (heartbeat(7), "a"))
    ping = WIRE.carry(dialect.MAVLink_ping_message(1, 1, 0, 0), 7, 191)
    exchanged = 0
    out, sender, receiver = two.on_message(ping, "a", 5 * S), (7, 192), one
    while out and exchanged < 100:
        exchanged += 1
        message = WIRE.carry(out[0].message, *sender)
        out = receiver.on_message(message, "a", 5 * S)
        sender, receiver = ((7, 191), two) if receiver is one else ((7, 192), one)
    assert exchanged <= 6


def test_commands_to_us_are_unsupported_and_others_are_left_alone() -> None:
    presence = Presence()
    hear(presence, 4.0, (heartbeat(7), "a"))

    def long(*target: int) -> Any:
        return WIRE.carry(dialect.MAVLink_command_long_message(*target, 512, 0, 148, *(0,) * 6), 255, 190)

    (reply,) = presence.on_message(long(7, 191), "gcs", 4 * S)
    ack = reply.message
    assert (ack.command, ack.result, ack.target_system, ack.target_component) == (512, 3, 255, 190)
    exact = WIRE.carry(dialect.MAVLink_command_int_message(7, 191, 0, 400, 0, 0, *(0,) * 7), 255, 190)
    assert presence.on_message(exact, "gcs", 4 * S)[0].message.command == 400
    for target in ((0, 0), (7, 0), (7, 1), (8, 191)):
        assert presence.on_message(long(*target), "gcs", 4 * S) == [], target


def test_file_requests_are_refused_the_way_mavlink_ftp_does() -> None:
    presence = Presence()
    hear(presence, 4.0, (heartbeat(7), "a"))
    asked = (65535).to_bytes(2, "little") + bytes((5, 4, 3, 0, 0, 0)) + (9).to_bytes(4, "little") + b"abc"

    def ftp(payload: bytes, *target: int) -> Any:
        message = dialect.MAVLink_file_transfer_protocol_message(0, *target, list(payload.ljust(251, b"\0")))
        return WIRE.carry(message, 255, 190)

    assert presence.on_message(ftp(asked, 7, 191), "gcs", 4 * S) == [], "it waits for room in the budget"
    (reply,) = hear(presence, 1.0, from_s=4.0)[1:]  # after the heartbeat
    assert reply.route == "gcs"
    nak = bytes(WIRE.carry(reply.message, 7, 191).payload)
    assert nak[:6] == bytes((0, 0, 5, 129, 1, 4)) and nak[12] == 10  # seq wraps; NAK of opcode 4: no such file
    answer = asked[:3] + bytes((128,)) + asked[4:]
    for silent in (ftp(asked, 7, 1), ftp(answer, 7, 191)):
        presence.on_message(silent, "gcs", 5 * S)
    assert {o.message.get_type() for o in hear(presence, 2.0, from_s=5.0)} == {"HEARTBEAT"}, "no answer is answered"


KINDS = sorted(dialect.mavlink_map.values(), key=lambda kind: kind.id)


@given(st.sampled_from(KINDS), st.binary(min_size=255, max_size=255), st.integers(0, 255), st.integers(0, 255))
@settings(max_examples=150, deadline=None)
def test_no_message_makes_it_raise(kind: Any, payload: bytes, system: int, component: int) -> None:
    presence = Presence()
    hear(presence, 4.0, (heartbeat(7), "a"))
    mav = dialect.MAVLink(None)
    body = payload[: kind.unpacker.size]
    header = bytes((0xFD, len(body), 0, 0, 0, system, component)) + kind.id.to_bytes(3, "little")
    crc = dialect.x25crc(header[1:] + body)
    crc.accumulate(bytes((kind.crc_extra,)))
    message = mav.decode(bytearray(header + body + crc.crc.to_bytes(2, "little")))
    for reply in presence.on_message(message, "x", 5 * S):
        WIRE.carry(reply.message, 7, 191)


def test_wrong_calls_name_the_culprit() -> None:
    with pytest.raises(ValueError, match="component"):
        Presence(0)
    with pytest.raises(ValueError, match="target_system"):
        Presence(target_system=256)
