"""How hypothesis looks: the same examples every time, so that a red run is red again; new ones in `make soak`."""

import gc

from hypothesis import settings

gc.set_threshold(100_000, 20, 100)  # flights make millions of small objects that live: looking at them again is in vain

# No deadline: how long an example takes on a busy machine says nothing of the code.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.register_profile("searching", derandomize=False, print_blob=True, deadline=None)
settings.load_profile("repeatable")
