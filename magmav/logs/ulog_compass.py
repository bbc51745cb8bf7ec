"""Which compasses a ULog holds, and through which topic each is best heard.

    sensor_mag            the sensor's own field and axes (PX4 1.11 and later; before, the driver had corrected it)
    vehicle_magnetometer  corrected, body axes, an average stamped with its mean time
    sensor_combined       the same in logs up to 1.8, repeated until there is a new one

Newer releases take an estimate of their own off vehicle_magnetometer (magnetometer_bias_estimate, autopilots.md 4.1),
and when it is dropped again no log says: such values are called LESS_BIAS, and only changes can be learnt from them.

A compass is a device id, not an instance: PX4 may switch sensors within one topic. Old logs do not say the device;
it is the one CAL_MAG_PRIME names, as in the PX4 of their time. Compass 1 is that one, else the one with the
highest CAL_MAGn_PRIO (external ones 75, internal ones 50 where it is not set), then by instance (autopilots.md 4.2).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.logs.ulog_file import Topic

MOST = 3
LESS_BIAS = "vehicle_magnetometer less bias"
_INVALID_US = 2**31 - 1  # magnetometer_timestamp_relative where there was none
_SLOTS = range(4)
_DISABLED, _INTERNAL, _EXTERNAL = 0.0, 50.0, 75.0
_FEW = 0.01  # a device id in fewer of a topic's rows is damage
_WORTH = {"sensor_mag": 10, LESS_BIAS: 1}  # what one value is worth; 5 for the others


class Compass(NamedTuple):
    """One compass's values: t_us (n,) int64 boot time of measurement, field_mg (n, 3) in the topic's own axes."""

    device_id: int  # 0 where neither the topic nor the parameters say
    source: str
    instance: int
    t_us: NDArray[np.int64]
    field_mg: NDArray[np.float64]


def compasses(
    topics: Mapping[str, list[Topic]], parameters: Mapping[str, float], counts: Counter[str]
) -> dict[int, Compass]:
    """Compass number to its values; at most three, what was left out is counted."""
    best: dict[int, Compass] = {}
    for found in _all(topics, parameters, counts):
        rival = best.get(found.device_id)
        if rival is None or _weight(found) > _weight(rival):
            best[found.device_id] = found
    nameless = best.pop(0, None) if len(best) > 1 else None  # the same sensor as one of the others
    if nameless is not None:
        counts[f"{nameless.source}: device not known"] += len(nameless.t_us)
    chosen = sorted(best.values(), key=lambda c: (-_priority(c.device_id, parameters), c.instance, c.device_id))
    for extra in chosen[MOST:]:
        counts["compass beyond the third"] += len(extra.t_us)
    return dict(enumerate(chosen[:MOST], 1))


def _weight(c: Compass) -> int:
    return len(c.t_us) * _WORTH.get(c.source, 5)


def _slot(device_id: int, parameters: Mapping[str, float]) -> int | None:
    return next((n for n in _SLOTS if device_id and parameters.get(f"CAL_MAG{n}_ID") == device_id), None)


def _priority(device_id: int, parameters: Mapping[str, float]) -> float:
    n = _slot(device_id, parameters)
    if device_id and parameters.get("CAL_MAG_PRIME") == device_id:
        return np.inf
    if n is None:
        return _INTERNAL
    if parameters.get(f"CAL_MAG{n}_EN") == 0:
        return _DISABLED
    own = parameters.get(f"CAL_MAG{n}_PRIO", -1.0)
    if 0 <= own <= 100:
        return own
    return _INTERNAL if parameters.get(f"CAL_MAG{n}_ROT", -1.0) < 0 else _EXTERNAL


def _prime(parameters: Mapping[str, float]) -> int:
    """The device an old log speaks of: the primary one, or the only one calibrated."""
    ids = {int(parameters.get(f"CAL_MAG{n}_ID", 0)) for n in _SLOTS if parameters.get(f"CAL_MAG{n}_EN", 1) != 0} - {0}
    prime = int(parameters.get("CAL_MAG_PRIME", 0))
    return prime or (ids.pop() if len(ids) == 1 else 0)


def _all(topics: Mapping[str, list[Topic]], parameters: Mapping[str, float], counts: Counter[str]) -> Iterator[Compass]:
    for topic in topics.get("sensor_mag", []):
        if "x_raw" in topic or "scaling" in topic:
            counts["sensor_mag: corrected in the driver, not used"] += len(topic)
        elif all(a in topic for a in "xyz"):
            gauss = np.column_stack([topic.column(a).astype(np.float64) for a in "xyz"])
            yield from _by_device(topic, topic.name, gauss, 0, counts)
    source = LESS_BIAS if any(map(_biased, topics.get("magnetometer_bias_estimate", []))) else "vehicle_magnetometer"
    for topic in topics.get("vehicle_magnetometer", []):
        vectors = topic.vectors("magnetometer_ga")
        if vectors is not None:
            yield from _by_device(topic, source, vectors, _prime(parameters) if topic.instance == 0 else 0, counts)
    for topic in topics.get("sensor_combined", []):
        vectors = topic.vectors("magnetometer_ga")
        if vectors is not None:
            yield _combined(topic, vectors, _prime(parameters))


def _biased(topic: Topic) -> bool:
    columns = [topic.column(f"bias_{a}[{i}]") for a in "xyz" for i in _SLOTS if f"bias_{a}[{i}]" in topic]
    return any(np.any(c != 0) for c in columns)


def _by_device(
    topic: Topic, source: str, gauss: NDArray[np.float64], otherwise: int, counts: Counter[str]
) -> Iterator[Compass]:
    """The rows of each device in a topic; of device ``otherwise`` where the topic does not say."""
    devices = topic.first("device_id")
    if devices is None:
        devices = np.full(len(topic), otherwise)
    for device in np.unique(devices):
        rows = devices == device
        if rows.sum() < max(2, _FEW * len(topic)):
            counts[f"{topic.name}: device id seen once or twice"] += int(rows.sum())
            continue
        yield Compass(int(device), source, topic.instance, topic.t_us[rows], 1000.0 * gauss[rows])


def _combined(topic: Topic, gauss: NDArray[np.float64], device: int) -> Compass:
    """Each value once, at its own time: t_us plus magnetometer_timestamp_relative."""
    relative = topic.first("magnetometer_timestamp_relative")
    late = np.zeros(len(topic), dtype=np.int64) if relative is None else relative.astype(np.int64)
    t_us, field = topic.t_us + late, 1000.0 * gauss
    good = (late != _INVALID_US) & (np.abs(late) < 1_000_000)
    t_us, field = t_us[good], field[good]
    # Times of one value differ by a microsecond from row to row, two values by milliseconds.
    fresh = np.diff(t_us, prepend=t_us[:1] - 1000) > 500
    return Compass(device, topic.name, topic.instance, t_us[fresh], field[fresh])
