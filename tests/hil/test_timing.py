"""Timing instruments: histograms, deadline misses by cause, in the loop and in a recording."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.config import LoopSettings
from hil.histogram import BINS, LARGEST_NS, Histogram, upper_edge_ns
from hil.latency import (
    OURS,
    THEIRS,
    LatencyError,
    Wakeups,
    cyclictest_command,
    judge_fci,
    judge_linuxcnc,
    measure,
    measure_wakeups,
    parse_cyclictest,
)
from hil.realtime import Usage, make_sleeper, now_ns
from hil.sampler import Stamps
from hil.shared import SharedMemory
from hil.stress import KINDS, loaded
from hil.timing import TIMING_BYTES, Timing, missed_text, misses_of, timing_lines
from tests.hil.lab import is_running
from tests.hil.virtual import configured

PERIOD_S, TIMEOUT_S = 1e-3, 0.6e-3
GENTLE = LoopSettings(realtime="off")


def timing():
    return Timing(memoryview(bytearray(TIMING_BYTES)), period_s=PERIOD_S, timeout_s=TIMEOUT_S)


# --- histograms -------------------------------------------------------------------------------


@given(st.lists(st.integers(0, LARGEST_NS), min_size=1, max_size=200))
def test_histogram__any_durations__quantiles_at_most_a_bin_too_high(values):
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    shares = (0.01, 0.5, 0.99, 0.999, 1.0)
    exact = [sorted(values)[max(1, int(np.ceil(s * len(values)))) - 1] for s in shares]
    for found, true in zip(histogram.quantiles_ns(shares), exact, strict=True):
        assert true <= found <= true * (1 + 1 / 31) + 1
    assert histogram.quantiles_ns([1.0]) == [max(values)]
    assert histogram.counts().sum() == len(values)


def test_histogram__every_bin__edges_are_in_it_and_the_next_value_is_not():
    edges = [upper_edge_ns(number) for number in range(BINS)]
    assert edges == sorted(set(edges))
    assert edges[-1] == LARGEST_NS
    for number, edge in enumerate(edges):
        histogram = Histogram()
        histogram.add(edge)
        assert histogram.counts()[number] == 1
        if edge < LARGEST_NS:
            histogram.add(edge + 1)
            assert histogram.counts()[number + 1] == 1


@pytest.mark.parametrize(("value", "counted"), [(-5, 0), (1 << 40, LARGEST_NS)])
def test_histogram__outside_of_its_range__counted_at_its_end(value, counted):
    histogram = Histogram()
    histogram.add(value)
    assert histogram.quantiles_ns([1.0]) == [counted]


def test_histogram__empty__no_quantiles():
    assert Histogram().quantiles_ns() == []
    assert Histogram().summary_us() == {}


@given(st.lists(st.integers(0, 10**7)), st.lists(st.integers(0, 10**7)))
def test_histogram__merged__as_if_counted_by_one(some, others):
    one, other, both = Histogram(), Histogram(), Histogram()
    for histogram, values in ((one, some), (other, others), (both, some + others)):
        for value in values:
            histogram.add(value)
    one.merge(other)
    assert one.counts().tolist() == both.counts().tolist()
    assert one.max_ns == both.max_ns


# --- misses -----------------------------------------------------------------------------------

IN_TIME = Stamps(30_000, 200_000, 260_000, 280_000, 100_000)


@pytest.mark.parametrize(
    ("stamps", "is_fresh", "skipped", "cause"),
    [
        (IN_TIME, True, 0, None),
        (IN_TIME._replace(wake_late_ns=400_000), True, 0, None),  # late, but inside the cycle
        (IN_TIME._replace(wake_late_ns=400_000), False, 0, "late_wake_up"),
        (IN_TIME._replace(wake_late_ns=400_000, sent_ns=1_000_001), True, 0, "late_wake_up"),
        (IN_TIME, True, 3, "late_wake_up"),
        (IN_TIME, False, 0, "late_feedback"),
        (IN_TIME._replace(law_ns=700_000, sent_ns=1_100_000), True, 0, "long_law"),
        (IN_TIME._replace(sent_ns=1_100_000), True, 0, "late_commands"),
    ],
)
def test_misses__one_cycle__its_cause_counted_once(stamps, is_fresh, skipped, cause):
    loop = timing()
    loop.note(stamps, is_fresh=is_fresh, skipped=skipped)
    found = loop.misses()
    assert found.pop("skipped_periods") == skipped
    assert {name: 1 for name, count in found.items() if count} == ({cause: 1} if cause else {})
    assert sum(found.values()) == (cause is not None)


def test_misses__period_skipped_by_a_long_law__the_law_is_the_one_cause():
    loop = timing()
    loop.note(IN_TIME._replace(law_ns=2_400_000, sent_ns=2_500_000), is_fresh=True, skipped=0)
    loop.note(IN_TIME, is_fresh=True, skipped=1)
    found = loop.misses()
    assert (found["long_law"], found["skipped_periods"], found["late_wake_up"]) == (1, 1, 0)
    assert missed_text(found) == "1 long law, 1 periods skipped"


STAMPS = st.builds(
    Stamps,
    st.sampled_from([0, 299_999, 300_000, 300_001, 900_000]),
    st.sampled_from([100_000, 600_000]),
    st.sampled_from([500_000, 1_000_000, 1_000_001]),
    st.sampled_from([600_000, 1_000_000, 1_000_001]),
    st.just(1),
)


@given(st.lists(st.tuples(STAMPS, st.booleans(), st.sampled_from([0, 0, 0, 1, 4])), min_size=1))
def test_misses__of_a_recording__the_same_as_the_loop_counted(cycles):
    cycles[0] = (*cycles[0][:2], 0)
    loop = timing()
    names = ["wake_late_ns", "feedback_ns", "law_ns", "sent_ns", "busy_ns"]
    columns = [(name, "<i4") for name in names]
    rows = np.zeros(len(cycles), [*columns, ("feedback_age_cycles", "<u4"), ("overruns", "<u4")])
    overruns = 7
    for row, (stamps, is_fresh, skipped) in zip(rows, cycles, strict=True):
        loop.note(stamps, is_fresh=is_fresh, skipped=skipped)
        overruns += skipped
        for name, value in zip(names, stamps, strict=True):
            row[name] = value
        row["feedback_age_cycles"], row["overruns"] = not is_fresh, overruns
    assert misses_of(rows, period_s=PERIOD_S, timeout_s=TIMEOUT_S) == loop.misses()


def test_timing__in_shared_memory__read_by_others_while_it_grows():
    shared = SharedMemory.create(configured("trajectory.max_duration_s=1"))
    gateway = SharedMemory(shared.fd)
    assert gateway.timing.summary()["us"]["sent"] == {}
    for _ in range(100):
        shared.timing.note(IN_TIME, is_fresh=True, skipped=0)
    summary = gateway.timing.summary()
    assert summary["cycles"] == 100
    assert summary["us"]["wake_late"]["max"] == 30.0
    assert summary["us"]["feedback"]["p99.9"] == pytest.approx(200.0, rel=0.04)
    assert any("280.0" in line for line in timing_lines(summary))
    assert timing_lines({})[-1].endswith("none")


# --- the loop's instruments -------------------------------------------------------------------


def test_timing__a_hundred_thousand_cycles__memory_does_not_grow():
    loop, usage = timing(), Usage()
    for _ in range(1000):
        loop.note(IN_TIME, is_fresh=True, skipped=0)
    before = sys.getallocatedblocks()
    for number in range(100_000):
        loop.note(Stamps(number, number, number, number, number), is_fresh=True, skipped=0)
    assert sys.getallocatedblocks() - before < 100
    assert usage.since_start()["major_faults"] == 0
    assert usage.since_start()["resident_kB"] > 0


@pytest.mark.parametrize("is_spinning", [False, True])
def test_sleeper__asleep_or_spinning__never_early(is_spinning):
    sleep_until = make_sleeper(is_spinning=is_spinning)
    for _ in range(20):
        due_ns = now_ns() + 500_000
        sleep_until(due_ns)
        assert now_ns() >= due_ns
    before_ns = now_ns()
    sleep_until(before_ns - 1)
    assert now_ns() - before_ns < 500_000_000


# --- the host ---------------------------------------------------------------------------------


def test_latency__measured__as_many_wakeups_as_asked_for_and_none_early():
    wakeups = measure_wakeups(1e-3, 0.3)
    assert wakeups.cycles == 300
    assert wakeups.jitter_ns > 0
    assert wakeups.lateness.counts()[:1].sum() < 300


def test_latency__alternating__both_sides_as_often_and_ratios_of_the_whole():
    latency = measure(GENTLE, seconds=0.4, rounds=2)
    has_theirs = cyclictest_command(GENTLE, 1.0) is not None
    assert len(latency.turns[OURS]) == 2
    assert latency.granted.scheduler == "SCHED_OTHER"
    assert has_theirs == (THEIRS in latency.turns)
    if has_theirs:
        assert latency.total(THEIRS).cycles == latency.total(OURS).cycles == 200
        ours, theirs = (latency.total(side).lateness.quantiles_ns([0.5]) for side in (OURS, THEIRS))
        assert latency.ratios()["p50"] == round(ours[0] / theirs[0], 3)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_cyclictest__its_output__becomes_the_histogram():
    text = (
        "# /dev/cpu_dma_latency set to 0us\n# Histogram\n000003 000010\n000004 000080\n"
        "001500 000007\n# Total: 000000098\n# Min Latencies: 00003\n# Max Latencies: 60000\n"
        "# Histogram Overflows: 00003\n# Thread 0: 00000\n"
    )
    wakeups = parse_cyclictest(text)
    assert wakeups.cycles == 100
    assert wakeups.lateness.quantiles_ns([0.1, 0.5]) == pytest.approx([3000, 4000], rel=0.04)
    assert wakeups.jitter_ns == 60_000_000
    assert wakeups.over_limit == 10
    with pytest.raises(LatencyError, match="no histogram: Unable"):
        parse_cyclictest("Unable to change scheduling policy!")


@pytest.mark.skipif(shutil.which("cyclictest") is None, reason="cyclictest (rt-tests) not there")
def test_cyclictest__installed__its_options_are_understood():
    command = cyclictest_command(GENTLE, 0.1)
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=30)
    assert done.returncode == 0, done.stderr
    assert parse_cyclictest(done.stdout).cycles == 100


@pytest.mark.parametrize(
    ("jitter_us", "level"),
    [(15, "pass"), (20, "pass"), (45, "pass"), (60, "warn"), (900, "warn"), (1001, "fail")],
)
def test_verdict__linuxcnc__by_its_steps(jitter_us, level):
    assert judge_linuxcnc(Wakeups(jitter_ns=jitter_us * 1000)).level == level


@pytest.mark.parametrize(
    ("late", "in_a_row", "level"),
    [(0, 0, "pass"), (50, 20, "pass"), (51, 3, "warn"), (101, 1, "fail"), (1, 21, "fail")],
)
def test_verdict__fci__by_success_rate_and_losses_in_a_row(late, in_a_row, level):
    wakeups = Wakeups(over_limit=late, in_a_row=in_a_row)
    wakeups.lateness.add(10, 1000)
    assert judge_fci(wakeups).level == level


@pytest.mark.parametrize("kind", KINDS)
def test_stressors__context_left__all_gone(kind):
    with loaded([kind]) as pids:
        assert pids
        assert all(is_running(pid) for pid in pids)
    assert not any(is_running(pid) for pid in pids)


def test_latency_command__wrong_load__usage_error(lab):
    command = lab.start("latency", "--load", "cpu,fire")
    assert command.wait() == 2
    assert "'fire' is no load" in command.stderr


def test_spinning__daemon__runs_and_counts(lab):
    lab.emulate()
    arm = lab.run("loop.spin=true", "loop.realtime=off")
    arm.client.command("enable")
    arm.swing()
    arm.wait_cycles(200)
    status = arm.statuses[-1]
    assert status["timing"]["cycles"] > 100
    assert set(status["misses"]) >= {"late_wake_up", "late_feedback", "long_law", "late_commands"}
    assert set(status["ladder"]) == {"late", "held", "damped", "given_up"}
    assert status["minor_faults"] >= 0
