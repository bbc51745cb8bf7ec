"""How hypothesis looks: the same examples every time, so that a red run is red again; new ones in `make soak`."""

import gc

from hypothesis import settings

gc.set_threshold(100_000, 20, 100)  # flights make millions of small objects that live: looking at them again is in vain

settings.register_profile("repeatable", derandomize=True)
settings.register_profile("searching", derandomize=False, print_blob=True)
settings.load_profile("repeatable")
