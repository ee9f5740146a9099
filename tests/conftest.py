"""Tests that need a kernel with CAN are marked, and can be told not to skip.

`make lab` runs them on such a kernel (deploy/lab) with `-m kernel_can --no-skips`.
"""

import socket
import subprocess
from itertools import count
from pathlib import Path

import pytest

FOLDERS = {"drivers", "lab"}
"""Where `make lab` looks."""
CAN_FIXTURES = frozenset({"own_vcan", "shared_vcan", "vcan", "slcan_interface"})
_numbers = count(1)
OWN_NAMESPACE = pytest.StashKey[int]()


def pytest_addoption(parser):
    parser.addoption(
        "--no-skips",
        action="store_true",
        help="a skipped test is a failed one: what is asked for must have run",
    )


def pytest_configure(config):
    for line in (
        "kernel_can: needs AF_CAN and the right to make vcan interfaces (`make lab`)",
        "kernel_slcan: needs the slcan line discipline in the kernel's first network namespace",
    ):
        config.addinivalue_line("markers", line)


def needs_kernel_can(item):
    wiring = getattr(item, "callspec", None) and item.callspec.params.get("wiring", "")
    return str(wiring).startswith("socketcan") or CAN_FIXTURES & set(item.fixturenames)


def is_in_own_namespace():
    """The kernel makes slcan interfaces in its first network namespace, and nowhere else."""
    try:
        return Path("/proc/self/ns/net").samefile("/proc/1/ns/net") is False
    except OSError:
        return True


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(config, items):
    for item in items:
        if needs_kernel_can(item):
            item.add_marker(pytest.mark.kernel_can)
        if item.get_closest_marker("kernel_can") and item.path.parent.name not in FOLDERS:
            raise pytest.UsageError(f"{item.nodeid}: `make lab` runs only tests in {FOLDERS}")
        if "slcan_interface" in item.fixturenames:
            item.add_marker(pytest.mark.kernel_slcan)
    if config.getoption("no_skips") and is_in_own_namespace():
        left_out = [item for item in items if item.get_closest_marker("kernel_slcan")]
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=left_out)
        config.stash[OWN_NAMESPACE] = len(left_out)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    report = yield
    if item.config.getoption("no_skips") and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid} was skipped: {report.longrepr}"
    return report


def pytest_terminal_summary(terminalreporter, config):
    number = config.stash.get(OWN_NAMESPACE, 0)
    if number:
        terminalreporter.write_line(
            f"{number} tests of kernel slcan left out: not possible in a network namespace; "
            "`make lab LAB_KERNEL=uml` runs them"
        )


def make_vcan():
    """A virtual CAN interface of the test's own, or None where it may not make one.

    Skips with the reason where the kernel has no CAN at all.
    """
    try:
        socket.socket(29, socket.SOCK_RAW, 1).close()  # AF_CAN, CAN_RAW
    except OSError as error:
        pytest.skip(f"this kernel has no CAN (AF_CAN): {error.strerror}; `make lab` has one")
    name = f"hil{next(_numbers)}"
    adding = ["ip", "link", "add", "dev", name, "type", "vcan"]
    if subprocess.run(adding, capture_output=True, check=False).returncode:
        yield None
        return
    subprocess.run(["ip", "link", "set", name, "up"], check=True)
    yield name
    subprocess.run(["ip", "link", "delete", name], capture_output=True, check=False)


@pytest.fixture
def own_vcan():
    """An interface of the test's own; see `make_vcan`."""
    yield from make_vcan()


@pytest.fixture
def vcan(own_vcan):
    """A virtual CAN interface that is up: the test's own, or the host's vcan0."""
    if own_vcan:
        return own_vcan
    flags = Path("/sys/class/net/vcan0/flags")
    if not flags.exists() or not int(flags.read_text(), 16) & 1:
        pytest.skip("no interface vcan0 that is up, and not allowed to make one")
    return "vcan0"
