"""Runs imufusion, vqf and ahrs on one flight, each with several calibrations of its compass. Not part of magmav.

    python attitude_filters.py FLIGHT.npz        prints one JSON object

They estimate no hard iron: what is asked is what their heading is worth with and without one. Axes are turned to
forward-left-up, where all three agree on the signs.
"""

import contextlib
import json
import math
import sys

import numpy as np

FLU = np.array((1.0, -1.0, -1.0))


def headings_imufusion(t_s, gyro, force, mag):
    import imufusion

    ahrs = imufusion.Ahrs()
    ahrs.set_settings(imufusion.AhrsSettings(sample_rate=1.0 / float(np.median(np.diff(t_s)))))
    out = np.empty(len(t_s))
    periods = np.diff(t_s, prepend=2.0 * t_s[0] - t_s[1])
    for i, period in enumerate(periods):
        ahrs.set_sample_period(float(period))
        ahrs.update(np.degrees(gyro[i]), force[i] / 9.80665, mag[i])
        w, x, y, z = ahrs.get_quaternion()
        out[i] = -math.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    return out


def headings_vqf(t_s, gyro, force, mag):
    import vqf

    step = float(np.median(np.diff(t_s)))
    got = vqf.VQF(step).updateBatch(*(np.ascontiguousarray(v) for v in (gyro, force, mag)))
    w, x, y, z = got["quat9D"].T
    # Earth axes are east, north, up: the nose's direction, clockwise from north.
    return np.arctan2(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z))


def headings_ahrs(t_s, gyro, force, mag):
    from ahrs.filters import Madgwick

    filter_ = Madgwick(frequency=1.0 / float(np.median(np.diff(t_s))))
    q = np.array((1.0, 0.0, 0.0, 0.0))
    out = np.empty(len(t_s))
    before = t_s[0] - filter_.Dt
    for i, t in enumerate(t_s):
        # It drifts into place by a small gain: the first values are given fifty times.
        for _ in range(50 if i == 0 else 1):
            q = filter_.updateMARG(q, gyr=gyro[i], acc=force[i], mag=mag[i], dt=float(t - before))
        before = t
        w, x, y, z = q
        out[i] = -math.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    return out


FILTERS = {"imufusion": headings_imufusion, "vqf": headings_vqf, "ahrs Madgwick": headings_ahrs}


def main():
    with contextlib.redirect_stdout(sys.stderr):
        flight = dict(np.load(sys.argv[1]))
        t_s, truth = flight["imu_t_s"], flight["imu_heading_rad"]
        gyro, force = flight["imu_rate_rads"] * FLU, flight["imu_force_mss"] * FLU
        scored = flight["imu_scored"]
        out = {}
        for label, offset in zip(flight["labels"].tolist(), flight["hard_irons_mg"], strict=True):
            mag = (flight["imu_mag_mg"] - offset) * FLU
            for name, headings in FILTERS.items():
                try:
                    off = np.remainder(headings(t_s, gyro, force, mag) - truth + np.pi, 2.0 * np.pi) - np.pi
                    value = math.degrees(float(np.sqrt(np.mean(off[scored] ** 2))))
                except Exception as error:  # whatever somebody else's code does is a result
                    value = f"{type(error).__name__}: {error}"[:120]
                out.setdefault(name, {})[label] = value
    print(json.dumps(out))


if __name__ == "__main__":
    main()
