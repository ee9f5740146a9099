"""The recorder on real shared memory: parts, limits of the disk, and kills at any instant."""

import json
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from hil.cli import main
from hil.config import ConfigError, config_from_json, load_config
from hil.export import export_csv
from hil.realtime import now_ns
from hil.recorder import Recorder
from hil.recording import Part, Recording, RecordingError, RecordingWriter
from hil.replay import Replayer, ReplayError
from hil.shared import SharedMemory
from hil.telemetry import RECEIVED, SENT, LoggedFrame
from tests.hil.lab import wait_until

PERIOD_NS = 1_000_000
IS_NIGHTLY = os.environ.get("HIL_NIGHTLY") == "1"
KILLS = 40 if IS_NIGHTLY else 3
KILLS_OF_ALL = 12 if IS_NIGHTLY else 1
SERIES = "5e41e5"
STALL_S = 0.4
"""What a busy host may add to the tenth of a second that a kill of everything costs."""
EVERY_EVENT = 100
"""An event per so many cycles."""


class Source:
    """What the loop writes: one sample and two frames a cycle, now and then an event."""

    def __init__(self, **recording):
        settings = {"min_free_MB": 0.0, **recording}
        over = {"recording": settings, "trajectory": {"max_duration_s": 2.0}}
        self.config = load_config(None, over)
        self.shared = SharedMemory.create(self.config)
        self.write_sample = self.shared.layout.writer()
        self.start_ns = now_ns()
        self.cycles = 0

    def cycle(self):
        shared, k = self.shared, self.cycles
        t_ns = self.start_ns + k * PERIOD_NS
        layout = shared.layout
        scalars = [k, k, t_ns, *[0] * (len(layout.scalar_names) - 3)]
        noise = np.random.default_rng(k).random((len(layout.list_names), 2))  # cannot be compressed
        offset = shared.samples.begin(layout.size)
        self.write_sample(shared.samples.memory, offset, scalars, noise.tolist())
        shared.samples.commit()
        shared.frames.append(b"".join(shared.frame_layout.entry(*f) for f in self.frames(k)))
        if k % EVERY_EVENT == 0:
            event = b'{"t_ns": %d, "cycle": %d, "kind": "state", "to": "READY"}' % (t_ns, k)
            shared.events.append(event)
        self.cycles = k + 1

    def frames(self, k):
        t_ns = self.start_ns + k * PERIOD_NS
        return (
            LoggedFrame(t_ns + 1, SENT, k.to_bytes(16, "little")),
            LoggedFrame(t_ns + 2, RECEIVED, (k + 1).to_bytes(16, "little")),
        )

    def run(self, cycles):
        for _ in range(cycles):
            self.cycle()

    def require_whole(self, path):
        """Everything is in the recording, once and in order."""
        run = Recording.open_run(path)
        assert run.samples["seq"].tolist() == list(range(self.cycles))
        assert [e.cycle for e in run.events if e.kind == "state"] == list(
            range(0, self.cycles, EVERY_EVENT)
        )
        expected = [frame for k in range(self.cycles) for frame in self.frames(k)]
        assert list(run.frames()) == expected
        return run


def notes_of(source):
    reader = source.shared.follower("notes")
    reader.place = 0
    return reader.read_json(100)


def actions(source):
    return [note["action"] for note in notes_of(source)]


def recorded(source, path, cycles, each=50):
    """Record so many cycles in this process, draining now and then."""
    recorder = Recorder(source.shared, path, SERIES)
    for _ in range(cycles // each):
        source.run(each)
        recorder.drain()
    recorder.close()


class Process:
    """The recorder as a process of its own, this one being its supervisor."""

    def __init__(self, source, path, **options):
        fd = source.shared.fd
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        source.shared.beat("recorder", 0)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "hil.process", "recorder", str(fd), str(os.getpid()),
             str(path), SERIES],
            pass_fds=[fd],
            stderr=subprocess.PIPE,
            text=True,
            **options,
        )  # fmt: skip
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        wait_until(lambda: self.is_up(source), 60.0, what="the recorder")

    def is_up(self, source):
        assert self.process.poll() is None, self.process.communicate()
        return source.shared.last_beat("recorder")

    def kill(self):
        self.process.kill()
        self.process.communicate()

    def end(self):
        self.process.terminate()
        _, told = self.process.communicate(timeout=30)
        return self.process.returncode, told


@pytest.fixture
def running():
    """A source that writes a cycle per millisecond until the test is over.

    It waits for recorders that are slow to start: nothing is to be lost by that.
    """
    source, is_over = Source(max_size_MB=0.1), threading.Event()

    def work():
        while not is_over.is_set():
            if (
                source.shared.reader("samples", "recorder").backlog
                < source.shared.samples.slots // 2
            ):
                source.cycle()
            time.sleep(0.001)

    thread = threading.Thread(target=work)

    def stop():
        is_over.set()
        if thread.is_alive():
            thread.join()

    source.stop = stop
    thread.start()
    yield source
    stop()


def committed(source):
    """Number of samples that a recorder has left behind as written."""
    return source.shared.reader("samples", "recorder").place


def test_recorder__killed_at_random_instants__flushed_data_is_there_and_nothing_is_missed(
    running, tmp_path
):
    seed = time.time_ns()
    print(f"seed {seed}")  # noqa: T201 - to repeat a failure
    chance, path = random.Random(seed), tmp_path / "run.mcap"
    for _ in range(KILLS):
        process = Process(running, path)
        time.sleep(chance.uniform(0.0, 0.3))
        process.kill()
        if committed(running):
            samples = Recording.open_run(path).samples  # readable, whatever it was doing
            assert samples["seq"][-1] + 1 >= committed(running)
            assert np.array_equal(samples["seq"], np.arange(len(samples)))
    last = Process(running, path)
    running.stop()
    assert last.end() == (0, "")
    run = running.require_whole(path)
    assert not run.is_truncated
    assert len(run.parts) > KILLS


def test_recorder__file_full_of_its_size__continues_in_parts_without_a_gap(tmp_path):
    source, path = Source(max_size_MB=0.05), tmp_path / "run.mcap"
    recorded(source, path, 2000)
    run = source.require_whole(path)
    assert len(run.parts) > 5
    assert [p.name for p in run.parts[:3]] == ["run.mcap", "run-2.mcap", "run-3.mcap"]
    assert all(p.stat().st_size < 150_000 for p in run.parts)
    assert actions(source) == ["continued"] * (len(run.parts) - 1)
    for number, part in enumerate(run.parts, start=1):  # each stands by itself
        alone = Recording.open(part)
        assert not alone.is_truncated
        assert alone.config["recording"]["max_size_MB"] == 0.05
        assert alone.part == Part(SERIES, number)
        with part.open("rb") as file:
            topics = {c.topic for c in make_reader(file).get_summary().channels.values()}
        assert topics == {"telemetry", "bus", "event"}


def test_recorder__file_too_old__continues_in_a_new_one(tmp_path):
    source, path = Source(max_age_s=1e-6), tmp_path / "run.mcap"
    recorded(source, path, 150)
    assert len(source.require_whole(path).parts) == 3  # the last one was empty, and is gone


def test_recorder__ended_without_a_cycle__no_file(tmp_path):
    recorder = Recorder(Source().shared, tmp_path / "run.mcap", SERIES)
    recorder.drain()
    recorder.close()
    assert list(tmp_path.iterdir()) == []


def test_open_run__parts_of_an_older_run_of_the_same_name__are_left_out(tmp_path):
    path = tmp_path / "run.mcap"
    older = Source(max_size_MB=0.05)
    recorded(older, path, 1000)
    source = Source(max_age_s=1e-6)
    newer = Recorder(source.shared, path, "another")
    for _ in range(2):
        source.run(50)
        newer.drain()
    newer.close()
    assert (tmp_path / "run-3.mcap").exists() or len(Recording.open_run(path).parts) == 2
    source.require_whole(path)


def test_open_run__middle_part_lost__says_that_samples_are_missing(tmp_path):
    source, path = Source(max_size_MB=0.05), tmp_path / "run.mcap"
    recorded(source, path, 1000)
    second = Recording.open_run(tmp_path / "run-2.mcap")  # from any part on
    assert second.samples["seq"][0] > 0
    assert second.samples["seq"][-1] == 999
    Path(tmp_path / "run-2.mcap").rename(tmp_path / "away")
    assert Recording.open_run(path).parts == (path,)


def test_recorder__budget__oldest_of_this_arm_go_first_and_nothing_else(tmp_path):
    names = {
        "bench-20260101-000000.mcap": 100_000,
        "bench-20260102-000000-2.mcap": 100_000,
        "bench-20260103-000000.mcap": 30_000,
        "other-20250101-000000.mcap": 100_000,
        "bench-2-20250101-000000.mcap": 100_000,  # an arm of that name
        "bench-20250101-000000-trip.mcap": 100_000,
        "mine.mcap": 100_000,
    }
    for age, (name, size) in enumerate(names.items()):
        (tmp_path / name).write_bytes(bytes(size))
        os.utime(tmp_path / name, (1_000 + age, 1_000 + age))
    source = Source(max_size_MB=0.08, disk_budget_MB=0.16)
    path = tmp_path / "bench-20260110-120000.mcap"
    recorder = Recorder(source.shared, path, SERIES)
    recorder.drain()
    recorder.close()
    gone = {note["file"] for note in notes_of(source) if note["action"] == "removed"}
    assert gone == {"bench-20260101-000000.mcap"}  # 130 kB are left
    assert {p.name for p in tmp_path.iterdir()} == set(names) - gone


def test_recorder__budget_smaller_than_the_run__its_own_first_parts_go_never_the_last(tmp_path):
    source, path = Source(max_size_MB=0.05, disk_budget_MB=0.2), tmp_path / "mine.mcap"
    (tmp_path / "mine-900.mcap").write_bytes(bytes(10))  # not ours
    recorder = Recorder(source.shared, path, SERIES)
    recorder.clean_up_every_ns = 0
    for _ in range(60):
        source.run(50)
        recorder.drain()
    recorder.close()
    left = sorted(tmp_path.glob("mine*.mcap"), key=lambda p: p.stat().st_mtime_ns)
    assert tmp_path / "mine-900.mcap" in left
    assert sum(p.stat().st_size for p in left) < 0.2e6 + 0.1e6
    assert not path.exists()
    newest = Recording.open(max(left, key=lambda p: p.stat().st_mtime_ns))
    assert newest.samples["seq"][-1] == source.cycles - 1


def test_recorder__too_little_free_space__told_once_and_the_rings_are_drained(tmp_path, capsys):
    source = Source(min_free_MB=1e12)
    recorder = Recorder(source.shared, tmp_path / "run.mcap", SERIES)
    for _ in range(3):
        source.run(50)
        recorder.drain()
    recorder.close()
    assert list(tmp_path.iterdir()) == []
    (note,) = notes_of(source)
    assert note["action"] == "stopped"
    assert "recording.min_free_MB is 1e+12" in note["reason"]
    assert capsys.readouterr().err.count("recording has stopped") == 1
    assert source.shared.reader("samples", "recorder").backlog == 0


def test_recorder__disk_takes_no_more__told_once_file_readable_and_the_rest_is_let_go(tmp_path):
    source, path = Source(), tmp_path / "run.mcap"

    def small_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))

    process = Process(source, path, preexec_fn=small_disk)
    for _ in range(20):
        source.run(100)
        wait_until(lambda: committed(source) == source.cycles, what="an empty ring")
    status, told = process.end()
    assert status == 0
    assert told.count("\n") == 1
    assert "recording has stopped: cannot write recording" in told
    assert "File too large" in told
    assert actions(source) == ["stopped"]
    recording = Recording.open(path)
    assert recording.is_truncated
    assert 100 < len(recording.samples) < source.cycles


def test_recorder__directory_gone_at_a_new_part__stops_and_says_so(tmp_path):
    folder = tmp_path / "runs"
    folder.mkdir()
    source = Source(max_age_s=1e-6)
    recorder = Recorder(source.shared, folder / "run.mcap", SERIES)
    source.run(10)
    for entry in folder.iterdir():
        entry.unlink()
    folder.rmdir()
    recorder.drain()
    assert actions(source)[-1] == "stopped"
    source.run(10)
    recorder.drain()
    assert actions(source).count("stopped") == 1


def test_recorder__directory_missing_at_start__refused(tmp_path):
    with pytest.raises(RecordingError, match=r"No such file or directory"):
        Recorder(Source().shared, tmp_path / "none" / "run.mcap", SERIES).drain()


def test_settings__budget_below_two_files__refused():
    with pytest.raises(ConfigError, match=r"disk_budget_MB 100 must be at least twice max_size_MB"):
        load_config(None, {"recording": {"disk_budget_MB": 100}})


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    """A recording whose recorder was killed in the middle of a write."""
    path = tmp_path_factory.mktemp("cut") / "run.mcap"
    source = Source()
    recorded(source, path, 1000)
    path.write_bytes(path.read_bytes()[:-60_000])
    return path


def test_export__cut_recording__rows_of_what_is_there(cut, tmp_path):
    recording = Recording.open(cut)
    with (tmp_path / "run.csv").open("w", newline="") as file:
        export_csv(recording, file)
    rows = (tmp_path / "run.csv").read_text().splitlines()
    assert len(rows) == 1 + len(recording.samples)
    assert 0 < len(recording.samples) < 1000


def test_writer__part__stands_in_the_metadata(tmp_path):
    path, part = tmp_path / "run-7.mcap", Part("abc", 7)
    with RecordingWriter(path, {}, 2, with_truth=False, part=part):
        pass
    assert Recording.open(path).part == part
    assert part.first(path) == tmp_path / "run.mcap"
    assert part.path(tmp_path / "run.mcap") == path


def test_daemon__recorder_killed_again_and_again_in_parts__whole_run_replays_identically(lab):
    lab.emulate()
    arm = lab.run("recording.max_size_MB=0.1")
    arm.client.command("enable")
    arm.swing()
    for _ in range(2):
        before = arm.daemon.children()["recorder"]
        time.sleep(random.uniform(0.0, 0.3))
        os.kill(before, signal.SIGKILL)
        wait_until(
            lambda old=before: arm.daemon.children().get("recorder", old) != old, what="a new one"
        )
        arm.wait_cycles(200)
    assert arm.daemon.end() == 0
    run = Recording.open_run(arm.recording)
    assert len(run.parts) > 3
    assert not run.is_truncated
    assert run.samples["seq"].tolist() == list(range(len(run.samples)))
    continued = [event for event in arm.events if event["kind"] == "recording"]
    assert {event["action"] for event in continued} == {"continued"}
    result = Replayer(run, run_config(run)).run()
    assert result.difference is None
    assert result.cycles == len(run.samples)
    with pytest.raises(ReplayError, match=r"part 2 of a run.*replay .*run1\.mcap, it goes on"):
        Replayer(Recording.open(run.parts[1]), run_config(run))


def run_config(recording):
    return config_from_json(json.dumps(recording.config))


@pytest.mark.parametrize("number", range(KILLS_OF_ALL))
def test_daemon__all_processes_killed__file_readable_up_to_the_last_flush(lab, number):
    lab.emulate()
    arm = lab.run()
    arm.client.command("enable")
    arm.swing()
    time.sleep(random.uniform(0.0, 0.2))
    children = arm.daemon.children()
    for pid in (*children.values(), arm.daemon.pid):
        os.kill(pid, signal.SIGKILL)
    arm.daemon.process.wait()
    last_seen_ns = int(arm.now["t_ns"])
    recording = Recording.open(arm.recording)
    assert recording.is_truncated
    assert np.all(np.diff(recording.samples["seq"].astype(int)) == 1)
    lost_s = (last_seen_ns - int(recording.samples["t_ns"][-1])) / 1e9
    print(f"lost {lost_s * 1e3:.0f} ms")  # noqa: T201 - with -s, the figure
    assert lost_s < 0.1 + STALL_S


def test_open_run__next_part_killed_at_its_first_bytes__is_left_out(tmp_path):
    path = tmp_path / "run.mcap"
    recorded(Source(), path, 100)
    (tmp_path / "run-2.mcap").write_bytes(b"\x89MCAP")
    assert Recording.open_run(path).parts == (path,)


def test_export__whole_run__rows_of_all_parts(tmp_path, capsys):
    source, path = Source(max_size_MB=0.05), tmp_path / "run.mcap"
    recorded(source, path, 500)
    assert main(["export", str(path), "--csv", "-", "--whole-run"]) == 0
    assert capsys.readouterr().out.count("\n") == 1 + source.cycles
    assert main(["export", str(path), "--csv", "-"]) == 0
    assert 1 < capsys.readouterr().out.count("\n") < source.cycles
