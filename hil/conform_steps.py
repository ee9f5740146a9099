"""The steps of a conformance run, in the order in which they are asked."""

from drivers.axis import Axis, AxisStatus
from hil.conform import Step
from hil.conform_bench import Bench, NotAskedError, NotOfferedError, StepError
from hil.conform_pulse import (
    DECAY_CYCLES,
    PLATEAU_CYCLES,
    RESOLUTION_STEPS,
    expect_no_torque,
    expect_torque,
    expect_torque_gone,
    plateau,
    pulse,
    torque_resolution_Nm,
)

LOCKSTEP_MARGIN_S = 0.25
"""An emulator that leaves lockstep notices that a while after its time-out."""
SETTLED_CYCLES = 50
"""Cycles over which something has to stay as it is."""
FRESH_SHARE = 0.9
"""Least share of fresh feedback of a drive that runs by its own clock; in lockstep, all."""
LONGEST_PULSE = 16
"""The direction of motion is sought with pulses of up to so many times the shortest."""
VISIBLE_STEPS = 6
"""Encoder steps a joint has to move for the direction to be beyond doubt."""
VISIBLE_RAD = 5e-3
"""It has to move as far as this, too: an encoder's noise is not motion."""
LEVELS = (0.25, 0.5, 1.0)
"""Shares of `Limits.torque_Nm` that are asked for."""
OVER_LIMIT = 10.0
TORQUE_STEPS = 20
"""Least number of the drive's torque steps that the torque of the run has to be."""
WATCHDOG_MARGIN = 1.5
WATCHDOG_SLACK_S = 0.01
NOT_OFFERED = (
    "not offered by this family: torque stays when the master dies; use a power relay or an "
    "emergency-stop circuit"
)
QUICK_WATCHDOG_S = 0.05
"""Only with a watchdog as quick as this is torque applied while commands cease."""


# --- start-up -----------------------------------------------------------------------------------


def presence(bench: Bench) -> str:
    """Ask the node for everything that start-up asks for; here only that it answers counts."""
    bench.configure()
    if not bench.has_heard:
        raise StepError(bench.start_error or "nothing was received")
    return f"{len(bench.frames)} frames exchanged"


def start_up(bench: Bench) -> str:
    """Identity, scales and settings were as configured, or start-up would have been refused."""
    info = bench.info
    if info is None:
        raise StepError(bench.start_error)
    least_Nm = TORQUE_STEPS * info.torque_resolution_Nm
    if bench.limits.torque_Nm < least_Nm:
        raise StepError(
            f"{bench.limits.torque_Nm:g} Nm is too little to judge torque in steps of "
            f"{info.torque_resolution_Nm:.3g} Nm; use --torque {least_Nm:.3g} or more"
        )
    mode = "lockstep" if info.is_lockstep else "by its own clock"
    return (
        f"{info.name}, {mode}; torque in steps of {_thousandths(info.torque_resolution_Nm)} mNm, "
        f"angle of {_thousandths(info.angle_resolution_rad)} mrad"
    )


def feedback(bench: Bench) -> str:
    """Feedback comes every cycle, without torque."""
    bench.cycle()
    bench.cycle()
    bench.rebase()
    fresh = sum(bench.cycle() for _ in range(2 * SETTLED_CYCLES))
    needed = 1.0 if bench.is_lockstep else FRESH_SHARE
    if fresh < needed * 2 * SETTLED_CYCLES:
        raise StepError(f"only {fresh} of {2 * SETTLED_CYCLES} cycles had fresh feedback")
    bench.expect_status(AxisStatus.DISABLED, AxisStatus.FAULT)
    expect_no_torque(bench)
    found = f"; begins in fault: {bench.axis.note}" if bench.axis.status is AxisStatus.FAULT else ""
    return f"{fresh} of {2 * SETTLED_CYCLES} cycles fresh, at {bench.axis.q_rad:+.4f} rad{found}"


# --- power --------------------------------------------------------------------------------------


def enable(bench: Bench) -> str:
    """The drive takes power when asked, and makes no torque by that alone."""
    bench.axis.enable()
    cycles = bench.wait_for(AxisStatus.ENABLED)
    for _ in range(SETTLED_CYCLES):
        bench.cycle()
        bench.expect_status(AxisStatus.ENABLED)
        expect_no_torque(bench)
    return f"enabled after {_cycles(cycles)}, no torque"


def torque(bench: Bench) -> str:
    """Small torques come out as commanded, with either sign."""
    shown = []
    for level in LEVELS:
        tau_Nm = level * bench.limits.torque_Nm
        seen = pulse(bench, tau_Nm, plateau(bench))
        expect_torque(bench, f"{level:g} of --torque", seen.up_Nm, tau_Nm)
        expect_torque(bench, f"{level:g} of --torque", seen.down_Nm, -tau_Nm)
        shown.append(f"{tau_Nm:.3f}: {seen.up_Nm:+.3f}/{seen.down_Nm:+.3f}")
    return f"commanded: reported, Nm: {', '.join(shown)}"


def motion(bench: Bench) -> str:
    """The joint moves the way it is pushed; pulses grow until the encoder shows it."""
    if bench.limits.is_clamped:
        raise NotAskedError("the joint is clamped")
    resolution_rad = bench.info.angle_resolution_rad if bench.info is not None else 0.0
    visible_rad = max(VISIBLE_STEPS * resolution_rad, VISIBLE_RAD)
    cycles, apart_rad = PLATEAU_CYCLES, 0.0
    while cycles <= LONGEST_PULSE * PLATEAU_CYCLES:
        up = pulse(bench, bench.limits.torque_Nm, cycles)
        down = pulse(bench, -bench.limits.torque_Nm, cycles)
        apart_rad = up.high_rad + up.low_rad - down.high_rad - down.low_rad
        if abs(apart_rad) > visible_rad:
            break
        cycles *= 2
    if apart_rad < -visible_rad:
        raise StepError(
            f"positive torque moves the joint {1e3 * up.low_rad:.1f} mrad: the angle counts "
            "against the torque; check the motor's phases and encoder"
        )
    if apart_rad < visible_rad:
        raise StepError(
            f"{bench.limits.torque_Nm:.3f} Nm moves the joint less than {1e3 * visible_rad:.2f} "
            "mrad; raise --torque, or say --clamped if it is held"
        )
    return (
        f"+{bench.limits.torque_Nm:.3f} Nm moves {1e3 * up.high_rad:+.1f} mrad, "
        f"-{bench.limits.torque_Nm:.3f} Nm {1e3 * down.low_rad:+.1f} mrad"
    )


def over_limit(bench: Bench) -> str:
    """Far too much torque is cut to the limit, on its way to the drive or in it."""
    limit_Nm = bench.limits.torque_max_Nm
    seen = pulse(bench, OVER_LIMIT * limit_Nm, plateau(bench))
    expect_torque(bench, "over the limit", seen.up_Nm, limit_Nm)
    expect_torque(bench, "over the limit", seen.down_Nm, -limit_Nm)
    slack_Nm = RESOLUTION_STEPS * torque_resolution_Nm(bench)
    most_Nm = (1.0 + bench.limits.tolerance) * limit_Nm + slack_Nm
    if seen.largest_Nm > most_Nm:
        raise StepError(f"{seen.largest_Nm:.3f} Nm reported, the limit is {limit_Nm:.3f} Nm")
    return (
        f"{OVER_LIMIT * limit_Nm:.2f} Nm asked for, {seen.up_Nm:+.3f}/{seen.down_Nm:+.3f} Nm "
        f"reported, limit {limit_Nm:.3f} Nm"
    )


# --- loss of command ----------------------------------------------------------------------------


def _loss_torque_Nm(bench: Bench) -> float:
    """Return the torque to apply while commands cease: the joint may not get far with it."""
    is_quick = bench.limits.watchdog_s <= QUICK_WATCHDOG_S
    return LEVELS[0] * bench.limits.torque_Nm if is_quick else 0.0


def _apply_before_loss(bench: Bench) -> float:
    tau_Nm = _loss_torque_Nm(bench)
    for _ in range(PLATEAU_CYCLES):
        bench.cycle(tau_Nm)
        bench.expect_status(AxisStatus.ENABLED)
    return tau_Nm


def _feeds_by_asking(axis: Axis) -> bool:
    """Tell whether asking for feedback is itself a command in this family."""
    return type(axis).request is not Axis.request


def _watchdog_time_s(bench: Bench) -> float:
    """Return after how long the loss has to have had its effect, and to have been reported."""
    limits = bench.limits
    return WATCHDOG_MARGIN * limits.watchdog_s + limits.state_report_s + WATCHDOG_SLACK_S


def loss_of_commands(bench: Bench) -> str:
    """Feedback is still asked for, but no command comes: the drive removes torque in time."""
    if _feeds_by_asking(bench.axis):
        raise NotAskedError("in this family what asks for feedback is a command")
    tau_Nm = _apply_before_loss(bench)
    allowed_s = _watchdog_time_s(bench)
    allowed = bench.cycles_of(allowed_s)
    for count in range(1, allowed + 1):
        if not bench.listen():
            continue
        if not bench.bus.is_enabled:
            expect_torque_gone(bench)
            after_ms = 1e3 * count * bench.timing.period_s
            return f"{tau_Nm:.3f} Nm, removed {after_ms:.0f} ms after its command; {_state(bench)}"
    bench.bring_to(AxisStatus.DISABLED)
    raise StepError(
        f"still enabled {1e3 * allowed_s:.0f} ms after the last command; set the drive's watchdog "
        f"({1e3 * bench.limits.watchdog_s:.0f} ms), or say --watchdog"
    )


def loss_of_master(bench: Bench) -> str:
    """Nothing is sent at all: when the master comes back, torque is gone."""
    tau_Nm = _apply_before_loss(bench)
    silence_s = _watchdog_time_s(bench)
    if bench.is_lockstep:
        silence_s += bench.timing.stall_timeout_s + LOCKSTEP_MARGIN_S
    bench.rest(silence_s)
    for _ in range(SETTLED_CYCLES):
        if not bench.listen():
            continue
        if bench.bus.is_enabled:
            bench.bring_to(AxisStatus.DISABLED)
            found = f"still enabled after {1e3 * silence_s:.0f} ms without any frame"
            if not bench.limits.has_watchdog:
                raise NotOfferedError(f"{NOT_OFFERED} ({found})")
            raise StepError(found)
        expect_torque_gone(bench)
        return f"no torque ({tau_Nm:.3f} Nm before) after {1e3 * silence_s:.0f} ms; {_state(bench)}"
    raise StepError("no feedback after the silence; the drive does not come back by itself")


def _state(bench: Bench) -> str:
    note = bench.axis.note
    return f"{bench.axis.status.name}{': ' + note if note else ''}"


def stays_off(bench: Bench) -> str:
    """Commands come back: torque does not, until somebody asks for it."""
    if bench.bus.is_enabled:  # a loss that failed has disabled it
        raise NotAskedError("the drive did not lose its commands")
    for _ in range(4 * SETTLED_CYCLES):
        bench.cycle(LEVELS[0] * bench.limits.torque_Nm)
        if bench.bus.is_enabled:
            raise StepError("the drive enabled itself when commands came back")
        expect_no_torque(bench)
    return f"{4 * SETTLED_CYCLES} cycles of torque commands, none applied"


# --- faults -------------------------------------------------------------------------------------


def fault(bench: Bench) -> str:
    """A drive that fails says so and makes no torque."""
    if not bench.limits.may_inject:
        raise NotAskedError("a real drive cannot be asked to fail")
    if not bench.bus.inject_fault(0):
        raise NotAskedError("the family has no command that makes an emulated drive fail")
    cycles = bench.wait_for(AxisStatus.FAULT)
    for _ in range(DECAY_CYCLES + 2 * bench.report_cycles):
        bench.cycle()
    expect_no_torque(bench)
    return f"after {_cycles(cycles)}; {bench.axis.note}"


def fault_holds(bench: Bench) -> str:
    """Asking for power is not enough to leave a fault."""
    if bench.axis.status is not AxisStatus.FAULT:
        raise NotAskedError("the drive is not in fault")
    bench.axis.enable()
    for _ in range(2 * SETTLED_CYCLES):
        bench.cycle(LEVELS[0] * bench.limits.torque_Nm)
        bench.expect_status(AxisStatus.FAULT)
        expect_no_torque(bench)
    return f"{2 * SETTLED_CYCLES} cycles with a request for power: still in fault, no torque"


def reset(bench: Bench) -> str:
    """A fault reset leaves the fault, and leaves power off."""
    if bench.axis.status not in (AxisStatus.FAULT, AxisStatus.LOST):
        raise NotAskedError(f"the drive is not in fault but {bench.axis.status.name}")
    bench.axis.reset_fault()
    bench.cycle()
    cycles = bench.wait_for(AxisStatus.DISABLED)
    for _ in range(SETTLED_CYCLES):
        bench.cycle()
        bench.expect_status(AxisStatus.DISABLED)
    return f"disabled after {_cycles(cycles + 1)}, and stays so"


def enable_again(bench: Bench) -> str:
    """Power and torque are back after a reset."""
    bench.axis.enable()
    cycles = bench.wait_for(AxisStatus.ENABLED)
    tau_Nm = LEVELS[-1] * bench.limits.torque_Nm
    seen = pulse(bench, tau_Nm, plateau(bench))
    expect_torque(bench, "after the reset", seen.up_Nm, tau_Nm)
    expect_torque(bench, "after the reset", seen.down_Nm, -tau_Nm)
    return f"enabled after {_cycles(cycles)}, {seen.up_Nm:+.3f}/{seen.down_Nm:+.3f} Nm"


# --- the end ------------------------------------------------------------------------------------


def disable(bench: Bench) -> str:
    """Torque goes off when asked, while torque is commanded."""
    tau_Nm = LEVELS[0] * bench.limits.torque_Nm
    for sign in (1.0, -1.0):
        for _ in range(PLATEAU_CYCLES):
            bench.cycle(sign * tau_Nm)
            bench.expect_status(AxisStatus.ENABLED)
    bench.axis.disable()
    cycles = bench.wait_for(AxisStatus.DISABLED, tau_Nm)
    for _ in range(DECAY_CYCLES + 2 * bench.report_cycles):
        bench.cycle(tau_Nm)
    expect_no_torque(bench)
    return f"disabled after {_cycles(cycles)}, no torque"


def disabled_torque(bench: Bench) -> str:
    """A disabled drive applies no torque, whatever is commanded."""
    for _ in range(SETTLED_CYCLES):
        bench.cycle(bench.limits.torque_Nm)
        bench.expect_status(AxisStatus.DISABLED)
        expect_no_torque(bench)
    return f"{SETTLED_CYCLES} cycles of torque commands, none applied"


def _thousandths(value: float) -> str:
    return f"{1e3 * value:.3g}" if value >= 1e-6 else "less than 0.001"


def _cycles(count: int) -> str:
    return f"{count} cycle{'' if count == 1 else 's'}"


_OFF, _ON = AxisStatus.DISABLED, AxisStatus.ENABLED
STEPS = (
    Step("presence", presence, is_vital=True),
    Step("start-up", start_up, is_vital=True),
    Step("feedback", feedback, is_vital=True),
    Step("enable", enable, begins=_OFF, is_vital=True),
    Step("torque", torque, begins=_ON),
    Step("direction of motion", motion, begins=_ON),
    Step("torque limit", over_limit, begins=_ON),
    Step("loss of commands", loss_of_commands, begins=_ON),
    Step("off after loss of commands", stays_off),
    Step("reset after loss of commands", reset),
    Step("torque after loss of commands", enable_again, begins=_OFF),
    Step("loss of master", loss_of_master, begins=_ON),
    Step("off after loss of master", stays_off),
    Step("reset after loss of master", reset),
    Step("torque after loss of master", enable_again, begins=_OFF),
    Step("fault", fault, begins=_ON),
    Step("fault holds", fault_holds),
    Step("reset after fault", reset),
    Step("torque after fault", enable_again, begins=_OFF),
    Step("disable", disable, begins=_ON),
    Step("no torque when disabled", disabled_torque, begins=_OFF),
)
"""Every step by name, in order."""
