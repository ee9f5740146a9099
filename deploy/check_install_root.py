"""A fresh Debian in a scratch directory, first entered, then booted, for `check_install.py`.

Debian's packages come from where the host's own apt fetches them. The root is a container of
systemd-nspawn: while it is filled it has the host's network, once booted a network of its own with
nothing but loopback.
"""

import configparser
import os
import re
import shlex
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1]
IN_ROOT = "/root/hil"
"""Where the source tree lies in there: what a `git clone` would have made."""
HOST = "bench"
PACKAGES = {"mmdebstrap": "mmdebstrap", "systemd-nspawn": "systemd-container"}
PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
CGROUPS = (Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/systemd"), Path("/sys/fs/cgroup/unified"))
NSPAWN_CGROUPS = ("payload", "supervisor")
NOISE = re.compile("Attempted to remove disk file system")
"""nspawn's last words where /run of the host is no tmpfs."""
BOOT_TIMEOUT_S = 90.0
NICENESS = -10
"""Of all that is booted: the host's other work shall slow it down as little as may be."""
POLL_S = 0.1
RIGHTS = (
    "--capability=CAP_IPC_LOCK,CAP_BPF,CAP_SYS_NICE",
    "--system-call-filter=@memlock @resources bpf",
)
"""What systemd needs as on a machine of its own: locked memory, real time, and its filters of
devices and addresses, which are BPF programs."""


class InstallError(Exception):
    """A command failed; one line says which and why."""


class MissingError(Exception):
    """The check cannot be made on this host; one line says what is missing."""


def require_packages() -> None:
    """Install what is missing, as root with apt-get.

    Raises:
        MissingError: If this is not Debian, we are not root, or something cannot be installed.
    """
    if shutil.which("apt-get", path=PATH) is None:
        raise MissingError("it needs a host with Debian's apt-get")
    if os.geteuid():
        raise MissingError("it needs root, for namespaces and another root directory")
    missing = [name for tool, name in PACKAGES.items() if shutil.which(tool, path=PATH) is None]
    if not missing:
        return
    for step in (["update"], ["install", "-y", "--no-install-recommends", *missing]):
        command = ["apt-get", *step]
        done = _call(command, 600.0, os.environ | {"DEBIAN_FRONTEND": "noninteractive"})
        if done.returncode:
            raise MissingError(f"`{shlex.join(command)}` failed: {_last_line(done)}")


def debian_sources(release_name: str, folder: Path = Path("/etc/apt")) -> str:
    """Return those of the host's apt sources that are of this Debian release, as they are written.

    Raises:
        MissingError: If there are none.
    """
    suite = re.escape(release_name)
    files = [folder / "sources.list", *sorted((folder / "sources.list.d").glob("*"))]
    found: list[str] = []
    for file in files:
        text = file.read_text("utf-8") if file.is_file() else ""
        if file.suffix == ".sources":
            kept = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
            is_ours = re.compile(rf"^Suites:\s*{suite}(?=[\s-]|$)", re.M)
            found += [part + "\n\n" for part in kept.split("\n\n") if is_ours.search(part)]
        elif file.suffix == ".list":
            is_ours = re.compile(rf"^deb\s+(\[[^]]*\]\s+)?\S+\s+{suite}(?=[\s/-])", re.M)
            found += [line + "\n" for line in text.splitlines() if is_ours.match(line)]
    if not found:
        raise MissingError(f"no apt source of Debian {release_name} in {folder}")
    return "".join(found)


def release() -> str:
    """Return the code name of the host's Debian."""
    text = Path("/etc/os-release").read_text("utf-8")
    named = re.search(r"^VERSION_CODENAME=(\w+)$", text, re.M)
    if named is None or re.search(r"^ID=debian$", text, re.M) is None:
        raise MissingError("it needs a Debian host: its apt sources are used")
    return named[1]


def received_bytes() -> int:
    """Return what the host has received so far from elsewhere."""
    rows = Path("/proc/net/dev").read_text("ascii").splitlines()[2:]
    return sum(int(row.split(":")[1].split()[0]) for row in rows if row.split(":")[0] != "    lo")


class FreshRoot:
    """One Debian root below a scratch directory; `close` ends what runs in it and removes it."""

    def __init__(self, scratch: Path, *, is_kept: bool = False) -> None:
        self._scratch = scratch
        self._is_kept = is_kept
        self.path = scratch / "root"
        self._container: subprocess.Popen[bytes] | None = None
        self._leader = 0

    # --- filled --------------------------------------------------------------------------------

    def build(self) -> None:
        """Install Debian's base system (priorities required and important), and the source tree."""
        sources = self._scratch / "sources"
        sources.write_text(debian_sources(release()), "utf-8")
        command = ["mmdebstrap", "--quiet", "--variant=important", release(), str(self.path)]
        self._must([*command, str(sources)], 1200.0)
        self._name()
        target = self.path / IN_ROOT.lstrip("/")
        for name in source_files():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(SOURCE / name, target / name)

    def _name(self) -> None:
        """Name the machine, as Debian's installer does."""
        (self.path / "etc/hostname").write_text(f"{HOST}\n", "utf-8")
        hosts = f"127.0.0.1 localhost\n127.0.1.1 {HOST}\n"
        (self.path / "etc/hosts").write_text(hosts, "utf-8")

    def enter(self, script: str, timeout_s: float = 1200.0, *, is_in_copy: bool = False) -> str:
        """Run a shell script in the root that is not booted, with the host's network.

        Args:
            script: Run with `sh -e` in the source tree.
            timeout_s: When to give up.
            is_in_copy: In a copy of the root, which is thrown away afterwards.

        Returns:
            Its standard output.

        Raises:
            InstallError: If it fails or takes too long.
        """
        root = self._scratch / "copy" if is_in_copy else self.path
        if is_in_copy:
            self._must(["cp", "--archive", "--reflink=auto", str(self.path), str(root)], 600.0)
        command = [*self._nspawn(root), "--quiet", "--pipe", *RIGHTS, f"--chdir={IN_ROOT}"]
        command += [*self._registries(), "--setenv=DEBIAN_FRONTEND=noninteractive"]
        try:
            return self._must([*command, "sh", "-ec", script], timeout_s)
        finally:
            if is_in_copy:
                shutil.rmtree(root)

    def _nspawn(self, root: Path) -> list[str]:
        """Return the command up to what it shall run."""
        command = [
            "systemd-nspawn",
            f"--directory={root}",
            f"--machine=hil-install-{os.getpid()}",
        ]
        if not Path("/run/systemd/system").is_dir():  # nobody there to register with
            command += ["--register=no", "--keep-unit"]
        return command

    def _registries(self) -> list[str]:
        """Return options by which pip in there asks whom the host's pip asks."""
        done = _call(["python3", "-m", "pip", "config", "list"], 60.0, os.environ)
        found = dict(re.findall(r"^(?:global|:env:)\.([\w-]+)='(.*)'$", done.stdout, re.M))
        config = configparser.ConfigParser(interpolation=None)
        config["global"] = {"disable-pip-version-check": "1", "root-user-action": "ignore"}
        for key in ("index-url", "extra-index-url", "trusted-host", "proxy", "timeout"):
            if key in found and "file:" not in found[key]:
                config["global"][key] = found[key]
        options = ["--setenv=PIP_CONFIG_FILE=/run/pip.conf"]
        if Path(found.get("cert", "")).is_file():
            config["global"]["cert"] = "/run/certificates.pem"
            options += [f"--bind-ro={found['cert']}:/run/certificates.pem"]
        with (self._scratch / "pip.conf").open("w", encoding="utf-8") as file:
            config.write(file)
        return [*options, f"--bind-ro={self._scratch / 'pip.conf'}:/run/pip.conf"]

    # --- booted --------------------------------------------------------------------------------

    def boot(self) -> str:
        """Start systemd in there, in a network of its own, and wait until it has started all.

        Returns:
            What `systemctl is-system-running` says.

        Raises:
            InstallError: If it does not come up; the last line of its console is named.
        """
        console = self._scratch / "console"
        nice = ["nice", "-n", str(NICENESS - os.nice(0))]
        with console.open("wb") as output:
            self._container = subprocess.Popen(  # noqa: S603 - our own arguments
                [
                    *nice,
                    *self._nspawn(self.path),
                    "--boot",
                    "--private-network",
                    "--console=pipe",
                    *RIGHTS,
                ],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=os.environ | {"SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"},
                start_new_session=True,
            )
        deadline_s = time.monotonic() + BOOT_TIMEOUT_S
        while time.monotonic() < deadline_s and self._container.poll() is None:
            time.sleep(POLL_S)
            self._leader = _first_child(self._container.pid)
            if self._leader and (self.path / "etc").exists():
                said = self._call_inside("systemctl is-system-running", 10.0).stdout.strip()
                if said in ("running", "degraded"):
                    return said
        lines = console.read_text("utf-8", "replace").strip().splitlines()
        raise InstallError(f"systemd does not come up: {lines[-1] if lines else 'says nothing'}")

    def inside(self, script: str, timeout_s: float = 120.0) -> str:
        """Run a shell script in the booted root, as root from the source tree.

        Returns:
            Its standard output.

        Raises:
            InstallError: If it fails or takes too long.
        """
        done = self._call_inside(f"cd {IN_ROOT} && {{ {script}\n}}", timeout_s)
        if done.returncode:
            raise InstallError(f"`{script}`: {_last_line(done)}")
        return done.stdout

    def shut_down(self) -> None:
        """Power off as a machine would: systemd stops every service first."""
        if self._container is None:
            return
        with suppress(InstallError):
            self._call_inside("systemctl poweroff", 30.0)
        try:
            self._container.wait(60.0)
        except subprocess.TimeoutExpired:
            os.killpg(self._container.pid, signal.SIGTERM)  # nspawn ends all that runs in there
            with suppress(subprocess.TimeoutExpired):
                self._container.wait(15.0)
            with suppress(ProcessLookupError):
                os.killpg(self._container.pid, signal.SIGKILL)
            self._container.wait()
        self._container, self._leader = None, 0

    def close(self) -> None:
        """End everything in there and remove the root, unless it is to be kept."""
        self.shut_down()
        for place in (folder / name for folder in CGROUPS for name in NSPAWN_CGROUPS):
            for group in [*sorted(place.rglob("*/"), reverse=True), place]:
                with suppress(OSError):  # in use by another container, or not there
                    group.rmdir()
        for left in Path("/run/systemd/nspawn").glob(f"*/hil-install-{os.getpid()}"):
            shutil.rmtree(left, ignore_errors=True)
        if not self._is_kept:
            shutil.rmtree(self._scratch)

    def _call_inside(self, script: str, timeout_s: float) -> "subprocess.CompletedProcess[str]":
        enter = ["nsenter", f"--target={self._leader}", "--mount", "--uts", "--ipc", "--net"]
        enter += ["--pid", "--cgroup", "--root", "--wd", "env", "-i", f"PATH={PATH}"]
        command = [*enter, "HOME=/root", "LANG=C.UTF-8", "sh", "-ec", script]
        return _call(command, timeout_s, os.environ)

    def _must(self, command: list[str], timeout_s: float) -> str:
        done = _call(command, timeout_s, os.environ)
        if done.returncode:
            raise InstallError(f"`{command[-1].splitlines()[0]}`: {_last_line(done)}")
        return done.stdout


def _first_child(pid: int) -> int:
    with suppress(OSError):
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii").split()
        return int(children[0]) if children else 0
    return 0


def source_files() -> list[str]:
    """Return what a clone would hold, with the changes that are not committed yet."""
    command = ["git", "-C", str(SOURCE), "ls-files", "-co", "--exclude-standard"]
    done = _call(command, 60.0, os.environ)
    if done.returncode:
        raise MissingError(f"the source is no git tree: {_last_line(done)}")
    return [name for name in done.stdout.splitlines() if (SOURCE / name).is_file()]


def _call(
    command: list[str], timeout_s: float, environment: "os._Environ[str] | dict[str, str]"
) -> "subprocess.CompletedProcess[str]":
    """Run a command in a process group of its own, which ends with it at the latest.

    Raises:
        InstallError: If it takes too long.
    """
    process = subprocess.Popen(  # noqa: S603 - our own arguments
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=environment,
        start_new_session=True,
    )
    try:
        out, err = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired as error:
        raise InstallError(
            f"`{command[-1].splitlines()[0]}` took more than {timeout_s:g} s"
        ) from error
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def _last_line(done: "subprocess.CompletedProcess[str]") -> str:
    told = [line for line in done.stderr.splitlines() if line.strip() and not NOISE.match(line)]
    lines = told or done.stdout.strip().splitlines()
    return lines[-1] if lines else f"exit status {done.returncode}"
