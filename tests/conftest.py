"""How hypothesis looks: the same examples every time, so that a red run is red again; new ones in `make soak`."""

from hypothesis import settings

settings.register_profile("repeatable", derandomize=True)
settings.register_profile("searching", derandomize=False, print_blob=True)
settings.load_profile("repeatable")
