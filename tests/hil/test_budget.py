"""The bus budget: arithmetic, refusal, the table of `hil doctor --bus` and the one in the docs."""

import json
from pathlib import Path

import pytest

from drivers.frame import worst_case_bits, worst_case_fd_bits
from drivers.registry import SETTINGS
from drivers.settings import AxisSettings, CycleFrame
from hil import bus_table
from hil.budget import budget_of, budget_table, bus_budget, require_fit
from hil.cli import main
from hil.config import BusSettings, ConfigError, load_config
from tests.hil.virtual import configured

PAGE = Path(__file__).parents[2] / "docs" / "bus-budget.md"


class PlainSettings(AxisSettings):
    """A family that says what the test wants it to."""

    frames: tuple[CycleFrame, ...]
    family: str = "plain"

    @classmethod
    def defaults(cls, joint, tau_max_Nm):
        raise AssertionError("not asked for")

    @property
    def node(self):
        return 1

    def cycle_frames(self, period_s):
        return self.frames


def plain(*frames, axes=1, **bus):
    return budget_of([PlainSettings(frames=frames)] * axes, BusSettings(**bus), 1e-3)


def axes(number):
    axis = SETTINGS["cia402"].defaults(1, 15.0)
    many = [axis | {"node_id": joint} for joint in range(1, number + 1)]
    settings = [SETTINGS["cia402"].model_validate(each) for each in many]
    return budget_of(settings, BusSettings(), 1e-3)


def test_budget__two_lean_axes__515_us():
    budget = bus_budget(configured())
    assert 1e6 * budget.cyclic_s == pytest.approx(515)
    assert 1e6 * budget.reserve_s == pytest.approx(135)
    assert budget.share == pytest.approx(0.65)
    assert 0.515 < budget.mean_share < 0.53
    # SYNC, 2 RPDO1, 2 TPDO1, SDO, three heartbeats, 2 EMCY
    assert 1e6 * budget.peak_share * 1e-3 == pytest.approx(515 + 135 + 3 * 65 + 2 * 135)
    assert budget.is_fitting


def test_budget__shared_frames__count_once_and_the_others_per_axis():
    shared, own = CycleFrame("sync", 0, is_shared=True), CycleFrame("torque", 8)
    budget = plain(shared, own, axes=3)
    assert {line.label: line.number for line in budget.lines} == {"sync": 1, "plain torque": 3}
    assert 1e6 * budget.cyclic_s == pytest.approx(55 + 3 * 135)
    assert budget.reserve_s == 0.0


def test_budget__shared_frame_at_two_paces__the_more_frequent_counts():
    slow, fast = (CycleFrame("beat", 1, every=n, is_shared=True) for n in (100, 10))
    settings = [PlainSettings(frames=(frame,)) for frame in (slow, fast)]
    (line,) = budget_of(settings, BusSettings(), 1e-3).lines
    assert line.frame.every == 10


def test_budget__occasional_frames__the_longest_one_has_room_in_every_cycle():
    budget = plain(CycleFrame("a", 8), CycleFrame("b", 4, every=10), CycleFrame("c", 6, every=50))
    assert 1e6 * budget.share * 1e-3 == pytest.approx(135 + 115)
    assert 1e6 * budget.mean_share * 1e-3 == pytest.approx(135 + 95 / 10 + 115 / 50)
    assert 1e6 * budget.peak_share * 1e-3 == pytest.approx(135 + 95 + 115)


def test_budget__extended_and_fd_frames__their_own_lengths_and_rates():
    extended = plain(CycleFrame("a", 8, is_extended=True))
    assert 1e6 * extended.cyclic_s == pytest.approx(worst_case_bits(8, is_extended=True))
    first, second = worst_case_fd_bits(24, is_extended=True)
    fd = plain(CycleFrame("a", 24, is_extended=True, is_fd=True), data_bit_rate=5_000_000)
    assert 1e6 * fd.cyclic_s == pytest.approx(first + second / 5)


def test_budget__bit_rate__scales_everything():
    assert bus_budget(configured("bus.bit_rate=500000")).share == pytest.approx(1.30)
    assert bus_budget(configured("loop.period_s=0.002")).share == pytest.approx(0.325)


def test_require_fit__too_many_axes__refused_with_the_arithmetic():
    require_fit(configured())
    with pytest.raises(ConfigError) as caught:
        require_fit(configured("bus.bit_rate=500000"))
    line = str(caught.value)
    assert "1 x SYNC 110 + 2 x cia402 RPDO1 190 + 2 x cia402 TPDO1 270" in line
    assert "+ one other frame 270 = 1300 us" in line
    assert "1000 us" in line
    assert "\n" not in line


def test_budget__axes_at_1_kHz__three_fit_and_four_do_not():
    assert axes(3).is_fitting
    assert not axes(4).is_fitting
    assert axes(4).cyclic_s < 1e-3 < axes(4).cyclic_s + axes(4).reserve_s


@pytest.mark.parametrize("family", list(SETTINGS))
@pytest.mark.parametrize("period_s", [1e-3, 4e-3, 10e-3])
def test_cycle_frames__every_family__states_commands_and_feedback(family, period_s):
    settings = SETTINGS[family].model_validate(SETTINGS[family].defaults(1, 15.0))
    frames = settings.cycle_frames(period_s)
    assert len([frame for frame in frames if frame.every == 1]) >= 2
    assert len({frame.name for frame in frames}) == len(frames)
    for frame in frames:
        assert frame.every >= 1
        assert 0 <= frame.length <= (64 if frame.is_fd else 8)


def test_budget_table__every_frame_and_the_sums():
    lines = budget_table(bus_budget(configured())).splitlines()
    assert len({len(line.split("  ")[0]) for line in lines}) > 1
    text = "\n".join(lines)
    for words in ("SYNC", "cia402 TPDO1", "every cycle", "every 100 cycles", "65.0 %", "51.5 %"):
        assert words in text


def test_doctor_bus__without_address__the_table_and_a_verdict(capsys):
    assert main(["doctor", "--bus"]) == 0
    out = capsys.readouterr().out
    assert "cia402 RPDO1" in out
    assert out.splitlines()[-1].startswith("PASS  bus load")
    assert "kernel" not in out


def test_doctor_bus__does_not_fit__fails_with_the_arithmetic(capsys):
    assert main(["doctor", "--bus", "--set", "bus.bit_rate=500000"]) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("FAIL  bus load")
    assert "= 1300 us" in last


def test_doctor_bus__above_80_percent__warns(capsys):
    assert main(["doctor", "--bus", "--set", "bus.bit_rate=800000"]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("WARN  bus load")


def test_doctor_bus__json__the_same_figures(capsys):
    assert main(["doctor", "--bus", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["share"] == pytest.approx(0.65)
    total_s = sum(frame["total_s"] for frame in found["frames"] if frame["every"] == 1)
    assert total_s == pytest.approx(515e-6)


def test_docs__table__is_what_the_command_prints():
    page = PAGE.read_text(encoding="utf-8")
    assert "python -m hil.bus_table" in page
    assert bus_table.bus_table() in page, "run python -m hil.bus_table and paste its table"


def test_config__data_bit_rate__is_a_setting_of_the_bus():
    assert load_config(None, {"bus": {"data_bit_rate": 2_000_000}}).bus.data_bit_rate == 2_000_000
