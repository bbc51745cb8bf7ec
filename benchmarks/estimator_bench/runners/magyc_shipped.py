"""Runs magyc as it is shipped, errors and all, on one flight. Not part of magmav.

    python magyc_shipped.py FLIGHT.npz       prints one JSON object

Called by the Python of the environment magyc lives in. Fields go in in gauss, as its defaults expect.
"""

import contextlib
import json
import sys
import warnings

import numpy as np

METHODS = ("sar_ls", "sar_kf", "sar_aid", "twostep_hi", "magyc_ls", "magyc_nls")


def answer(magyc, name, mag, rate, t_s, reference):
    """Hard iron, and soft iron where there is one; in mG. ``matrix`` is what corrects."""
    method = getattr(magyc, name)
    got = method(mag, reference) if name == "twostep_hi" else method(mag, rate, t_s)
    hard = 1e3 * np.asarray(got[0], dtype=float).reshape(3)
    matrix = np.eye(3)
    if name.startswith("magyc"):
        soft = np.asarray(got[1], dtype=float).reshape(3, 3)
        matrix = np.linalg.inv(soft / np.cbrt(np.linalg.det(soft)))
    if not (np.isfinite(hard).all() and np.isfinite(matrix).all()):
        raise ValueError("not finite")
    return {"hard_iron_mg": hard.tolist(), "matrix": matrix.tolist()}


def main():
    warnings.simplefilter("ignore")
    with contextlib.redirect_stdout(sys.stderr):
        import magyc

        flight = dict(np.load(sys.argv[1]))
        out = {}
        for name in METHODS:
            for t in flight["checkpoints_s"]:
                rows = flight["t_s"] <= t
                try:
                    if rows.sum() < 20:
                        raise ValueError("too little data")
                    got = answer(magyc, name, flight["mag_mg"][rows] / 1e3, flight["rate_rads"][rows],
                                 flight["t_s"][rows], flight["model_n_mg"] / 1e3)  # fmt: skip
                except Exception as error:  # whatever somebody else's code does is a result
                    got = {"error": f"{type(error).__name__}: {error}"[:120]}
                out.setdefault(f"{name} (shipped)", []).append(got)
    print(json.dumps(out))


if __name__ == "__main__":
    main()
