"""The judge of the estimators: flights whose truth is known, what an autopilot would send of them, and scores.

    motions    closed-form manoeuvres: attitude, path, throttle
    flights    a motion as truth arrays: rotation matrices, rates, accelerations, the world's field
    scenarios  the table: which motion, which errors
    jsbsim_flights  the same from the simulator's airframes
    telemetry  what the autopilot would send: readings with all the errors
    running    readings through magmav's own pipeline; every estimator through a Channel, sample by sample
    score      heading error, honesty, time to one degree, verdicts
    bound      posterior Cramer-Rao bound along the true trajectory
    tables     Markdown and JSON

Truth and telemetry use nothing of magmav.core but its records, so that a shared mistake cannot cancel.

Seeds: 0 to 999 are for tuning. 1000 and up are for judging and never looked at while tuning.
"""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy comes: the work is shared out by flights, its matrices are small
