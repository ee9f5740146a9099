"""`hil doctor`: checks with verdicts, on hosts as they are and as they should not be."""

import json
import os
import shutil
import socket
import subprocess
import sys

import pytest

from hil import host_checks
from hil.doctor import examine, judge_can
from hil.finding import Finding
from hil.watchdogs import check_watchdogs, watchdog_warning
from tests.hil.lab import free_port
from tests.hil.virtual import configured

NAMES = {
    "python", "kernel", "scheduler", "rt throttling", "memlock", "cores", "isolated cores",
    "irq affinity", "governor", "clock source", "bus", "can interface", "bus load", "zenoh",
    "zenoh routers", "watchdogs",
}  # fmt: skip


@pytest.fixture
def emulated(lab):
    lab.emulate()
    return lab


def findings(*assignments):
    return {finding.name: finding for finding in examine(configured(*assignments))}


def test_doctor__bus_there__every_check_has_a_verdict(emulated):
    found = findings(
        f"bus.address=unix:{emulated.bus_path}",
        f'zenoh.listen=["{emulated.endpoint}"]',
        "loop.realtime=best_effort",
    )
    assert set(found) >= NAMES
    assert all(isinstance(finding, Finding) for finding in found.values())
    assert found["bus"].level == "pass"
    assert found["zenoh"].level == "pass"
    assert found["bus load"].level == "pass"
    assert not [f for f in found.values() if f.level == "fail"]
    assert all(f.remedy for f in found.values() if f.level != "pass")


def test_doctor__while_a_daemon_runs__disturbs_nothing(emulated):
    arm = emulated.run()
    arm.client.command("enable")
    arm.swing()
    doctor = emulated.start(
        "doctor", *emulated.settings(f'zenoh.listen=["{emulated.endpoint}"]'), "--json"
    )
    assert doctor.wait() == 0
    found = {finding["name"]: finding for finding in json.loads(doctor.stdout)}
    assert found["bus"]["level"] == "pass"
    assert found["zenoh"]["level"] == "warn"
    assert "Address already in use" in found["zenoh"]["found"]
    arm.wait_cycles(50)
    assert arm.now["fault"] == 0
    assert arm.statuses[-1]["unknown_frames"] == 0


def test_doctor__bus_missing__fails_with_a_remedy(lab):
    doctor = lab.start("doctor", *lab.settings())
    assert doctor.wait() == 1
    (line,) = [line for line in doctor.stdout.splitlines() if line.startswith("FAIL")]
    assert f"no bus at unix:{lab.bus_path}" in line
    assert "hil emulate" in line
    assert doctor.stderr == ""


def test_doctor__bus_overloaded__fails_with_the_share():
    assert findings("bus.bit_rate=500000")["bus load"].level == "fail"
    assert "130.0 %" in findings("bus.bit_rate=500000")["bus load"].found


def test_doctor__core_not_there__fails():
    absent = max(os.sched_getaffinity(0)) + 1
    found = findings(f"loop.cpu={absent}")["cores"]
    assert found.level == "fail"
    assert str(absent) in found.found


def test_doctor__zenoh_open_to_the_network__warns():
    port = free_port()
    found = findings(f'zenoh={{listen=["tcp/0.0.0.0:{port}"], allow_open=true}}')["zenoh"]
    assert found.level == "warn"
    assert "command" in found.remedy
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        assert findings(f'zenoh.listen=["{endpoint}"]')["zenoh"].level == "warn"


# --- hosts as they should not be --------------------------------------------------------------


def host(tmp_path, **files):
    """A directory that stands for `/`, with these files in it."""
    for path, text in files.items():
        place = tmp_path / path.replace("__", "/")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text + "\n")
    return tmp_path


@pytest.mark.parametrize(
    ("text", "cores"), [("", set()), ("1", {1}), ("0,2-4", {0, 2, 3, 4}), ("none", set())]
)
def test_cpus__list_of_the_kernel__read(text, cores):
    assert host_checks.parse_cpus(text) == cores


@pytest.mark.parametrize(
    ("isolated", "setting", "level"),
    [
        ("1", "loop.cpu=1", "pass"),
        ("", "loop.cpu=1", "warn"),
        ("1-3", "", "warn"),
        ("", "", "pass"),
    ],
)
def test_isolation__loop_core__among_the_isolated_ones_or_warned(
    tmp_path, isolated, setting, level
):
    root = host(tmp_path, sys__devices__system__cpu__isolated=isolated)
    found = host_checks.isolation(configured(*[setting] * bool(setting)), root)
    assert found.level == level
    assert bool(found.remedy) == (level != "pass")


def test_interrupts__on_the_core_of_the_loop__named(tmp_path):
    root = host(
        tmp_path,
        proc__irq__7__effective_affinity_list="1",
        proc__irq__8__effective_affinity_list="0",
        proc__irq__9__effective_affinity_list="0-3",
    )
    for number in (7, 8):
        (root / f"proc/irq/{number}/eth0").mkdir()
    found = host_checks.interrupts(configured("loop.cpu=1"), root)
    assert (found.level, found.found) == ("warn", "1 on core 1: 7")  # nobody uses 9
    assert host_checks.interrupts(configured("loop.cpu=2"), root).level == "pass"
    assert host_checks.interrupts(configured(), root).level == "pass"


@pytest.mark.parametrize(
    ("runtime_us", "spin", "level"),
    [("950000", "true", "warn"), ("950000", "false", "pass"), ("-1", "true", "pass")],
)
def test_throttling__spinning_loop__needs_all_of_the_time(tmp_path, runtime_us, spin, level):
    root = host(tmp_path, proc__sys__kernel__sched_rt_runtime_us=runtime_us)
    assert host_checks.throttling(configured(f"loop.spin={spin}"), root).level == level


def test_kernel__preempt_rt__passes(tmp_path):
    assert (
        host_checks.kernel(configured(), host(tmp_path, sys__kernel__realtime="1")).level == "pass"
    )


@pytest.mark.parametrize(("governor", "level"), [("performance", "pass"), ("powersave", "warn")])
def test_governor__of_any_core__judged(tmp_path, governor, level):
    root = host(tmp_path, sys__devices__system__cpu__cpu0__cpufreq__scaling_governor=governor)
    assert host_checks.governor(configured(), root).level == level


@pytest.mark.parametrize(("source", "level"), [("tsc", "pass"), ("hpet", "warn")])
def test_clock__slow_source__warned_with_a_better_one(tmp_path, source, level):
    folder = "sys__devices__system__clocksource__clocksource0__"
    files = {f"{folder}current_clocksource": source, f"{folder}available_clocksource": "tsc hpet"}
    found = host_checks.clock(configured(), host(tmp_path, **files))
    assert found.level == level
    assert ("clocksource=tsc" in found.remedy) == (level == "warn")


@pytest.mark.parametrize(("realtime", "level"), [("required", "fail"), ("best_effort", "warn")])
def test_realtime__asked_for_and_not_granted__a_failure(realtime, level):
    code = (
        "import sys; from hil.doctor import examine; from tests.hil.virtual import configured;"
        "c = configured(f'loop.realtime={sys.argv[1]}');"
        "print({f.name: f.level for f in examine(c)}['scheduler'])"
    )
    without = ["setpriv", "--bounding-set=-sys_nice", "--inh-caps=-sys_nice"]
    if shutil.which("setpriv") is None or os.geteuid() != 0:
        pytest.skip("needs setpriv (util-linux) and root, to run without the right")
    done = subprocess.run(
        [*without, sys.executable, "-c", code, realtime],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.stdout.strip() == level, done.stderr


@pytest.mark.parametrize(
    ("queue", "bit_rate", "state", "level", "told"),
    [
        ("128", 1_000_000, "ERROR-ACTIVE", "pass", "1000000 bit/s"),
        ("128", 500_000, "ERROR-ACTIVE", "fail", "runs at 500000 bit/s"),
        ("4", 1_000_000, "ERROR-ACTIVE", "warn", "send queue of 4"),
        ("128", 1_000_000, "BUS-OFF", "fail", "BUS-OFF"),
        ("128", 1_000_000, "ERROR-PASSIVE", "warn", "ERROR-PASSIVE"),
        ("128", None, "", "pass", "no bit rate"),
    ],
)
def test_can__interface__judged_by_bit_rate_queue_and_state(queue, bit_rate, state, level, told):
    timing = {} if bit_rate is None else {"bittiming": {"bitrate": bit_rate}}
    details = {"linkinfo": {"info_data": {**timing, "state": state}}}
    found = judge_can(configured(), "can0", queue, details)
    assert found.level == level
    assert told in found.found
    assert bool(found.remedy) == (level != "pass")


def test_routers__nobody_there__fails_for_a_client_and_warns_for_a_peer():
    connect = f'zenoh.connect=["tcp/127.0.0.1:{free_port()}"]'
    assert findings(connect)["zenoh routers"].level == "warn"
    assert findings(connect, "zenoh.mode=client")["zenoh routers"].level == "fail"
    assert findings("zenoh.mode=client")["zenoh routers"].level == "fail"
    with socket.socket() as router:
        router.bind(("127.0.0.1", 0))
        router.listen()
        connect = f'zenoh.connect=["tcp/127.0.0.1:{router.getsockname()[1]}"]'
        assert findings(connect)["zenoh routers"].level == "pass"


@pytest.mark.parametrize(
    ("assignments", "level", "words"),
    [
        ((), "pass", "torque off 20 ms after the last command"),
        (("axes.2.family=odrive",), "pass", "torque off 20 ms"),
        (("axes.2.family=mit", "axes.2.variant=damiao"), "pass", "torque off 20 ms"),
        (("axes.2.family=mit", "axes.2.variant=tmotor", "axes.2.master_id=66"),
         "warn", "torque of joint 2 (tmotor) stays on"),
        (("axes.1.family=mit", "axes.1.variant=cubemars"), "warn", "joint 1 (cubemars) stays on"),
        (("axes.2.family=mit", "axes.2.variant=cybergear"), "warn", "joint 2 (cybergear) stays on"),
    ],
)  # fmt: skip
def test_watchdogs__families__those_without_are_named(assignments, level, words):
    finding = check_watchdogs(configured(*assignments))
    assert (finding.level, bool(finding.remedy)) == (level, level == "warn")
    assert words in finding.found
    assert bool(watchdog_warning(configured(*assignments))) == (level == "warn")


@pytest.mark.parametrize(
    ("options", "base_prefix", "level"),
    [
        ("'--prefix=/opt/python'", "/opt/python", "warn"),
        ("'--prefix=/opt/python' '--enable-optimizations'", "/opt/python", "pass"),
        ("'--prefix=/usr'", "/usr", "pass"),
    ],
)
def test_interpreter__built_without_profile__warned(monkeypatch, options, base_prefix, level):
    monkeypatch.setattr("sysconfig.get_config_var", lambda _: options)
    monkeypatch.setattr("sys.base_prefix", base_prefix)
    assert host_checks.interpreter(configured()).level == level
