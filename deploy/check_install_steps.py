"""What `check_install.py` does in the fresh root, step by step: the page's blocks, and checks."""

import json
import re
import time
from collections.abc import Callable
from pathlib import Path

from check_install_root import SOURCE, FreshRoot, InstallError

PAGE = SOURCE / "docs" / "install.md"
CONTAINERFILE = SOURCE / "deploy" / "container" / "Containerfile"
BLOCK = re.compile(r"^```sh (\w+)\n(.*?)^```", re.M | re.S)
POLL_S = 0.2
RESTART_TIMEOUT_S = 40.0
TRIES = 5
"""To get the arm moving without real time: a host that stalls for 20 ms trips the drives."""
NOT_IN_A_CONTAINER = {"udevadm": "no udev runs in a container"}
"""Commands of the page that are left out, each with the reason."""
DAEMON = "hil@bench"
EMULATOR = "hil-emulator@bench"
RUNS = "/var/lib/hil/runs"
SLOW_MOTION = json.dumps({
    "kind": "sinusoid", "duration_s": 30.0, "center_rad": [0.0, 0.0],
    "amplitude_rad": [0.2, 0.2], "frequency_Hz": [0.5, 0.5],
})  # fmt: skip
"""A motion that lasts until somebody ends it."""


Steps = dict[str, tuple[Callable[[], str], bool]]
"""Name -> what is done, and whether the rest needs it; it returns a note."""


class NotHereError(Exception):
    """What a step is about cannot be had in such a container; one line says why."""


# --- what the page and the files say -------------------------------------------------------------


def blocks(text: str) -> dict[str, list[str]]:
    """Return the commands of every named block of a page, in its order."""
    return {name: body.splitlines() for name, body in BLOCK.findall(text)}


def image_steps(text: str) -> tuple[str, str]:
    """Return what a Containerfile runs while it is built, and the command it starts then."""
    joined = text.replace("\\\n", " ")
    ran = re.findall(r"^RUN (.*)$", joined, re.M)
    entry = re.findall(r'^ENTRYPOINT \["(.*)"\]$', joined, re.M)
    return "\n".join(ran), entry[-1]


# --- steps ----------------------------------------------------------------------------------------


class Installation:
    """The page's installation, carried out in a fresh root; every step returns a note."""

    def __init__(self, root: FreshRoot) -> None:
        self._root = root
        self._blocks = blocks(PAGE.read_text("utf-8"))
        self._excuse = ""

    def build(self) -> str:
        """Make the root."""
        self._root.build()
        return f"Debian {(self._root.path / 'etc/debian_version').read_text('ascii').strip()}"

    def packages(self) -> str:
        """Block "packages"."""
        return self._fill("packages")

    def image(self) -> str:
        """Run what the Containerfile runs, and the demo as its user."""
        run, entry = image_steps(CONTAINERFILE.read_text("utf-8"))
        place = "ln -s /usr/bin/python3 /usr/local/bin/python; mkdir /opt/hil; cp -r . /opt/hil/src"
        demo = f"runuser -u hil -- sh -ec 'cd /var/lib/hil; {entry} demo'"
        self._root.enter(f"{place}\n{run}\n{demo}", is_in_copy=True)
        return "RUN and `demo` on Debian's Python; no image was built, FROM not used"

    def program(self) -> str:
        """Block "program"."""
        return self._fill("program")

    def boot(self) -> str:
        """Start systemd."""
        said = self._root.boot()
        version = self._root.inside("systemctl --version").split("\n")[0]
        return f"{version}, {said}"

    def service(self) -> str:
        """Block "service"."""
        return self._follow("service")

    def start(self) -> str:
        """Block "start": a motion."""
        return f"{self._follow('start')}{self._excuse}"

    def status(self) -> str:
        """Both units are up, without rights."""
        self._root.inside(f"systemctl is-active {DAEMON} {EMULATOR}")
        pid = self._main_pid()
        user = self._root.inside(f"ps -o user= -p {pid}").strip()
        _demand(user == "hil", f"it runs as {user}")
        found = self._root.inside(f"cat /proc/{pid}/status")
        _demand(re.search(r"^CapEff:\s*0+$", found, re.M) is not None, "it has capabilities")
        return "active, user hil, no capabilities"

    def real_time(self) -> str:
        """The loop runs in real time if the units' limits were granted."""
        scheduler = "".join(self._watched().partition("SCHED_")[1:])
        limit = self._real_time_limit()
        if limit == "0":
            raise NotHereError(f"the host does not let LimitRTPRIO= be raised; {scheduler}")
        _demand("FIFO" in scheduler, f"priority {limit} is allowed, the loop runs in {scheduler}")
        return f"{scheduler}, up to priority {limit} allowed"

    def sandbox(self) -> str:
        """What the page says of the daemon's files is so."""
        enter = f"nsenter --target={self._main_pid()} --mount"
        for place in ("/usr", "/etc/hil", "/opt/hil"):
            self._root.inside(f"! {enter} touch {place}/probe 2>/dev/null")
        seen = self._root.inside(f"{enter} ls -A /root /home 2>/dev/null || true").split()
        _demand(not set(seen) - {"/root:", "/home:"}, f"it sees {' '.join(seen)}")
        self._root.inside(f"mknod /root/kmsg c 1 11; {self._join(EMULATOR)}; ! head -c1 /root/kmsg")
        call = 'import socket; socket.create_connection(("127.0.0.1", 7447), 2)'
        self._root.inside(f"python3 -c '{call}'")
        self._root.inside(f"{self._join(EMULATOR)}; ! python3 -c '{call}' 2>/dev/null")
        return "system read-only, no home directories; emulator: no devices, no IP network"

    def stop(self) -> str:
        """`systemctl stop` ends it in order, and the recording holds the motion."""
        self._root.inside(f"systemctl stop {DAEMON}")
        result = self._shown("Result")
        _demand(result == "success", f"it ended with {result}")
        file = self._root.inside(f"ls -t {RUNS}/*.mcap | head -1").strip()
        self._root.inside(f"hil replay {file}", 300.0)
        self._root.inside(f"systemctl start {DAEMON}")
        self._demand_off()
        return f"{Path(file).name} replays bit for bit"

    def kill_loop(self) -> str:
        """A loop that is killed under torque is back by systemd, with torque off."""
        self._move()
        self._kill_loop()
        self._await_restart(1)
        return f"restarted by systemd, {self._demand_off()}"

    def give_up(self) -> str:
        """After three failures in a minute it stays down."""
        self._root.inside(f"systemctl reset-failed {DAEMON}; systemctl restart {DAEMON}")
        for restarts in (1, 2):
            self._kill_loop()
            self._await_restart(restarts)
        self._kill_loop()
        self._await(lambda: self._shown("ActiveState") == "failed", "the unit to be failed")
        self._root.inside(f"systemctl reset-failed {DAEMON} && systemctl start {DAEMON}")
        return f"stays down after the third; started by hand: {self._demand_off()}"

    def restart(self) -> str:
        """`systemctl restart` in mid-motion does not enable the arm."""
        self._move()
        self._root.inside(f"systemctl restart {DAEMON}")
        return self._demand_off()

    def watchdog(self) -> str:
        """A supervisor that is stuck under torque is ended by systemd's watchdog."""
        self._move()
        began_s = time.monotonic()
        self._root.inside(f"kill -STOP {self._main_pid()}")
        self._await_restart(1)
        took_s = time.monotonic() - began_s
        return f"back after {took_s:.0f} s, {self._demand_off()}"

    def reboot(self) -> str:
        """After a reboot under torque both units come up by themselves, and torque is off."""
        self._move()
        self._root.shut_down()
        self._root.boot()
        self._root.inside(f"systemctl is-active {DAEMON} {EMULATOR}")
        starts = self._shown("NRestarts")
        _demand(starts == "0", f"{DAEMON} needed {starts} more starts")
        return f"both units active at the first try, {self._demand_off()}"

    def network(self) -> str:
        """Block "network", as far as a kernel without adapters shows it."""
        left_out = self._follow("network")
        self._root.inside("systemctl is-active systemd-networkd")
        said = self._root.inside("journalctl --boot --unit=systemd-networkd --output=cat")
        complaints = [line for line in said.splitlines() if "/80-" in line]
        _demand(not complaints, "; ".join(complaints))
        return f"{left_out}; no CAN interface here"

    def isolation(self) -> str:
        """Block "isolation"."""
        self._follow("isolation")
        self._root.inside(f"systemctl restart {DAEMON}")
        self._demand_off()
        group = self._shown("ControlGroup")
        _demand(group.startswith("/hil.slice/"), f"it runs in {group}")
        cores = self._root.inside("systemctl show --property=EffectiveCPUs --value system.slice")
        if not cores.strip():
            raise NotHereError(
                f"{DAEMON} runs in hil.slice; no cpuset controller, no core kept free"
            )
        return f"{DAEMON} in hil.slice, others on {cores.strip()}"

    def keys(self) -> str:
        """Block "keys": who has a certificate can command over TLS, who has none cannot."""
        self._follow("keys")
        file = self._root.path / "etc/hil/bench.toml"
        secured = 'listen = ["tls/0.0.0.0:7447"]\nfile = "/etc/hil/zenoh/daemon/zenoh.json5"'
        text = re.sub(r'^listen = .*"tcp/.*$', secured, file.read_text("utf-8"), flags=re.M)
        _demand(secured in text, "bench.toml has no line to listen on TCP")
        file.write_text(text, "utf-8")
        self._root.inside(f"systemctl restart {DAEMON}")
        for verb in ("enable", "disable"):
            self._root.inside(f"hil send {verb} --connect /root/hil-keys/operator/zenoh.json5")
        self._root.inside("! hil send enable --connect tls/127.0.0.1:7447 2>/dev/null")
        return "operator commands over TLS, a client without a certificate is refused"

    def router(self) -> str:
        """The router's unit needs a program that Debian does not have."""
        raise NotHereError("zenohd is no Debian package; the unit is only verified offline")

    # --- parts of steps --------------------------------------------------------------------------

    def _fill(self, name: str) -> str:
        """Run a block in the root that is not booted."""
        self._root.enter("\n".join(self._blocks[name]))
        return f"{len(self._blocks[name])} commands"

    def _follow(self, name: str) -> str:
        """Run a block's commands one by one in the booted root."""
        left_out = []
        for line in self._blocks[name]:
            reason = NOT_IN_A_CONTAINER.get(line.split()[0])
            if reason is None:
                self._send(line)
            else:
                left_out.append(f"`{line}` left out: {reason}")
        count = len(self._blocks[name]) - len(left_out)
        return "; ".join([f"{count} commands", *left_out])

    def _shown(self, name: str) -> str:
        return self._root.inside(f"systemctl show --property={name} --value {DAEMON}").strip()

    def _real_time_limit(self) -> str:
        """Return the highest priority the daemon may take; 0 is none."""
        limits = self._root.inside(f"cat /proc/{self._main_pid()}/limits")
        return str(re.findall(r"^Max realtime priority +(\S+)", limits, re.M)[0])

    @staticmethod
    def _join(unit: str) -> str:
        """Return a command by which a shell becomes part of a service's control group."""
        group = f"/sys/fs/cgroup$(systemctl show --property=ControlGroup --value {unit})"
        return f'echo $$ > "{group}/cgroup.procs"'

    def _main_pid(self) -> int:
        return int(self._shown("MainPID"))

    def _watched(self) -> str:
        """Return a line of the daemon's status, as `hil watch` prints it."""
        lines = self._root.inside("hil watch --for 1").splitlines()
        found = [line for line in lines if re.match(r"[A-Z]+ +cycle", line)]
        _demand(bool(found), "the daemon says no status")
        return found[-1]

    def _send(self, line: str) -> None:
        """Run a command. Without real time, a host that is busy may have tripped the arm before.

        Then the arm is reset and enabled, and the command is tried once more.
        """
        try:
            self._root.inside(line)
        except InstallError:
            is_excused = line.startswith("hil send trajectory") and self._real_time_limit() == "0"
            if not is_excused or not self._watched().startswith("FAULT"):
                raise
            self._excuse = "; no real time here: FAULT, reset, repeated"
            self._root.inside(f"hil send reset && hil send enable && {line}")

    def _demand_off(self) -> str:
        """Return the arm's state, which is one without torque.

        FAULT is one: a drive that missed its commands has said so, and waits for a reset.
        """
        state = self._watched().split()[0]
        _demand(state in ("IDLE", "FAULT"), f"the arm is in {state}")
        return state

    def _move(self) -> None:
        """Leave the arm in motion, under torque."""
        for _ in range(TRIES):
            # an arm whose torque went off in motion has coasted, maybe beyond its limits
            self._root.inside(f"systemctl stop {DAEMON}; systemctl reset-failed {DAEMON} || true")
            self._root.inside(f"systemctl restart {EMULATOR}; systemctl start {DAEMON}")
            self._root.inside("hil send enable")
            self._send(f"hil send trajectory --json '{SLOW_MOTION}'")
            state = self._watched().split()[0]
            if state == "ACTIVE" or self._real_time_limit() != "0":
                break
        _demand(state == "ACTIVE", f"after `enable` and a trajectory the arm is in {state}")

    def _kill_loop(self) -> None:
        self._root.inside("pkill -KILL -f '[h]il.process loop'")

    def _await_restart(self, count: int) -> None:
        def is_back() -> bool:
            return self._shown("NRestarts") == str(count) and self._shown("SubState") == "running"

        self._await(is_back, f"systemd's restart {count}")

    def _await(self, condition: Callable[[], bool], what: str) -> None:
        deadline_s = time.monotonic() + RESTART_TIMEOUT_S
        while not condition():
            _demand(time.monotonic() < deadline_s, f"{what} does not come")
            time.sleep(POLL_S)


def _demand(condition: bool, otherwise: str) -> None:
    if not condition:
        raise InstallError(otherwise)


def steps(at: Installation) -> Steps:
    """Return what is done, in this order."""
    return {
        "fresh root": (at.build, True),
        "block packages": (at.packages, True),
        "Containerfile": (at.image, False),
        "block program": (at.program, True),
        "boot": (at.boot, True),
        "block service": (at.service, True),
        "block start": (at.start, True),
        "systemctl status": (at.status, False),
        "real time": (at.real_time, False),
        "sandbox": (at.sandbox, False),
        "stop, recording": (at.stop, False),
        "loop killed": (at.kill_loop, False),
        "three failures": (at.give_up, False),
        "restart in motion": (at.restart, False),
        "watchdog": (at.watchdog, False),
        "reboot": (at.reboot, True),
        "block network": (at.network, False),
        "block isolation": (at.isolation, False),
        "block keys": (at.keys, False),
        "hil-router": (at.router, False),
    }
