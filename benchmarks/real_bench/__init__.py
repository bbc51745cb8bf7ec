"""The judge of the estimators on real recordings.

    tapes      a recording through magmav's own pipeline once: the Samples of each compass, and what judges them
    running    an estimator through Channel and cause finder over a tape, as the service would; every belief kept
    held_out   heading error of a calibration frozen S seconds after take-off, as `magmav replay --learn-for S` has it
    ready      when READY was said first, and whether that was right
    optical    hand-moved recordings with an optical attitude: room field, offsets, when a magnet came and went
    magnets    how soon the heading is right again after that
    tables     Markdown

Recordings are looked for in MAGMAV_DATA (default ../shared/data). Nothing is cached on disk.
"""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy comes: the matrices are small
