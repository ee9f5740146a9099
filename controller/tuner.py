"""A tuner of the gain that remembers the load: an option beside the paper's, not in the paper.

The paper's law tau = -Kd S asks of Kd only that it stays between two bounds. Within them, this
tuner picks the gain whose torque comes nearest to K0 S + m, where m is what the torque has been
on average of late. On the side of S that carries the load the gain is then large, on the other
side small, so that the noise of S, which has no mean, adds to the load's torque instead of to
the error. `docs/tuner.md` derives it and compares it.
"""

from controller.gain import Gain
from controller.settings import LawSettings


class LoadMemoryGain(Gain):
    """Kd = clip(K0 + m / S, Kd_min, top(|S|)), with T m' = Kd S - m.

    As rules in the form (17): with r = m / S, `opposing` has its consequence Kd_min and is full
    for r <= Kd_min - K0, `neutral` has K0 and is full at r = 0, `carrying` has Kd_max and is full
    for r >= Kd_max - K0; triangles and shoulders between, a partition of unity. `big` holds the
    torque at the plateau Kd_max * knee: top(|S|) = max(Kd_min, Kd_max * min(1, knee / |S|)).

    Kd stays between its bounds whatever S does, and |m| below the plateau. Negating every S
    leaves every Kd as it is, to the last bit. For a given m the torque is a continuous function of
    S that never falls with |S| and never rises faster than Kd_max |S|.

    Attributes:
        load_Nm: m, the memory of Kd S = -tau.
    """

    __slots__ = ("_knee_rad_s", "_memory_s", "_neutral", "_neutral_place", "_plateau_Nm", "load_Nm")

    def __init__(self, settings: LawSettings, joint: int) -> None:
        super().__init__(settings.Kd_min[joint], settings.Kd_max[joint], settings.Kd_ramp_per_s)
        self._memory_s = settings.load_memory_s
        self._neutral_place = settings.load_neutral
        self._knee_rad_s = settings.load_knee_rad_s
        self.load_Nm = 0.0
        self._follow_bounds()

    def reset(self) -> None:
        """Forget the load."""
        self.load_Nm = 0.0

    def step(self, S: float, dt_s: float) -> float:
        """Return Kd for this cycle, in Nm s/rad, and remember its torque; see the class."""
        if self._goal is not None:
            self._ramp_bounds(dt_s)
            self._follow_bounds()
        low = self.Kd_min
        top = self.Kd_max
        load = self.load_Nm
        plateau = self._plateau_Nm
        S_abs = S if S >= 0.0 else -S
        if S_abs > self._knee_rad_s:
            top = max(low, plateau / S_abs)
        Kd = self._neutral + load / S if S_abs > 0.0 else self._neutral
        if not low <= Kd <= top:
            Kd = top if Kd > top else low
        torque = Kd * S
        if not -plateau <= torque <= plateau:
            torque = plateau if torque > 0.0 else -plateau
        share = dt_s / self._memory_s
        self.load_Nm = load + share * (torque - load) if share < 1.0 else torque
        return Kd

    def _follow_bounds(self) -> None:
        """Keep the neutral gain in its place between the bounds, and the load below the plateau."""
        self._neutral = self.Kd_min + self._neutral_place * (self.Kd_max - self.Kd_min)
        plateau = self._plateau_Nm = self.Kd_max * self._knee_rad_s
        self.load_Nm = max(-plateau, min(plateau, self.load_Nm))
