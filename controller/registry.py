"""The law that the settings name."""

from controller.law import Law, PassivityLaw
from controller.model_based import ComputedTorqueLaw, SlotineLiLaw
from controller.settings import ControllerSettings


def make_law(settings: ControllerSettings) -> Law:
    """Build the configured law for as many joints as the limits have.

    Raises:
        ValueError: If it is model-based and the settings have no model.
    """
    if settings.law.name == "computed_torque":
        return ComputedTorqueLaw(settings)
    if settings.law.name == "slotine_li":
        return SlotineLiLaw(settings)
    return PassivityLaw(settings.law, settings.limits.tau_max_Nm)
