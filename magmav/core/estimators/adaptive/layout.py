"""The state of one hypothesis: what stands where, with its unit.

alpha   rad     azimuth of magnetic north in the own frame, a frame level with the earth that the gyro carries along
b       mG      hard iron, the sensor's axes
h, v    mG      the Earth's field here, horizontal and downward
e       rad     error of the tilt, a small rotation in body axes, Gauss-Markov
d       mG      short-lived disturbance of the reading, body axes, Gauss-Markov
k       mG      what full throttle adds, body axes
s       -       soft iron, symmetric: xx, yy, zz, xy, xz, yz of S, where the sensor sees (I + S) field
g       rad/s   gyro bias, body axes
t       s       delay of the compass beyond what is known
kappa   -       share of the tilt by which the reported tilt is wrong
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[Any]

ALPHA = 0
B = slice(1, 4)
H, V = 4, 5
E = slice(6, 9)
D = slice(9, 12)
K = slice(12, 15)
S = slice(15, 21)
G = slice(21, 24)
T = 24
KAPPA = 25
SIZE = 26
