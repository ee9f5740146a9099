"""Laws by name, and the clip of the torque they share."""

import math

import numpy as np
import pytest

from controller.law import PassivityLaw
from controller.model_based import ComputedTorqueLaw, SlotineLiLaw
from controller.player import Setpoint
from controller.registry import make_law
from controller.settings import ControllerSettings, LawSettings, LimitSettings

T = 1e-3
ZEROS = [0.0, 0.0]
CLIP_NM = (1.5, 0.4)
TAU_MAX_NM = (15.0, 8.0)
LAWS = {
    "self_tuning_pid": PassivityLaw,
    "self_tuning_pd": PassivityLaw,
    "pid": PassivityLaw,
    "pd": PassivityLaw,
    "computed_torque": ComputedTorqueLaw,
    "slotine_li": SlotineLiLaw,
}


def settings(**law) -> ControllerSettings:
    limits = dict.fromkeys(LimitSettings.model_fields, (1.0, 1.0))
    limits |= {"hard_margin_rad": 0.1, "n_hold": 5, "n_damp": 20, "stop_timeout_s": 2.0}
    limits |= {"lowering_rad_s": 0.5, "lowering_timeout_s": 8.0}
    limits |= {"q_min_rad": (-1.0, -1.0), "tau_max_Nm": TAU_MAX_NM}
    link = {"length_m": 0.25, "com_m": 0.1, "mass_kg": 1.0, "inertia_kg_m2": 0.03}
    return ControllerSettings(law=law, limits=limits, model={"links": [link, link]})


def stepped(law, rates):
    """Torques for an error of rate alone, so that S_q is that rate."""
    return law.step(ZEROS, list(rates), Setpoint(ZEROS, ZEROS, ZEROS), T)


@pytest.mark.parametrize("name", list(LAWS))
def test_make_law__every_name__its_class_for_the_joints_of_the_limits(name):
    law = make_law(settings(name=name))
    assert type(law) is LAWS[name]
    assert len(stepped(law, (0.1, -0.1))) == len(law.gains) == 2


def test_make_law__names__are_those_of_the_settings():
    assert set(LAWS) == set(LawSettings.model_fields["name"].annotation.__args__)


@pytest.mark.parametrize("name", ["pid", "pd", "self_tuning_pid", "computed_torque"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_clip__torque_beyond_it__the_clip_with_the_torques_sign(name, sign):
    law = make_law(settings(name=name, tau_clip_Nm=CLIP_NM))
    assert stepped(law, (sign * 5.0, -sign * 5.0)) == [-sign * CLIP_NM[0], sign * CLIP_NM[1]]


def test_clip__torque_within_it__as_without():
    free, clipped = (PassivityLaw(LawSettings(name="pid", **clip), TAU_MAX_NM)
                     for clip in ({}, {"tau_clip_Nm": CLIP_NM}))  # fmt: skip
    for k in range(200):
        rates = (0.3 * math.sin(0.1 * k), 0.09 * math.cos(0.1 * k))
        assert stepped(free, rates) == stepped(clipped, rates)


def test_clip__above_the_limit_of_the_joint__the_limit_counts():
    law = PassivityLaw(LawSettings(name="pid", tau_clip_Nm=(100.0, 100.0)), TAU_MAX_NM)
    assert stepped(law, (9.0, -9.0)) == [-15.0, 8.0]


def test_no_clip__torque_beyond_the_limit_of_the_joint__left_to_the_limiter():
    law = PassivityLaw(LawSettings(name="pid"), TAU_MAX_NM)
    assert stepped(law, (9.0, -9.0)) == [-36.0, 36.0]


def test_clip__torque_clipped_and_pushed_further__sigma_waits():
    law = PassivityLaw(LawSettings(name="pid", tau_clip_Nm=CLIP_NM), TAU_MAX_NM)
    for _ in range(50):
        stepped(law, (0.2, 0.2))  # 0.8 Nm at Kd = 4: clipped at joint 2 alone
    assert law.sigma[0] == pytest.approx(49 * T * math.tanh(2.0))
    assert law.sigma[1] == 0.0


def test_clip__self_tuning__peak_torque_never_above_it():
    law = PassivityLaw(LawSettings(tau_clip_Nm=CLIP_NM), TAU_MAX_NM)
    random = np.random.default_rng(1)
    torques = np.abs([stepped(law, random.normal(0.0, 1.0, 2)) for _ in range(500)])
    assert torques.max(axis=0).tolist() == list(CLIP_NM)
