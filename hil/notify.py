"""What systemd is told (`sd_notify(3)`): ready, alive, stopping. Elsewhere nothing is sent."""

import os
import socket
from time import monotonic


def notify(state: str) -> None:
    """Send one line, for example `READY=1`. Without a listener, or if it is gone, do nothing."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.setblocking(False)  # a stuck service manager may not hold up the supervisor
        try:
            sender.sendto(state.encode(), address.replace("@", "\0", 1))
        except OSError:
            return


class Watchdog:
    """Says that the service is alive, twice as often as the unit's `WatchdogSec` demands."""

    def __init__(self) -> None:
        is_ours = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        usec = os.environ.get("WATCHDOG_USEC", "")
        self.period_s = int(usec) / 2e6 if is_ours and usec.isdigit() else 0.0
        self._due_s = 0.0

    def beat(self) -> None:
        """Call it often; it sends only when it is time to."""
        if self.period_s and monotonic() >= self._due_s:
            self._due_s = monotonic() + self.period_s
            notify("WATCHDOG=1")
