"""A serial device: a telemetry radio, an autopilot on USB."""

from __future__ import annotations

import errno
import os
import termios
import time
from contextlib import suppress

import serial as pyserial

from magmav.link import LinkError
from magmav.link.stream import Port, StreamLink

_LAST_WORDS_MS = 250


class SerialPort:
    """An open device. pyserial sets it up; bytes are moved by the operating system's own calls, because
    pyserial's write spins for ever on a full buffer that it was asked not to wait for.
    """

    def __init__(self, device: str, baud: int) -> None:
        try:
            # exclusive: two readers on one device get half the bytes each, and no error.
            self._serial = pyserial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        except (termios.error, ValueError, OverflowError) as error:
            raise OSError(errno.ENOTTY, str(error.args[-1])) from error
        self.fd: int = self._serial.fileno()

    def opened(self) -> bool:
        return True

    def read(self) -> bytes:
        """What waits. Readable and yet empty means unplugged."""
        try:
            data = os.read(self.fd, 65_536)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError(errno.ENODEV, "device gone")
        return data

    def write(self, data: bytes, /) -> int:
        return os.write(self.fd, data)

    def close(self) -> None:
        """Close, once the last words are out or a quarter of a second has passed.

        Left to itself the kernel may wait half a minute for a radio that takes nothing any more.
        """
        self.fd = -1
        with suppress(OSError, termios.error):
            for _ in range(_LAST_WORDS_MS // 5):
                if self._serial.out_waiting == 0:
                    break
                time.sleep(0.005)
            self._serial.reset_output_buffer()
        with suppress(OSError):
            self._serial.close()


def serial(
    device: str,
    baud: int = 57_600,
    *,
    tick_s: float = 0.05,
    retry_s: float = 0.5,
    longest_retry_s: float = 10.0,
) -> StreamLink:
    """Open a device. LinkError when the first opening fails; a device unplugged later is opened again."""
    name = f"serial:{device}:{baud}"

    def again() -> Port:
        return SerialPort(device, baud)

    try:
        first = again()
    except OSError as error:
        raise LinkError(f"{name}: {_why_not(error, device, baud)}") from error
    return StreamLink(name, first, again, tick_s=tick_s, retry_s=retry_s, longest_retry_s=longest_retry_s)


def _why_not(error: OSError, device: str, baud: int) -> str:
    if error.errno == errno.ENOENT:
        return f"no device {device}; is it plugged in? (ls /dev/serial/by-id)"
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"no permission for {device}; add this user to its group (often dialout) and log in again"
    if error.errno in (errno.EAGAIN, errno.EBUSY):
        return f"{device} is in use by another program; stop that program"
    return f"cannot use {device} at {baud} baud: {error.strerror or error}; check device and baud rate"
