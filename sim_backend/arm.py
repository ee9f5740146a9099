"""The simulated arm: a chain of links that is held, let go, driven, loaded and disturbed.

How the chain moves is `sim_backend.chain`'s. What happens to it by schedule, payloads and
disturbances, is timed here, in time during which the arm is free.
"""

from collections.abc import Sequence
from math import inf, isfinite

from sim_backend.chain import Chain
from sim_backend.disturbance import Disturbances
from sim_backend.errors import PlantError, SimError
from sim_backend.payload import PayloadEvent, laden, payload_events, rates_after_catch
from sim_backend.settings import PayloadSettings, PlantSettings


class Arm(Chain):
    """A planar chain of n links on a fixed shoulder.

    Gravity acts along +x, so that angles count from the downward vertical, counter-clockwise
    positive. Joint friction is `B dq + C tanh(D dq)` (paper eq. (1)) or the Stribeck curve. Same
    settings and same calls give the same bits, on one machine type.

    Attributes:
        settings: What the arm was built from.
        q_rad: Joint angles at `time_ns`, relative to the previous link. A new list at each step.
        dq_rad_s: Joint rates at `time_ns`. A new list at each step.
        time_ns: Simulated time since the last reset.
        is_held: The arm stands still, whatever the torque; time goes on, schedules wait.
        payloads: What the arm carries.

    Raises:
        SimError: If the settings contradict each other, or the substep cannot carry friction or a
            drivetrain.

    Example:
        >>> from sim_backend.presets import plant_preset
        >>> arm = Arm(plant_preset("bench_h", q0_rad=(0.4, -0.5)))
        >>> arm.step((0.1, 0.0), 500e-6)
        >>> arm.time_ns
        500000
    """

    __slots__ = (
        "_advance",
        "_advance_free",
        "_disturbances",
        "_duration_s",
        "_events",
        "_held_ns",
        "_push_Nm",
        "_steady_until_ns",
        "_substeps",
        "is_held",
        "payloads",
    )

    def __init__(self, settings: PlantSettings) -> None:
        super().__init__(settings)
        self._disturbances = Disturbances(settings.disturbances, len(settings.links))
        self._duration_s = self._substep_s
        self._substeps = 1
        self.reset(settings.q0_rad)

    def reset(
        self,
        q_rad: Sequence[float],
        dq_rad_s: Sequence[float] | None = None,
        q_motor_rad: Sequence[float] | None = None,
        dq_motor_rad_s: Sequence[float] | None = None,
    ) -> None:
        """Rebuild the arm at a pose, at time zero, free, with all schedules at their start.

        Args:
            q_rad: Joint angles.
            dq_rad_s: Joint rates; at rest if None.
            q_motor_rad: Rotor angles; in the middle of the gap if None. Of joints without a
                drivetrain they are not looked at.
            dq_motor_rad_s: Rotor rates; as the joints if None.

        Raises:
            SimError: If the number of values is not the number of joints. Nothing has changed.
            PlantError: If a value is NaN or infinite. Nothing has changed.
        """
        count = len(self.settings.links)
        q, dq = list(q_rad), [0.0] * count if dq_rad_s is None else list(dq_rad_s)
        rotors = q if q_motor_rad is None else list(q_motor_rad)
        rotor_rates = dq if dq_motor_rad_s is None else list(dq_motor_rad_s)
        if {len(q), len(dq), len(rotors), len(rotor_rates)} != {count}:
            raise SimError(f"a pose of this arm has {count} joints: got q_rad={q}, dq_rad_s={dq}")
        if not isfinite(sum(q) + sum(dq) + sum(rotors) + sum(rotor_rates)):
            raise PlantError(f"the pose is not finite: q_rad={q}, dq_rad_s={dq}")
        self.time_ns = self._held_ns = 0
        self.is_held = False
        self._events = payload_events(self.settings.payloads)
        self._push_Nm = [0.0] * count
        self._load([each for each in self.settings.payloads if each.pick_s == 0.0])
        self._place(q, dq, rotors, rotor_rates)

    def hold(self) -> None:
        """Stop the arm where it is, as on a stand, until `release`."""
        rest = [0.0] * len(self.q_rad)
        self._place(self.q_rad, rest, self.q_motor_rad, rest)
        self.is_held = True

    def release(self) -> None:
        """Let a held arm move again."""
        self.is_held = False

    def pick_up(self, payload: PayloadSettings) -> None:
        """Take an object now, whatever its times say.

        Args:
            payload: Comes on top of what the arm carries already.
        """
        before = self._links
        self._load([*self.payloads, payload])
        if payload.is_at_rest:
            after = rates_after_catch(before, self._links, self.q_rad, self.dq_rad_s)
            self.dq_rad_s = self._rates_before = after
        self._rebuild()

    def drop(self, payload: PayloadSettings) -> None:
        """Let go of an object now.

        Raises:
            SimError: If the arm does not carry it. Nothing has changed.
        """
        if payload not in self.payloads:
            raise SimError(f"cannot drop {payload.mass_kg:g} kg: the arm carries {self.payloads}")
        remaining = list(self.payloads)
        remaining.remove(payload)
        self._load(remaining)
        self._rebuild()

    def disturb(self, tau_Nm: Sequence[float]) -> None:
        """Apply disturbance torques, on top of the scheduled ones, until called again or reset.

        Args:
            tau_Nm: Per joint, on the link, reacting on the previous one.

        Raises:
            SimError: If the number of torques is not the number of joints. Nothing has changed.
            PlantError: If one is not finite. Nothing has changed.
        """
        self._check_torques(tau_Nm)
        self._push_Nm = list(tau_Nm)
        self._choose_advance()

    def step(self, tau_Nm: Sequence[float], duration_s: float) -> None:
        """Advance under constant motor torques.

        Args:
            tau_Nm: Motor torque per joint, positive about the joint's axis; reacts on the
                previous link.
            duration_s: A whole number of substeps.

        Raises:
            SimError: If `duration_s` or the number of torques does not fit. Nothing has moved.
            PlantError: If a torque is not finite (nothing has moved), or if the arm has come
                apart or left the range of numbers (it has moved; `reset` it).
        """
        if duration_s != self._duration_s:
            self._set_duration(duration_s)
        if len(tau_Nm) != len(self._bodies) or not isfinite(sum(tau_Nm)):
            self._check_torques(tau_Nm)
        self.time_ns += self._substeps * self._substep_ns
        if self.is_held:
            self._held_ns += self._substeps * self._substep_ns
            return
        try:
            self._advance(tau_Nm, self._substeps)
            self._read_out()
        except ValueError as error:  # the cosine of an infinite angle
            raise PlantError(self._describe_damage(inf)) from error

    @property
    def has_drivetrain(self) -> bool:
        """At least one joint is driven through a gap."""
        return any(self._drivetrains)

    @property
    def q_motor_rad(self) -> list[float]:
        """Rotor angles, relative to the previous link: the joint's own without a drivetrain."""
        pairs = zip(self._drivetrains, self.q_rad, strict=True)
        return [q if drivetrain is None else drivetrain.q_rad for drivetrain, q in pairs]

    @property
    def dq_motor_rad_s(self) -> list[float]:
        """Rotor rates, relative to the previous link."""
        pairs = zip(self._drivetrains, self.dq_rad_s, strict=True)
        return [dq if drivetrain is None else drivetrain.dq_rad_s for drivetrain, dq in pairs]

    def encoder_motion(self) -> tuple[list[float], list[float]]:
        """Return angle and rate of each joint at its encoder, on the motor's or the link's side."""
        q, dq = self.q_motor_rad, self.dq_motor_rad_s
        for j, drivetrain in enumerate(self._drivetrains):
            if drivetrain is not None and drivetrain.settings.encoder == "link":
                q[j], dq[j] = self.q_rad[j], self.dq_rad_s[j]
        return q, dq

    def _place(
        self,
        q: Sequence[float],
        dq: list[float],
        rotors: Sequence[float],
        rotor_rates: Sequence[float],
    ) -> None:
        self.q_rad, self.dq_rad_s, self._rates_before = list(q), dq, dq
        rows = zip(self._drivetrains, rotors, rotor_rates, q, dq, strict=True)
        for drivetrain, *motion in rows:
            if drivetrain is not None:
                drivetrain.place(*motion)
        self._rebuild()

    def _load(self, payloads: Sequence[PayloadSettings]) -> None:
        self.payloads = tuple(payloads)
        *inner, last = self.settings.links
        self._links = (*inner, laden(last, payloads))

    def _rebuild(self) -> None:
        self._build()
        for drivetrain, dq in zip(self._drivetrains, self.dq_rad_s, strict=True):
            if drivetrain is not None:
                drivetrain.rebase(dq)
        self._choose_advance()

    def _choose_advance(self) -> None:
        """Take the cheapest way forward that can do what is asked for."""
        is_disturbed = bool(self.settings.disturbances) or any(self._push_Nm)
        if is_disturbed or not self.is_plain:
            self._advance_free = self._advance_optional
        elif len(self._bodies) == 2:
            self._advance_free = self._advance_two
        else:
            self._advance_free = self._advance_chain
        is_scheduled = is_disturbed or bool(self._events)
        self._advance = self._advance_by_schedule if is_scheduled else self._advance_free
        self._load_Nm = [0.0] * len(self._bodies)
        self._steady_until_ns = 0

    def _advance_by_schedule(self, tau_Nm: Sequence[float], substeps: int) -> None:
        substep_ns = self._substep_ns
        end_ns = self.time_ns - self._held_ns
        if end_ns <= self._steady_until_ns:
            self._advance_free(tau_Nm, substeps)
            return
        for now_ns in range(end_ns - substeps * substep_ns, end_ns, substep_ns):
            while self._events and 2 * (self._events[0].at_ns - now_ns) <= substep_ns:
                self._read_out()
                self._carry_out(self._events.pop(0))
            self._load_Nm = self._mean_load_Nm(now_ns)
            self._advance_free(tau_Nm, 1)
        self._load_Nm = self._mean_load_Nm(end_ns)
        steady_ns = self._disturbances.steady_until_ns(end_ns)
        next_ns = self._events[0].at_ns if self._events else steady_ns
        self._steady_until_ns = min(steady_ns, next_ns)

    def _mean_load_Nm(self, now_ns: int) -> list[float]:
        scheduled_Nm = self._disturbances.mean_Nm(now_ns, now_ns + self._substep_ns)
        return [a + b for a, b in zip(scheduled_Nm, self._push_Nm, strict=True)]

    def _carry_out(self, event: PayloadEvent) -> None:
        if event.is_pick_up:
            self.pick_up(event.payload)
        elif event.payload in self.payloads:  # it may have been dropped by call
            self.drop(event.payload)

    def _check_torques(self, tau_Nm: Sequence[float]) -> None:
        if len(tau_Nm) != len(self._bodies):
            raise SimError(f"this arm takes {len(self._bodies)} torques, not {len(tau_Nm)}")
        if not isfinite(sum(tau_Nm)):
            raise PlantError(f"torque is not finite at t = {self._time_s():.6f} s: {list(tau_Nm)}")

    def _set_duration(self, duration_s: float) -> None:
        ratio = duration_s / self._substep_s
        if not (ratio > 0.5 and isfinite(ratio) and abs(ratio - round(ratio)) < 1e-6):
            raise SimError(
                f"cannot advance by {duration_s} s: not a whole number of substeps of"
                f" {self._substep_s} s"
            )
        self._duration_s, self._substeps = duration_s, round(ratio)
